"""Use of options and paired differences, against counts made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.evaluation.options import divergences, option_use
from ddco_pyro.evaluation.worth import paired
from ddco_pyro.inference import Posterior, posterior
from ddco_pyro.model.emissions import Gaussian
from ddco_pyro.model.outputs import CallerOutputs, Outputs


def test_use_of_options_by_sums_over_every_path():
    tables = random_tables((2,), (True,), trajectories=2, steps=4, seed=1)
    lengths = [4, 3]
    truths = [brute_force(tables, n, length) for n, length in enumerate(lengths)]
    (found,) = option_use(posterior(tables, torch.tensor(lengths)))
    u = sum(truth.u[0].sum(0) for truth in truths)
    v = sum(truth.v[0].sum(0) for truth in truths)
    for choice, one in enumerate(found):
        assert one.choice == choice
        assert one.share == pytest.approx(u[choice] / 7)
        assert one.selected == pytest.approx(v[choice])
        assert one.demonstrations == pytest.approx(sum(min(1.0, truth.v[0].sum(0)[choice]) for truth in truths))
        assert one.duration == pytest.approx(u[choice] / v[choice])
    assert found[0].duration == pytest.approx(1)  # control lasts one step


def test_an_option_that_is_never_selected_has_no_duration():
    """Active for the steps 1 1 2 2 2 of one trajectory, selected at 0 and 2; then padding."""
    active = torch.tensor([[[0, 1, 0, 0]] * 2 + [[0, 0, 1, 0]] * 3 + [[0, 0, 0, 0]]], dtype=torch.float64)
    chosen = active.clone()
    chosen[0, [1, 3, 4]] = 0
    (found,) = option_use(Posterior((active,), (chosen,), (active,)))
    assert [dict(one) for one in found] == [
        {"choice": 0, "share": 0.0, "selected": 0.0, "demonstrations": 0.0, "duration": None},
        {"choice": 1, "share": 0.4, "selected": 1.0, "demonstrations": 1.0, "duration": 2.0},
        {"choice": 2, "share": 0.6, "selected": 1.0, "demonstrations": 1.0, "duration": 3.0},
        {"choice": 3, "share": 0.0, "selected": 0.0, "demonstrations": 0.0, "duration": None},
    ]


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
    """The distribution of what caller i does at a step: (probabilities of the choices, Gaussian of the control)."""
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
    assert found[0].divergence == pytest.approx(float((weight * apart.square().sum(-1) / 2).sum() / weight.sum()))
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
    found = paired(ours, theirs, lengths)
    assert found.nats_per_step == pytest.approx(4 / 10)


def test_with_equal_lengths_its_error_is_that_of_the_mean():
    random = np.random.default_rng(1)
    difference = random.normal(3, 2, 40)
    found = paired(difference, np.zeros(40), np.full(40, 7.0))
    assert found.nats_per_step == pytest.approx(difference.mean() / 7)
    assert found.standard_error == pytest.approx(difference.std(ddof=1) / math.sqrt(40) / 7)


def test_its_error_covers_the_truth_as_often_as_it_says():
    """Repeated draws of demonstrations of unequal length: the spread of the estimate is the standard error."""
    random = np.random.default_rng(2)
    found = []
    for _ in range(400):
        lengths = random.integers(5, 40, 60).astype(float)
        found.append(paired(0.5 * lengths + random.normal(0, np.sqrt(lengths)), np.zeros(60), lengths))
    means = np.array([one.nats_per_step for one in found])
    errors = np.array([one.standard_error for one in found])
    assert means.std(ddof=1) == pytest.approx(errors.mean(), rel=0.1)
    assert abs(means.mean() - 0.5) < 4 * means.std() / math.sqrt(400)


def test_one_demonstration_alone_has_no_error():
    assert paired(np.array([2.0]), np.array([1.0]), np.array([4.0])).standard_error is None
