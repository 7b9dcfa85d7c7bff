"""Simulation-based calibration: parameters drawn from the prior have uniform ranks among draws from their posterior.

Each control has a posterior that is wrong in one known way; the same ranks are far from uniform there.
"""

from __future__ import annotations

import numpy as np
import pyro
import pytest
import torch
from scipy.stats import chisquare

from ddco_pyro.inference.marginal import EliminatedAHMM
from ddco_pyro.model.emissions import Gaussian
from ddco_pyro.model.outputs import CallerOutputs, Outputs

BINS = 20
GOALS = np.array([1.0, -1.0])
"""Prior means of the two options' biases: the options cannot be exchanged."""
SPREAD, SIGMA = 0.6, 0.5
UNIFORM = 1e-3
"""Ranks with a smaller p-value are not uniform."""


def p_values(ranks: np.ndarray) -> np.ndarray:
    """Of each column of ranks [R, parameters] in 0, ..., BINS - 1: the chi-square test that they are uniform."""
    return np.array([chisquare(np.bincount(column, minlength=BINS)).pvalue for column in ranks.T])


def outputs(weights: torch.Tensor, states: torch.Tensor) -> Outputs:
    """Two linear options of each row of weights [N, 7], for states [N, T]."""
    slope, bias, ending, first = weights.split([2, 2, 2, 1], dim=1)
    mean = (slope[:, None] * states[..., None] + bias[:, None]).unsqueeze(-1)
    logits = torch.cat([first, -first], 1)[:, None, None].expand(*states.shape, 1, 2)
    options = CallerOutputs(0, None, Gaussian(mean, torch.full((1,), SIGMA), torch.zeros(1)))
    return Outputs((options, CallerOutputs(2, logits, None)), (ending[:, None].expand(*states.shape, 2),))


def ranks_by_log_prob(replications=400, candidates=150, steps=15, change=None, spread=1.0) -> np.ndarray:
    """Ranks of seven weights and of the log-likelihood, where the prior is uniform over candidates drawn from a normal.

    The first candidate generates the controls. The posterior of the candidates is the softmax of their log-likelihoods,
    and the weight of the posterior below the first, ties cut at random, is uniform exactly.

    :param change: of the outputs that score the controls.
    :param spread: candidates beside the first are drawn from a prior so many times as wide.
    """
    pyro.set_rng_seed(3)
    center = torch.tensor([0.0, 0.0, *GOALS, -1.0, -1.0, 0.0])
    noise = torch.randn(replications, candidates, 7)
    noise[:, 1:] *= spread
    weights = center + SPREAD * noise
    states = torch.randn(replications, steps)
    lengths = torch.randint(steps // 2, steps + 1, (replications,))
    controls = EliminatedAHMM(outputs(weights[:, 0], states), lengths).sample().float()
    rows = [each.repeat_interleave(candidates, 0) for each in (states, lengths, controls)]
    scored = outputs(weights.flatten(0, 1), rows[0])
    scored = scored if change is None else change(scored)
    log_prob = EliminatedAHMM(scored, rows[1]).log_prob(rows[2]).reshape(replications, candidates)
    posterior = log_prob.softmax(1).unsqueeze(-1)
    values = torch.cat([weights.double(), log_prob.unsqueeze(-1)], -1)
    below = (posterior * (values < values[:, :1])).sum(1) + posterior[:, 0] * torch.rand(replications, 8)
    return (below * BINS).long().clamp(max=BINS - 1).numpy()


def memoryless(given: Outputs) -> Outputs:
    """Options that end after every step."""
    return Outputs(given.callers, (None,))


def wider(given: Outputs) -> Outputs:
    """σ half as large again."""
    options, meta_policy = given.callers
    emission = Gaussian(options.emission.mean, 1.5 * options.emission.std, options.emission.log_scale)
    return Outputs((CallerOutputs(0, None, emission), meta_policy), given.termination_logits)


def test_log_prob_is_the_density_of_what_is_sampled():
    assert p_values(ranks_by_log_prob()).min() > UNIFORM


@pytest.mark.parametrize("wrong", [{"change": memoryless}, {"change": wider}, {"spread": 0.5}])
def test_ranks_by_a_wrong_log_prob_or_prior_are_not_uniform(wrong):
    assert p_values(ranks_by_log_prob(**wrong)).min() < UNIFORM**2
