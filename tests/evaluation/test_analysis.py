"""Use of options and paired differences, against counts made by hand."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from oracle import brute_force, predictions, random_tables
from planted import LINEAR, small_spec
from random_demonstrations import numbered
from scipy import stats

from ddco_pyro.evaluation.options import Finding, diagnose, divergences, option_use, segments_of
from ddco_pyro.fitting.evaluation import decompose
from ddco_pyro.inference import Posterior, posterior
from ddco_pyro.metrics import Alike, Segments, Use
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.emissions.gaussian import Gaussian
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.spec import TrainingSpec
from ddco_pyro.statistics import paired
from ddco_pyro.training.networks import Dimensions


def test_use_of_options_by_sums_over_every_path():
    tables = random_tables((2,), (True,), trajectories=2, steps=4, seed=1)
    lengths = [4, 3]
    truths = [brute_force(tables, n, length) for n, length in enumerate(lengths)]
    paths = [[np.array([1, 1, 2, 1]), np.array([2, 0, 0, -1])]]
    (found,) = option_use(posterior(tables, torch.tensor(lengths)), paths)
    u = sum(truth.u[0].sum(0) for truth in truths)
    v = sum(truth.v[0].sum(0) for truth in truths)
    for choice, one in enumerate(found):
        assert one.choice == choice
        assert one.share == pytest.approx(u[choice] / 7)
        assert one.selected == pytest.approx(v[choice])
        expected = sum(min(1.0, truth.v[0].sum(0)[choice]) for truth in truths)
        assert one.demonstrations == pytest.approx(expected)
        assert one.duration == pytest.approx(u[choice] / v[choice])
    assert found[0].duration == pytest.approx(1)  # control lasts one step
    assert [(one.segments, one.steps, one.length) for one in found] == [(1, 2, 2), (2, 3, 1.5), (2, 2, 1)]


def use(*demonstrations, size=0):
    """The use of options under a certain posterior: of each demonstration, segments ``(option, steps)``."""
    size = size or 1 + max(option for segments in demonstrations for option, _ in segments)
    steps = max(sum(length for _, length in segments) for segments in demonstrations)
    active, selected = (torch.zeros(len(demonstrations), steps, size, dtype=torch.float64) for _ in range(2))
    for row, segments in enumerate(demonstrations):
        start = 0
        for option, length in segments:
            active[row, start : start + length, option] = 1
            selected[row, start, option] = 1
            start += length
    runs = [[np.full(length, option) for option, length in segments] for segments in demonstrations]
    paths = [[np.concatenate(own) for own in runs]]
    return option_use(Posterior((active,), (selected,), (active,)), paths)


def test_an_option_that_is_never_selected_has_no_duration():
    _, first, second, never = use([(1, 2), (2, 3)], size=4)[0]
    assert [(one.share, one.duration, one.length, one.segments) for one in (first, second, never)] == [
        (0.4, 2, 2, 1), (0.6, 3, 3, 1), (0, None, None, 0)
    ]  # fmt: skip


@pytest.fixture
def hybrid():
    """Three callers that choose among control and two options below, in two trajectories of four steps."""
    random = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 4, 3, 3, generator=random, dtype=torch.float64)
    mean = torch.randn(2, 4, 3, 2, generator=random, dtype=torch.float64)
    u = torch.rand(2, 4, 4, generator=random, dtype=torch.float64)
    std = torch.tensor([0.5, 2.0], dtype=torch.float64)
    return CallerOutputs(2, logits, Gaussian(mean, std, torch.zeros(2))), u


def act(decision, n, t, i):
    """The distribution of what caller i does at a step: (choices' probabilities, control's Gaussian)."""
    control = torch.distributions.Normal(decision.emission.mean[n, t, i], decision.emission.std)
    return torch.distributions.Categorical(logits=decision.selection[n, t, i]), control


def test_divergences_are_mean_kullback_leibler_divergences_in_both_directions(hybrid):
    decision, u = hybrid
    (found,) = divergences([(Outputs((decision, decision), ()), Posterior((u,), (u,), (u,)))])
    assert [one.options for one in found] == [(1, 2), (1, 3), (2, 3)]
    kl = torch.distributions.kl_divergence
    for one in found:
        i, j = (option - 1 for option in one.options)
        total = weights = 0.0
        for n, t in np.ndindex(2, 4):
            (p, f), (q, g) = act(decision, n, t, i), act(decision, n, t, j)
            there = kl(p, q) + p.probs[0] * kl(f, g).sum()
            back = kl(q, p) + q.probs[0] * kl(g, f).sum()
            weight = u[n, t, i + 1] + u[n, t, j + 1]
            total, weights = total + weight * (there + back) / 2, weights + weight
        assert one.divergence == pytest.approx(float(total / weights))


def test_divergences_of_policies_that_emit_one_kind_of_thing(hybrid):
    decision, u = hybrid
    same = Posterior((u,), (u,), (u,))
    apart = (decision.emission.mean[:, :, 0] - decision.emission.mean[:, :, 1]) / decision.emission.std
    weight = u[..., 1] + u[..., 2]
    (found,) = divergences([(Outputs((CallerOutputs(0, None, decision.emission), decision), ()), same)])
    expected = (weight * apart.square().sum(-1) / 2).sum() / weight.sum()
    assert found[0].divergence == pytest.approx(float(expected))
    options = decision.logits[..., 1:]
    (found,) = divergences([(Outputs((CallerOutputs(2, options, None), decision), ()), same)])
    p, q = (options[:, :, i].log_softmax(-1) for i in (0, 1))
    both = ((p.exp() - q.exp()) * (p - q)).sum(-1) / 2
    assert found[0].divergence == pytest.approx(float((weight * both).sum() / weight.sum()))
    never = torch.zeros_like(u)
    (found,) = divergences([(Outputs((decision, decision), ()), Posterior((never,), (never,), (never,)))])
    assert found[0].divergence is None


def test_a_paired_difference_is_the_ratio_of_sums():
    ours, theirs, lengths = np.array([10.0, 4.0, 6.0]), np.array([8.0, 5.0, 3.0]), np.array([5.0, 2.0, 3.0])
    assert paired(ours, theirs, lengths).nats_per_step == pytest.approx(4 / 10)
    assert paired(ours[:1], theirs[:1], lengths[:1]).standard_error is None  # one alone has none


def test_its_error_covers_the_truth_as_often_as_it_says():
    """Repeated draws of demonstrations of unequal length: the estimate's spread is the standard error."""
    random = np.random.default_rng(2)
    found = []
    for _ in range(400):
        lengths = random.integers(5, 40, 60).astype(float)
        found.append(paired(0.5 * lengths + random.normal(0, np.sqrt(lengths)), np.zeros(60), lengths))
    means = np.array([one.nats_per_step for one in found])
    errors = np.array([one.standard_error for one in found])
    assert means.std(ddof=1) == pytest.approx(errors.mean(), rel=0.1)
    assert abs(means.mean() - 0.5) < 4 * means.std() / math.sqrt(400)


# --- the parts of a log-likelihood --------------------------------------------------------------------------


LENGTHS = (3, 2)


RANDOM = np.random.default_rng(0)
DEMOS = numbered(
    ({"pose": RANDOM.normal(size=(steps, 2))}, RANDOM.normal([5, 0.5, 0], [3, 0, 0.1], (steps, 3)))
    for steps in LENGTHS
)
"""Of three control dimensions, the second of them constant."""


def make(counts: tuple[int, ...], emits: tuple[str, ...]) -> Hierarchy:
    """Random networks that differ between options; σ of each level is its own."""
    above = LINEAR | {"emits": list(emits)}
    policies = [above if d else LINEAR for d in range(len(counts))]
    each = enumerate(zip(counts, policies, strict=True))
    levels = [{"name": f"level-{d}", "count": k, "policy": policy} for d, (k, policy) in each]
    options = {"hierarchy": {"levels": levels, "meta_policy": above}} if counts else {}
    spec = small_spec(counts, observations=["pose"], control={"std": {"learn": True}}, **options)
    torch.manual_seed(1)
    hierarchy = Hierarchy(spec, replace(Dimensions.of(DEMOS), control=()))
    hierarchy.encoder.fit(DEMOS)
    hierarchy.scaling.fit(DEMOS)
    with torch.no_grad():
        for parameter in hierarchy.parameters():
            parameter.add_(torch.randn_like(parameter))
    return hierarchy.eval()


BOTH = ("options", "control")
HIERARCHIES = [((), ("control",)), ((3,), ("options",)), ((2,), BOTH), ((2, 2), BOTH)]
NAMES = ["flat", "options", "hybrid", "two hybrid levels"]


@pytest.mark.parametrize(("counts", "emits"), HIERARCHIES, ids=NAMES)
def test_parts_are_those_of_every_path_so_far(counts: tuple[int, ...], emits: tuple[str, ...]) -> None:
    hierarchy = make(counts, emits)
    batch = encode(DEMOS, hierarchy.encoder, hierarchy.scaling)
    with torch.no_grad():
        outputs = hierarchy(batch.inputs).map(torch.Tensor.double)
    by_dimension, of_options = decompose(outputs, batch)
    assert by_dimension.shape == (2, 2)
    tables = outputs.tables(batch.actions.double())
    for n, length in enumerate(LENGTHS):
        densities = _densities(hierarchy, outputs, batch, n)
        dimensions, options = np.zeros(2), 0.0
        for t, step in enumerate(predictions(tables, n, length)):
            for choices, before in step.probability.items():
                given = densities[_actor(choices)][t]  # [A']
                after = before * math.exp(given.sum() - step.value)
                dimensions += after * given
                options += after * (math.log(before) - math.log(after))
        np.testing.assert_allclose(by_dimension[n], dimensions, rtol=1e-9)
        np.testing.assert_allclose(of_options[n], options, rtol=1e-9, atol=1e-12)
        assert of_options[n] < 0 if counts else of_options[n] == 0


def _actor(choices: tuple[int, ...]) -> tuple[int, int]:
    """Level and option of who emits the control: the lowest choice that is not 0, else the meta-policy."""
    return next(((level, choice - 1) for level, choice in enumerate(choices) if choice), (len(choices), 0))


def _densities(hierarchy: Hierarchy, outputs: Outputs, batch: Batch, n: int):
    """log N(a_td; μ_d, σ_d²) of each caller, [T, A'], with scipy and in the control's own units."""
    shift, scale = hierarchy.scaling.shift.numpy(), hierarchy.scaling.scale.numpy()

    def units(scaled: torch.Tensor) -> np.ndarray:
        return scaled.detach().double().numpy() * scale + shift

    actions = units(batch.actions[n, : LENGTHS[n]])
    return {
        (level, option): stats.norm.logpdf(
            actions, units(emission.mean[n, : LENGTHS[n], option]), emission.std.detach().numpy() * scale
        )
        for level, emission in enumerate(outputs.emissions)
        if emission is not None
        for option in range(emission.mean.shape[2])
    }


# --- signs of a degenerate solution -------------------------------------------------------------------------


def level(*shares, durations=None):
    """Options that are selected ten times in each of two demonstrations."""
    durations = durations or [5.0] * len(shares)
    alike = {"selected": 20.0, "demonstrations": 2.0, "having": 2, "within": None}
    each = enumerate(zip(shares, durations, strict=True))
    return [Use.model_construct(choice=n, share=share, duration=own, **alike) for n, (share, own) in each]


def short(option, selections, duration=1.0):
    return Finding("never_persisting", 1, option, duration, times=selections)


def whole(option, having, share=1.0):
    return Finding("whole", 1, option, share, times=having)


def lasting(duration):
    return [level(0.0, 0.5, 0.5, durations=[None, duration, 5.0])]


UNUSED = Finding("unused", 1, 1, 0.001)


@pytest.mark.parametrize(
    ("levels", "found"),
    [
        ([level(0.0, 0.0099, 0.5, 0.4901)], [Finding("unused", 1, 1, 0.0099)]),
        ([level(0.0, 0.01, 0.5, 0.49)], []),
        ([level(0.0, 0.1, 0.9)], []),
        ([level(0.0, 0.099, 0.901)], [Finding("dominating", 1, 2, 0.901)]),
        ([level(0.0, 1.0)], []),  # a single option cannot dominate
        (lasting(1.49), [short(1, 10.0, 1.49)]),
        (lasting(1.5), []),
        ([level(0.5, 0.25, 0.25, durations=[1.0, 5.0, 5.0])], []),
        ([level(0.51, 0.245, 0.245, durations=[1.0, 5.0, 5.0])], [Finding("high_fitting", 1, 0, 0.51)]),
        # an unused option is not also said to be short
        ([level(0.0, 0.001, 0.4995, 0.4995, durations=[None, 1.0, 5.0, 5.0])], [UNUSED]),
        # the meta-policy does all the work of option 1, which ends at once and is selected again; option 2
        # lasts
        (use(*[[(1, 1)] * 6 + [(2, 6)]] * 4), [short(1, 6.0)]),
        # the first reach of every demonstration, and a grasp: each is selected once and ends by design
        (use(*[[(1, 1), (2, 6), (3, 1), (2, 7)]] * 4), []),
        # one demonstration in ten flickers; that it is not in the others is no excuse
        (use([(1, 1)] * 10, *[[(2, 5), (3, 5)]] * 9), [whole(1, 1), short(1, 10.0)]),
        (use([(1, 9)], [(1, 9), (2, 1)], [(2, 5), (3, 5)]), [whole(1, 2, 18 / 19)]),
        (use([(1, 4)], [(1, 3), (2, 1)], [(2, 2), (3, 2)]), []),  # 7 of 8 steps
    ],
)
def test_signs_of_a_degenerate_solution(levels, found):
    assert diagnose(levels) == found


@pytest.mark.parametrize(
    ("lengths", "rate", "brief"),
    [
        ([4] * 6, None, True),
        ([5] * 6, None, False),
        ([4] * 5, None, False),  # too few to be said to switch
        ([3] * 7 + [60] * 6, None, True),
        ([3] * 6 + [60] * 7, None, False),
        ([24] * 6, 50.0, True),
        ([25] * 6, 50.0, False),
        ([5] * 79, None, True),  # 395 steps: a fiftieth is 7.9
        ([5] * 79, 10.0, False),
        ([8] * 39 + [40] * 40, None, False),  # a fiftieth is 38
    ],
)
def test_options_that_switch_all_the_time_are_a_sign(lengths, rate, brief):
    """Half a second where the rate is known, else five steps, or a fiftieth of a demonstration if longer."""
    path = np.concatenate([np.full(steps, 1 + n % 2) for n, steps in enumerate(lengths)])
    segments = segments_of([path, path], rate)
    least = 0.5 * rate if rate else max(5, len(path) / 50)
    twitches = sum(steps < least for steps in lengths)
    numbers = (np.median(lengths), 2 * len(lengths), 2 * twitches)
    assert (segments.median, segments.number, segments.twitches) == numbers
    found = [one for one in diagnose([level(0.0, 0.5, 0.5)], segments=[segments]) if one.kind == "brief"]
    assert found == (
        [Finding("brief", 1, 0, float(np.median(lengths)), times=twitches / len(lengths))] if brief else []
    )


@pytest.mark.parametrize(("demonstrations", "found"), [(100, True), (48, True), (47, False)])
def test_an_option_of_most_steps_of_some_demonstrations_is_a_sign(demonstrations, found):
    """Two thirds count where no more than half of the demonstrations have the option."""
    own = use([(1, 300), (2, 130)], [(2, 40)])[0]
    own[1] = own[1].model_copy(update={"having": 24})
    segments = Segments(median=100, number=200, demonstrations=demonstrations, twitches=0)
    signs = diagnose([own], segments=[segments])
    assert [one.kind for one in signs] == (["whole"] if found else [])


LABELLED = {"starts": ["equal_parts"], "labels": {"level": "option", "from": "phase"}}
ADVISED = [
    ({"starts": [start]}, start != "vq_controls") for start in ("equal_parts", "random", "vq_controls")
]


@pytest.mark.parametrize(("training", "clusters"), [*ADVISED, (LABELLED, False)])
def test_clusters_are_advised_where_nothing_like_them_starts(
    training: dict[str, Any], clusters: bool
) -> None:
    for kind in ("unused", "redundant", "dominating"):
        advice = Finding(kind, 1, 1, 0.0).advice(TrainingSpec.model_validate(training))
        assert ("clusters" in advice) == clusters


def pair(first, second, divergence):
    return Alike(options=(first, second), divergence=divergence)


@pytest.mark.parametrize(
    ("share", "divergence", "found"),
    [
        (0.3, 0.0999, [Finding("redundant", 1, 3, 0.0999, other=1)]),
        (0.3, 0.1, []),
        (0.001, 0.0, [Finding("unused", 1, 1, 0.001)]),  # and not also redundant
    ],
)
def test_redundant_below_a_tenth_of_a_nat(share, divergence, found):
    alike = [pair(1, 2, 3.0), pair(1, 3, divergence), pair(2, 3, 4.0)]
    assert diagnose([level(0.0, share, 0.5, 0.5 - share)], [alike]) == found


def test_control_by_a_caller_above_does_not_count_for_the_one_below():
    upper = level(0.6, 0.2, 0.2)
    lower = level(0.7, 0.15, 0.15)  # the upper options emit control in 0.1 of the 0.4 in which they act
    assert [(one.kind, one.level) for one in diagnose([lower, upper])] == [("high_fitting", 2)]
