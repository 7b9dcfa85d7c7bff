"""Simulation-based calibration: parameters drawn from the prior have uniform ranks among draws from their posterior.

Each control has a posterior that is wrong in one known way; the same ranks are far from uniform there.
"""

from __future__ import annotations

import numpy as np
import pyro
import pytest
import torch
from scipy.stats import chisquare

from ddco_pyro.inference import sample_paths
from ddco_pyro.inference.marginal import EliminatedAHMM
from ddco_pyro.model.emissions import Gaussian
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.tables import NEVER, Tables

BINS = 20
GOALS = np.array([1.0, -1.0])
"""Prior means of the two options' biases: the options cannot be exchanged."""
SPREAD, SIGMA = 0.6, 0.5
ENDS = 2.0, 5.0
"""Of the beta prior of ψ; that of η is Beta(2, 2)."""
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


def simulate(replications: int, steps: int, random: np.random.Generator):
    """Parameters from the prior, and states and controls [R, T] by the definition of §4.1, in plain numpy."""
    weights = np.stack([np.zeros(2), GOALS], -1) + SPREAD * random.normal(size=(replications, 2, 2))
    ending, first = random.beta(*ENDS, (replications, 2)), random.beta(2.0, 2.0, replications)
    states, controls = random.normal(size=(2, replications, steps))
    rows, option = np.arange(replications), np.zeros(replications, dtype=int)
    for t in range(steps):
        selects = (random.random(replications) < ending[rows, option]) | (t == 0)
        option = np.where(selects, random.random(replications) >= first, option)
        slope, bias = weights[rows, option].T
        controls[:, t] = slope * states[:, t] + bias + SIGMA * controls[:, t]
    return weights, ending, first, states, controls


def ranks_by_paths(replications=1000, steps=25, burn=150, thin=8, spread=SPREAD, ends=ENDS, lasting=True) -> np.ndarray:
    """Ranks of four weights, two ψ and η by Gibbs sampling: paths given parameters, conjugate parameters given paths.

    The sampler starts at the truth, and forgets it within ``burn`` sweeps.

    :param spread, ends: of the prior that the sampler has.
    :param lasting: whether it draws paths from options that last.
    """
    random = np.random.default_rng(4)
    truth = simulate(replications, steps, random)
    states, controls = truth[3:]
    weights, ending, first = truth[:3]
    center, precision = np.stack([np.zeros(2), GOALS], -1), np.eye(2) / spread**2
    lengths, x = torch.full((replications,), steps), np.stack([states, np.ones_like(states)], -1)
    ranks = np.zeros((replications, 7), dtype=int)
    true = np.concatenate([truth[0].reshape(-1, 4), truth[1], truth[2][:, None]], 1)
    for sweep in range(burn + (BINS - 1) * thin):
        density = -0.5 * ((controls[..., None] - np.einsum("rtf,rkf->rtk", x, weights)) / SIGMA) ** 2
        with np.errstate(divide="ignore"):
            selection = np.log(np.stack([np.zeros_like(first), first, 1 - first], -1))[:, None, None]
        termination = np.log(np.stack([1 - ending, ending], -1))[:, None]
        selection, termination, density, none = (
            torch.from_numpy(np.broadcast_to(table, (replications, steps, *table.shape[2:])).copy())
            for table in (selection, termination, density, np.full((1, 1, 1), NEVER))
        )
        tables = Tables((selection,), (termination,), (density, none))
        path = sample_paths(tables if lasting else tables.memoryless(), lengths, 1, (5, sweep))
        options, ends_here = (kind[0][0].numpy() for kind in (path.choices, path.terminations))
        active = options[..., None] == [1, 2]
        ended, going_on = (
            ((ends_here[:, 1:, None] == value) & active[:, :-1]).sum(1) for value in (1, 0)
        )  # fmt: skip
        selected = ((ends_here[..., None] == 1) & active).sum(1)
        ending = random.beta(ends[0] + ended, ends[1] + going_on)
        first = random.beta(2 + selected[:, 0], 2 + selected[:, 1])
        information = precision + np.einsum("rtk,rtf,rtg->rkfg", active, x, x) / SIGMA**2
        pull = center @ precision + np.einsum("rtk,rtf,rt->rkf", active, x, controls) / SIGMA**2
        root = np.linalg.cholesky(np.linalg.inv(information))
        mean = np.linalg.solve(information, pull[..., None])
        weights = (mean + root @ random.normal(size=(replications, 2, 2, 1)))[..., 0]
        if sweep >= burn and (sweep - burn) % thin == 0:
            drawn = np.concatenate([weights.reshape(-1, 4), ending, first[:, None]], 1)
            ranks += drawn < true
    return ranks


@pytest.mark.slow
def test_draws_of_paths_make_a_calibrated_sampler():
    assert p_values(ranks_by_paths()).min() > UNIFORM


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{"spread": SPREAD / 3}, {"ends": (5.0, 2.0)}, {"lasting": False}])
def test_a_wrong_prior_or_wrong_paths_are_not_calibrated(wrong):
    assert p_values(ranks_by_paths(replications=400, **wrong)).min() < UNIFORM**2
