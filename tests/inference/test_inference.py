"""Both engines and the posteriors against sums over every latent path."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hierarchies import make_batch, make_hierarchy
from oracle import brute_force, predictions, random_tables

import ddco_pyro
from ddco_pyro import inference
from ddco_pyro.errors import BadInput
from ddco_pyro.inference import log_likelihood, posterior, segment
from ddco_pyro.inference.kernel import STEPS_A_THREAD, on_threads
from ddco_pyro.inference.logspace import Filter
from ddco_pyro.inference.marginal import EliminatedAHMM
from ddco_pyro.inference.posteriors import log_predictive
from ddco_pyro.model.tables import NEVER, Tables, complete, joint_density

CASES = [
    ((), (), 5),
    ((1,), (True,), 5),
    ((3,), (True,), 4),
    ((2, 2), (False, False), 3),
    ((2, 2), (False, True), 3),
    ((2, 2), (True, True), 3),
    ((1, 2, 1), (False, True, False), 2),
    ((2, 1, 2), (True, True, True), 2),
    ((2, 1, 2), (False, False, False), 2),
]


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
@pytest.mark.parametrize("engine", ["fused", "enumerate"])
@pytest.mark.parametrize("power", [1.0, 0.3])
def test_log_likelihood_is_the_sum_over_paths(counts, hybrid, steps, engine, power):
    tables = replace(random_tables(counts, hybrid, trajectories=2, steps=steps, seed=1), power=power)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    truth = [brute_force(tables, n, int(length)).log_likelihood for n, length in enumerate(lengths)]
    np.testing.assert_allclose(log_likelihood(tables, lengths, engine).numpy(), truth, atol=1e-9, rtol=0)


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
@pytest.mark.parametrize("power", [1.0, 0.3])
def test_posterior_is_the_marginal_over_paths(counts, hybrid, steps, power):
    tables = replace(random_tables(counts, hybrid, trajectories=2, steps=steps, seed=2), power=power)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    found = posterior(tables, lengths)
    for n, length in enumerate(lengths.tolist()):
        truth = brute_force(tables, n, length)
        for name, d in itertools.product("uvw", range(len(counts))):
            table = getattr(found, name)[d][n]
            ours, theirs = table[:length].numpy(), getattr(truth, name)[d]
            np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=name)
            assert not table[length:].any()


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_engines_have_the_same_gradient(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=3, steps=steps, seed=4)
    leaves = [leaf.detach().requires_grad_() for leaf in tables.leaves()]
    lengths, gradients = torch.tensor([steps, 1, max(steps - 1, 1)]), []
    for engine in ("fused", "enumerate"):
        total = log_likelihood(Tables.of(tables.depth, leaves), lengths, engine).sum()
        gradients.append(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))
    for leaf, ours, pyros in zip(leaves, *gradients, strict=True):
        possible = leaf > NEVER  # an impossible entry has no logarithm to differentiate by
        np.testing.assert_allclose(ours[possible], pyros[possible], atol=1e-10)


@pytest.mark.parametrize(("counts", "hybrid"), [((2,), (True,)), ((2, 1), (False, True))])
def test_threads_change_no_bit(counts, hybrid):
    tables = random_tables(counts, hybrid, trajectories=5, steps=STEPS_A_THREAD // 2, seed=3)
    lengths, found, parts = torch.tensor([STEPS_A_THREAD // 2, 1, 7, 1500, 2000]), [], []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            value, own = log_likelihood(tables, lengths), posterior(tables, lengths)
            found.append([value, *own.u, *own.v, *own.w, *segment(tables, lengths)])
            on_threads(lambda first, last: parts.append((first, last)), len(lengths), int(lengths.sum()))
        finally:
            torch.set_num_threads(1)
    assert sorted(parts) == [(0, 2), (0, 2), (0, 5), (2, 5), (2, 5)]  # 7604 steps are worth two threads
    for others in found[1:]:
        assert all(torch.equal(one, other) for one, other in zip(found[0], others, strict=True))


def test_compiled_code_is_in_one_file():
    """numba keeps compiled entry points as long as their own file is unchanged."""
    root = Path(ddco_pyro.__file__).parent
    assert [path.name for path in root.rglob("*.py") if "import numba" in path.read_text()] == ["kernel.py"]


# --- the online filter --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counts", "hybrid", "steps"),
    [((1,), (True,), 4), ((3,), (True,), 4), ((2, 2), (True, False), 3), ((1, 2, 1), (False, True, True), 2)],
)
@pytest.mark.parametrize("power", [1.0, 0.3])
@pytest.mark.parametrize("evident", [False, True])
def test_the_belief_is_what_the_past_says(counts, hybrid, steps, power, evident):
    tables = replace(random_tables(counts, hybrid, trajectories=2, steps=steps, seed=21), power=power)
    if evident:
        random = torch.Generator().manual_seed(3)
        for level, size in enumerate(tables.sizes, start=1):
            evidence = torch.randn(2, steps, size, generator=random, dtype=torch.float64)
            tables = tables.with_evidence(level, evidence)
    filtering, lengths = Filter(power), torch.tensor([steps, steps])
    density = joint_density(tables.control).unbind(1)
    for t, now in enumerate(complete(tables, lengths).steps()):
        belief = filtering.predict(now)
        known = [table.clone() for table in tables.control]
        for table in known:
            table[:, t] = torch.where(table[:, t] > NEVER, 0.0, NEVER)  # the control at t is not known yet
        so_far = replace(tables, control=tuple(known))
        for n in range(2):
            truth = brute_force(so_far, n, t + 1)
            for level, u in zip(belief, truth.u, strict=True):
                np.testing.assert_allclose(level[n], u[t], atol=1e-12)
        filtering.update(density[t])
    if not evident:
        torch.testing.assert_close(filtering.log_likelihood, log_predictive(tables, lengths))


@pytest.mark.parametrize("power", [1.0, 0.3])
@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_the_predictive_density_is_that_of_every_path_so_far(counts, hybrid, steps, power):
    tables = replace(random_tables(counts, hybrid, trajectories=2, steps=steps, seed=5), power=power)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    found = log_predictive(tables, lengths)
    steps = [predictions(tables, n, int(length)) for n, length in enumerate(lengths)]
    truth = [sum(step.value for step in own) for own in steps]
    np.testing.assert_allclose(found.numpy(), truth, atol=1e-9)
    if power == 1:
        torch.testing.assert_close(found, log_likelihood(tables, lengths))


def test_thousands_of_steps_do_not_drift():
    tables = random_tables((4,), (True,), steps=3000, seed=22)
    filtering = Filter()
    for now in complete(tables, torch.tensor([3000])).steps():
        belief = filtering.predict(now)
        filtering.update(now.emission)
    assert float(belief[0].sum()) == pytest.approx(1.0, abs=1e-12)
    torch.testing.assert_close(filtering.log_likelihood, log_likelihood(tables, torch.tensor([3000])))


def test_updates_without_a_possible_control_are_refused():
    (now,) = complete(random_tables((2,), (False,), steps=1), torch.tensor([1])).steps()
    filtering = Filter()
    filtering.predict(now)
    with pytest.raises(ValueError, match="probability 0 under every choice"):
        filtering.update(torch.full_like(now.emission, NEVER))


# --- what is refused, and what is taken ---------------------------------------------------------------------


DOOR = {
    "fused": lambda *given: inference.log_likelihood(*given, engine="fused"),
    "enumerate": lambda *given: inference.log_likelihood(*given, engine="enumerate"),
    "posterior": inference.posterior,
    "most_likely_path": inference.most_likely_path,
    "segment": inference.segment,
    "sample_paths": inference.sample_paths,
}
LENGTHS = {
    "one for three": (torch.tensor([5]), r"lengths: there are 3 trajectories; got int64 \[1\]"),
    "longer": (torch.tensor([5, 8, 1]), "lengths: trajectory 1 has 8 steps; the tables hold 1 to 5"),
    "negative": (torch.tensor([5, 4, -1]), "lengths: trajectory 2 has -1 steps"),
    "mask": (torch.tensor([True, True, True]), "lengths: give a tensor of integers"),
    "list": ([5, 4, 3], "lengths: give a tensor of integers, one for each trajectory; got list"),
}
SHORT = r"termination\[1\]: expected floating-point numbers \[3, 5, 2, 2\]; got float64 \[3, 4, 2, 2\]"
CALLERS = r"selection\[1\]: expected \[N, T, callers, 1 \+ options\]"
LEVELS = "control: tables with 2 levels of selections need 3; got 0"
NAN = r"control\[0\]: a log-probability of trajectory 1 at step 3 is NaN or \+inf"
TABLES = {
    "short termination": (lambda t: _changed(t, "termination", 1, t.termination[1][:, :4]), SHORT),
    "no callers": (lambda t: _changed(t, "selection", 1, t.selection[1][:, :, 0]), CALLERS),
    "no control": (lambda t: replace(t, control=()), LEVELS),
    "evidence of one level": (lambda t: replace(t, evidence=(None,)), r"evidence: .* need 2; got 1"),
    "NaN": (lambda t: _changed(t, "control", 0, _with(t.control[0], (1, 3, 0), torch.nan)), NAN),
}


def _changed(tables, name, level, table):
    own = getattr(tables, name)
    return replace(tables, **{name: (*own[:level], table, *own[level + 1 :])})


def _with(table, place, value):
    table = table.clone()
    table[place] = value
    return table


def _tables(counts=(2, 2), steps=5):
    return random_tables(counts, (True,) * len(counts), trajectories=3, steps=steps, seed=31)


@pytest.mark.parametrize("function", DOOR)
@pytest.mark.parametrize("case", LENGTHS)
def test_lengths_that_are_none_are_refused(function, case):
    lengths, says = LENGTHS[case]
    for counts in ((), (2,), (2, 2)):
        with pytest.raises(BadInput, match=says):
            DOOR[function](_tables(counts), lengths)


@pytest.mark.parametrize("function", DOOR)
@pytest.mark.parametrize("case", TABLES)
def test_tables_that_do_not_go_together_are_refused(function, case):
    change, says = TABLES[case]
    with pytest.raises(BadInput, match=says):
        DOOR[function](change(_tables()), torch.tensor([5, 4, 3]))


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8])
def test_lengths_of_any_integer_type_and_anything_beyond_them_are_taken(dtype):
    tables, lengths = _tables(steps=3), torch.tensor([3, 2, 1], dtype=dtype)
    truth = [brute_force(tables, n, int(length)).log_likelihood for n, length in enumerate(lengths)]
    past = torch.arange(3) >= lengths[:, None]
    for leaf in tables.leaves():
        leaf[past] = torch.nan
    for engine in ("fused", "enumerate"):
        np.testing.assert_allclose(inference.log_likelihood(tables, lengths, engine), truth, atol=1e-9)
    path = inference.most_likely_path(tables, lengths)
    assert torch.equal(path.choices[0] < 0, past)


@pytest.mark.parametrize("counts", [(2,), (2, 2), (1, 2, 1)])
@pytest.mark.parametrize("levels", ["all", "lowest", "highest"])
def test_the_gradient_of_the_evidence_is_that_of_differences(counts, levels):
    """Where evidence of one level alone is known, or of all, in both engines."""
    tables, lengths = random_tables(counts, (True,) * len(counts), 2, 3, seed=32), torch.tensor([3, 2])
    known = {"all": range(len(counts)), "lowest": [0], "highest": [len(counts) - 1]}[levels]
    generator = torch.Generator().manual_seed(33)

    def given(level):
        return torch.randn(2, 3, 1 + counts[level], generator=generator, dtype=torch.float64).requires_grad_()

    evidence = tuple(given(level) if level in known else None for level in range(len(counts)))
    leaves = [own for own in evidence if own is not None]
    gradients = {}
    for engine in ("fused", "enumerate"):
        value = inference.log_likelihood(replace(tables, evidence=evidence), lengths, engine).sum()
        gradients[engine] = torch.autograd.grad(value, leaves)
    step = 1e-5
    for number, leaf in enumerate(leaves):
        differences = torch.zeros_like(leaf)
        for place in np.ndindex(*leaf.shape):
            sides = []
            for sign in (1, -1):
                with torch.no_grad():
                    leaf[place] += sign * step
                    changed = replace(tables, evidence=evidence)
                    sides.append(float(inference.log_likelihood(changed, lengths).sum()))
                    leaf[place] -= sign * step
            differences[place] = (sides[0] - sides[1]) / (2 * step)
        for engine in gradients:
            torch.testing.assert_close(gradients[engine][number], differences, atol=1e-8, rtol=0, msg=engine)


@pytest.mark.parametrize("counts", [(2,), (2, 2)])
def test_an_impossible_trajectory_has_a_likelihood_of_zero_and_no_posterior(counts):
    tables = _tables(counts, steps=3)
    for table in tables.control:
        table[1, 2] = NEVER  # no caller can have emitted this control
    lengths = torch.tensor([3, 3, 3])
    possible = brute_force(tables, 0, 3).log_likelihood
    for engine in ("fused", "enumerate"):
        value = inference.log_likelihood(tables, lengths, engine)
        assert value[1] == NEVER
        assert float(value[0]) == pytest.approx(possible)
    for function in ("posterior", "most_likely_path", "segment", "sample_paths"):
        with pytest.raises(BadInput, match=r"trajectory 1 has probability 0 .* no posterior"):
            DOOR[function](tables, lengths)
        DOOR[function](tables, torch.tensor([3, 2, 3]))  # the step is past the end


def test_the_eliminated_model_refuses_lengths_and_controls_of_others():
    hierarchy, batch = make_hierarchy((3,)), make_batch()
    with torch.no_grad():
        outputs = hierarchy(batch.inputs)
    own = batch.lengths
    for wrong in (own[:1], own + 100, own - own, own.double()):
        with pytest.raises(BadInput, match="lengths"):
            EliminatedAHMM(outputs, wrong)
    distribution = EliminatedAHMM(outputs, batch.lengths)
    with pytest.raises(BadInput, match="controls: expected the shape"):
        distribution.log_prob(batch.actions[:1])
    with pytest.raises(BadInput, match="NaN"):
        distribution.log_prob(batch.actions * torch.nan)
