"""Levels above the lowest start from what follows what: EM against sums over every path, planted ones."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import paths, random_tables
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.inference import segment
from ddco_pyro.training import upper
from ddco_pyro.training.upper import Constants, expected, fitted, improved

STEPS = 3


def random_constants(tables):
    return Constants.drawn(tables, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("counts", "hybrid"),
    [
        ((2, 2), (False, False)),
        ((2, 3), (True, True)),
        pytest.param((2, 2, 2), (False,) * 3, marks=pytest.mark.slow),  # compiling takes most of it
    ],
)
def test_an_iteration_divides_counts_over_every_path(monkeypatch, counts, hybrid):
    """Selections and terminations counted on one path after another, each weighted by its probability."""
    monkeypatch.setattr(upper, "PSEUDO", 0.0)
    tables, lengths = random_tables(counts, hybrid, 2, STEPS), (STEPS, STEPS - 1)
    constants = random_constants(tables)
    constant, depth = constants.within(tables), len(counts)
    selected = [np.zeros(table.shape) for table in constants.selection]
    ended = [np.zeros((count, 2)) for count in counts[1:]]
    value = 0.0
    for n, length in enumerate(lengths):
        every = list(paths(constant, n, length, [1 + count for count in counts]))
        total = sum(probability for *_, probability in every)
        value += math.log(total)
        for h, b, probability in every:
            if probability:
                _count(h, b, probability / total, depth, selected, ended)
    found, after = improved([(tables, torch.tensor(lengths))], constants)
    assert found == pytest.approx(value, abs=1e-9)
    for own, counted in zip(after.selection, selected, strict=True):
        np.testing.assert_allclose(own, counted / counted.sum(-1, keepdims=True), atol=1e-9)
    for own, counted in zip(after.termination, ended, strict=True):
        np.testing.assert_allclose(own, counted[:, 1] / counted.sum(-1), atol=1e-9)


def _count(h, b, weight, depth, selected, ended):
    """A path's selections, and the ends of levels whose lower neighbour ended too."""
    for t, level in itertools.product(range(len(h)), range(depth)):
        if b[t][level]:
            caller = h[t][level + 1] - 1 if level + 1 < depth else 0
            selected[level][caller, h[t][level] - 1] += weight
        if level > 0 and t > 0 and b[t][level - 1]:
            ended[level - 1][h[t - 1][level] - 1, b[t][level]] += weight


def test_networks_are_scored_by_what_they_say_of_every_path_of_the_constants():
    """Σ over paths of their probability under the constants times the log-probability of what happens."""
    counts, lengths = (2, 2), torch.tensor([STEPS, STEPS - 1])
    tables = random_tables(counts, (True, False), 2, STEPS, seed=5)
    constants = random_constants(tables)
    within, value = constants.within(tables), 0.0
    for n, length in enumerate(lengths.tolist()):
        every = list(paths(within, n, length, [1 + count for count in counts]))
        total = sum(probability for *_, probability in every)
        value += sum(p / total * _log_selections_and_ends(tables, n, h, b) for h, b, p in every if p)
    assert float(expected(tables, lengths, constants).sum()) == pytest.approx(value, abs=1e-9)


def _log_selections_and_ends(tables, n, h, b):
    total = 0.0
    for t, level in itertools.product(range(len(h)), range(2)):
        if b[t][level]:
            caller = h[t][1] - 1 if level == 0 else 0
            total += float(tables.selection[level][n, t, caller, h[t][level]])
        if level == 1 and t > 0 and b[t][0]:
            total += float(tables.termination[1][n, t, h[t - 1][1] - 1, b[t][1]])
    return total


def test_the_gradient_stays_finite_where_callers_have_no_control():
    tables, lengths = random_tables((2, 2), (False, False), 2, 4), torch.tensor([4, 3])
    logits = torch.zeros(2, 4, 2, 2, dtype=torch.float64, requires_grad=True)
    chosen = torch.nn.functional.pad(logits.log_softmax(-1), (1, 0), value=-torch.inf)
    said = replace(tables, selection=(chosen, tables.selection[1]))
    expected(said, lengths, random_constants(tables)).sum().backward()
    assert torch.isfinite(logits.grad).all()
    assert logits.grad.abs().max() > 0


def planted_pairs(demonstrations=20, steps=40, seed=0):
    """Tables of what is seen of four options, a new one each step; of two above, each selects two."""
    random = np.random.default_rng(seed)
    above = (
        np.cumsum(random.random((demonstrations, steps)) < 0.1, axis=1)
        + random.integers(0, 2, (demonstrations, 1))
    ) % 2
    seen = 2 * above + random.integers(0, 2, above.shape)
    tables = random_tables((4, 2), (False, False), demonstrations, steps)
    ended = torch.tensor([-torch.inf, 0.0], dtype=torch.float64).expand(tables.termination[0].shape)
    control = torch.where(torch.tensor(seen)[..., None] == torch.arange(4), 0.0, -5.0).double()
    changes = {"termination": (ended, tables.termination[1]), "control": (control, *tables.control[1:])}
    return replace(tables, **changes), above


def test_a_planted_level_is_found():
    tables, above = planted_pairs()
    lengths = torch.full((20,), 40)
    constants = fitted([(tables, lengths)], 0)
    segments = segment(constants.within(tables), lengths)[1]
    assert normalized_mutual_info_score(above.flatten(), segments.flatten()) > 0.7
    # how often each selects 1 or 2, and 3 or 4
    pairs = constants.selection[0].numpy().reshape(2, 2, 2).sum(-1)
    np.testing.assert_allclose(np.sort(pairs.max(1)), 1.0, atol=0.05)
    assert pairs.argmax(1).tolist() in ([0, 1], [1, 0])
    np.testing.assert_allclose(constants.termination[0] * (1 - constants.selection[1][0]), 0.1, atol=0.04)
