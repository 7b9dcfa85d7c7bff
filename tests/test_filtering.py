"""The online filter against sums over every path of what has happened so far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.filtering import Filter
from ddco_pyro.model.tables import NEVER, complete


@pytest.mark.parametrize(
    ("counts", "hybrid", "steps"),
    [((1,), (True,), 4), ((3,), (True,), 4), ((2, 2), (True, False), 3), ((1, 2, 1), (False, True, True), 2)],
)
def test_the_belief_is_what_the_past_says(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=2, steps=steps, seed=21)
    filtering = Filter()
    for t, now in enumerate(complete(tables, torch.tensor([steps, steps])).steps()):
        belief = filtering.predict(now)
        known = [table.clone() for table in tables.control]
        for table in known:
            table[:, t] = torch.where(table[:, t] > NEVER, 0.0, NEVER)  # the control at t is not known yet
        so_far = replace(tables, control=tuple(known))
        for n in range(2):
            truth = brute_force(so_far, n, t + 1)
            for d, level in enumerate(belief.levels):
                np.testing.assert_allclose(level[n].sum(-1), truth.u[d][t], atol=1e-12)
                np.testing.assert_allclose(level[n, :, 1], truth.v[d][t], atol=1e-12)
                np.testing.assert_allclose(belief.choices[d][n].sum(), 1.0, atol=1e-12)
        filtering.update(now.emission)
    torch.testing.assert_close(filtering.log_likelihood, log_likelihood(tables, torch.tensor([steps, steps])))


def test_thousands_of_steps_do_not_drift():
    tables = random_tables((4,), (True,), steps=3000, seed=22)
    filtering = Filter()
    for now in complete(tables, torch.tensor([3000])).steps():
        belief = filtering.predict(now)
        filtering.update(now.emission)
    assert float(belief.choices[0].sum()) == pytest.approx(1.0, abs=1e-12)
    torch.testing.assert_close(filtering.log_likelihood, log_likelihood(tables, torch.tensor([3000])))


def test_updates_without_a_step_or_a_possible_control_are_refused():
    (now,) = complete(random_tables((2,), (False,), steps=1), torch.tensor([1])).steps()
    filtering = Filter()
    with pytest.raises(ValueError, match="follows predict"):
        filtering.update(now.emission)
    filtering.predict(now)
    with pytest.raises(ValueError, match="probability 0 under every choice"):
        filtering.update(torch.full_like(now.emission, NEVER))
