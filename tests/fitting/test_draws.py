"""Draws of options against sums over every path, the posterior marginals, and exact boundaries."""

import itertools
from collections import Counter
from copy import deepcopy

import numpy as np
import pytest
import torch
from hierarchies import make_hierarchy
from oracle import brute_force, paths
from random_demonstrations import of_states
from scipy import stats

from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.inferred import infer
from ddco_pyro.fitting.draws import Boundary, Draws, draw, matched
from ddco_pyro.inference import sample_paths
from ddco_pyro.model.tables import NEVER, Tables

LENGTHS = (4, 2, 3)


def drawn(hierarchy, demos, draws, seed=0, chains=1) -> Draws:
    levels = enumerate(hierarchy.levels, 1)
    names = {f"level-{d}": ("control", *"abcdefg"[: level.count]) for d, level in levels}
    models = [infer(hierarchy, demos) for _ in range(chains)]
    return draw(models, names, list(range(chains)), draws, seed)


@pytest.mark.parametrize(("counts", "steps"), [((3,), 4), ((2, 1), 3), ((1, 2, 1), 2)])
def test_draws_have_the_probabilities_of_the_paths(counts, steps) -> None:
    """Whole paths of all levels, and u, v and w, by chi-square with the counts of a sum over every path."""
    hierarchy, draws = make_hierarchy(counts, ("options", "control")), 3000
    demos = of_states((steps, steps - 1))
    found = drawn(hierarchy, demos, draws)
    (piece,) = infer(hierarchy, demos)
    assert found.log_likelihood == pytest.approx(piece.log_likelihood[None])
    for n, length in ((0, steps), (1, steps - 1)):
        kinds = [found.options.values(), found.starts.values()]
        options, starts = (np.stack([level[0, :, n, :length] for level in kind], -1) for kind in kinds)
        pairs = zip(options, starts, strict=True)
        seen = Counter((tuple(map(tuple, h)), tuple(map(tuple, b))) for h, b in pairs)
        sizes = [1 + count for count in counts]
        exact = {(h, b): p for h, b, p in paths(piece.tables, n, length, sizes) if p > 0}
        total = sum(exact.values())
        assert set(seen) <= set(exact)
        _agree(np.array([seen[path] for path in exact]), np.array(list(exact.values())) / total, draws)
    truth = brute_force(piece.tables, 0, steps)
    for level, (h, b) in enumerate(zip(found.options.values(), found.starts.values(), strict=True)):
        h, b, each = h[0, :, 0], b[0, :, 0], np.arange(1 + counts[level])
        for t in range(steps):
            _agree((h[:, t, None] == each).sum(0), truth.u[level][t], draws)
            _agree((b[:, t, None] & (h[:, t, None] == each)).sum(0), truth.v[level][t], draws)
            if t + 1 < steps:
                _agree((~b[:, t + 1, None] & (h[:, t, None] == each)).sum(0), truth.w[level][t], draws)


def _agree(counts: np.ndarray, probabilities: np.ndarray, draws: int) -> None:
    """The counts fit the probabilities; what is rare, or left over, is one further class."""
    common = probabilities * draws > 5
    observed, expected = counts[common], probabilities[common] * draws
    rest = draws - expected.sum()
    if rest > 1e-6 * draws:
        observed, expected = np.append(observed, draws - observed.sum()), np.append(expected, rest)
    if len(expected) > 1:
        assert stats.chisquare(observed, expected, sum_check=False).pvalue > 1e-4


def test_a_demonstrations_draws_depend_on_its_place_and_the_seed_alone() -> None:
    hierarchy, lengths = make_hierarchy((3,)), (40, 7, 30)
    whole = drawn(hierarchy, of_states(lengths), 6, 1).options["level-1"]
    some = drawn(hierarchy, of_states(lengths[:2]), 6, 1).options["level-1"]
    other = drawn(hierarchy, of_states(lengths), 6, 2).options["level-1"]
    np.testing.assert_array_equal(whole[:, :, :2], some)
    assert not np.array_equal(whole, other)
    assert not np.array_equal(whole[:, 0], whole[:, 1])
    both = drawn(hierarchy, of_states(lengths), 6, 1, chains=2).options["level-1"]
    np.testing.assert_array_equal(both[:1], whole)
    assert not np.array_equal(both[0], both[1])


# --- chains -------------------------------------------------------------------------------------------------


def test_a_model_with_other_numbers_is_numbered_like_the_first() -> None:
    hierarchy, demos, order = make_hierarchy((3,), network="linear"), of_states((60, 50)), [2, 0, 1]
    other = deepcopy(hierarchy)
    with torch.no_grad():
        level = other.levels[0]
        for parameter in (*level.policy.parameters(), *level.termination.parameters()):
            parameter[:] = parameter[order] if len(parameter) == 3 else parameter
        for parameter in other.meta_policy.parameters():
            parameter[:] = parameter[..., order] if parameter.shape[-1] == 3 else parameter
    pieces = [next(iter(infer(model, demos))) for model in (hierarchy, other)]
    assert pieces[1].log_likelihood == pytest.approx(pieces[0].log_likelihood)  # the same model
    u = pieces[0].posterior.u[0]
    other, ordered = pieces[1].posterior.u[0][..., 1:], u[..., [1 + own for own in order]]
    torch.testing.assert_close(other, ordered, atol=1e-5, rtol=0)
    names = {"level-1": ("control", "a", "b", "c")}
    found = draw([[piece] for piece in pieces], names, [0, 7], 400, 0)
    assert found.seeds == (0, 7)
    for option in (1, 2, 3):
        shares = (found.options["level-1"] == option).mean((1, 2, 3))
        assert shares[0] == pytest.approx(float(u[..., option].sum()) / 120, abs=0.02)
        assert shares[1] == pytest.approx(shares[0], abs=0.02)


def test_options_are_matched_as_well_as_can_be() -> None:
    random = np.random.default_rng(0)
    parts = [torch.from_numpy(random.dirichlet(np.ones(5), size=30)) for _ in range(4)]
    ours, theirs = parts[:2], parts[2:]
    (order,) = matched(ours, theirs, [5])
    both = (torch.cat(ours).T @ torch.cat(theirs)).numpy()
    orders = itertools.permutations(range(1, 5))
    best = max(orders, key=lambda each: sum(both[a, b] for b, a in enumerate(each, 1)))
    assert order.tolist() == [0, *best]


# --- boundaries ---------------------------------------------------------------------------------------------


def test_the_interval_holds_the_exact_mass_of_one_switch() -> None:
    """Option 1 gives way to option 2 once, at step τ: p(τ) ∝ ψ (1 − ψ)^(τ − 1) Π p(a_t | h_t)."""
    steps = 9
    selection = torch.tensor([NEVER, NEVER, 0.0]).expand(1, steps, 1, 3).clone()
    selection[:, 0] = torch.tensor([NEVER, 0.0, NEVER])
    ending = torch.tensor([[0.8, 0.2], [1.0, 0.0]]).double().log().expand(1, steps, 2, 2)
    evidence = np.array([2.0, 1.5, 1.0, 0.4, 0.1, -0.3, -1.0, -1.6, -2.0]) / 2
    control = torch.from_numpy(np.stack([evidence, -evidence], -1)[None])
    tables = Tables((selection.double(),), (ending,), (control, torch.full((1, steps, 1), NEVER).double()))
    gains = [np.exp(evidence[:t].sum() - evidence[t:].sum()) for t in range(steps)]
    exact = np.array([0.2 * 0.8 ** (t - 1) * gain if t else 0.0 for t, gain in enumerate(gains)])
    stays = 0.8 ** (steps - 1) * np.exp(evidence.sum())
    total = exact.sum() + stays
    exact /= exact.sum()
    path = sample_paths(tables, torch.tensor([steps]), 20_000)
    options, starts = (kind[0][:, :, None].numpy()[None][:, :, 0] for kind in path)
    known = (np.zeros((1, 1)), ("demo_0",), {"option": "cab"}, (0,))
    draws = Draws({"option": options}, {"option": starts == 1}, *known)
    step = int(exact.argmax())
    path = np.where(np.arange(steps) < step, 1, 2)
    (found,) = draws.boundaries("option", 0, path)
    assert found.step == step
    assert found.probability == pytest.approx(1 - stays / total, abs=0.01)
    assert exact[found.low : found.high + 1].sum() >= 0.9 - 0.01
    for tail in (exact[: found.low].sum(), exact[found.high + 1 :].sum()):
        assert tail <= 0.05 + 0.01
    assert exact[: found.low + 1].sum() >= 0.05 - 0.01  # and it is not wider
    assert exact[found.high :].sum() >= 0.05 - 0.01
    (narrow,) = draws.boundaries("option", 0, path, mass=0.3)
    assert found.low <= narrow.low <= narrow.high <= found.high


def test_a_boundary_is_looked_for_between_its_neighbours_and_with_its_options() -> None:
    each = [
        [1, 1, 1, 2, 2, 2, 1, 1],  # both, the second one earlier
        [1, 1, 2, 2, 2, 2, 2, 1],
        [1, 1, 1, 1, 1, 1, 1, 1],
        [1, 1, 3, 3, 2, 2, 1, 1],  # the first is of other options
    ]
    options = np.array(each, dtype=np.int8)[None, :, None]
    options = np.concatenate([options, np.full((1, 4, 1, 2), -1, np.int8)], -1)
    starts = np.diff(options, prepend=-1) != 0
    known = (np.zeros((1, 1)), ("demo_0",), {"option": "cab"}, (0,))
    draws = Draws({"option": options}, {"option": starts}, *known)
    path = np.array([1, 1, 1, 2, 2, 2, 2, 1, -1, -1])
    assert draws.boundaries("option", 0, path, mass=1.0) == [Boundary(3, 2, 3, 0.5), Boundary(7, 6, 7, 0.75)]
    again = np.array([1, 0, 1, 0, 0, 0, 0, 0, 0, 0], dtype=bool)
    same = np.full(10, 1)
    starts[0, 1, 0] = again  # option 1 is selected anew at step 2 of one draw
    options[0, 1] = 1
    assert draws.boundaries("option", 0, same, again)[0] == Boundary(2, 2, 2, 0.25)
    assert draws.boundaries("option", 0, np.full(8, 3), np.eye(8, dtype=bool)[4])[0] == Boundary(4, 4, 4, 0.0)


# --- files of others ----------------------------------------------------------------------------------------


def test_a_data_tree_holds_the_draws_by_name() -> None:
    pytest.importorskip("xarray")
    found = drawn(make_hierarchy((2, 3)), of_states(LENGTHS), 5, chains=2)
    tree = found.to_datatree()
    option = tree["posterior"]["level-2"]
    assert option.dims == ("chain", "draw", "demonstration", "step")
    assert option.dtype == np.int8
    one = option.sel(demonstration="demo_2", chain=1, draw=3)
    np.testing.assert_array_equal(one, found.options["level-2"][1, 3, 2])
    assert one.isel(step=3) == -1
    assert tree["posterior"]["level-2_name"].values.tolist() == ["control", "a", "b", "c"]
    assert tree["posterior"].training_seed.values.tolist() == [0, 1]
    likelihood = tree["log_likelihood"]["control"].sel(demonstration="demo_1")
    np.testing.assert_array_equal(likelihood, found.log_likelihood[:, 1])


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, toy_run) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(BadInput, match=r"pip install 'ddco-pyro\[xarray\]'"):
        drawn(make_hierarchy((2,)), of_states(LENGTHS), 2).to_datatree()
    with pytest.raises(BadInput, match="is a flat policy without options"):
        toy_run.baselines["flat"].draws(toy_run.demonstrations)
