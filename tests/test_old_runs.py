"""Runs that an earlier version wrote (commit 629dd07) are read, and say and do what they said and did then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ddco_pyro

RUNS = Path(__file__).parent / "fixtures" / "runs_629dd07"


@pytest.mark.parametrize("name", ["vectors", "pictures", "per_timestep"])
def test_an_old_run_says_and_does_what_it_did(name):
    """``said.npz`` was made by that version: log-likelihoods of all demonstrations, and controls on the first one."""
    fit = ddco_pyro.load(RUNS / name)
    demos = ddco_pyro.Demonstrations.read(RUNS / "demonstrations.hdf5")
    controller = fit.controller(seed=3)
    seen = demos[0].observations
    controls = [controller.act({key: values[step] for key, values in seen.items()}) for step in range(6)]
    with np.load(RUNS / name / "said.npz") as said:
        np.testing.assert_allclose(fit.log_likelihood(demos), said["log_likelihood"], rtol=1e-5)
        np.testing.assert_allclose(controls, said["controls"], rtol=1e-5, atol=1e-6)
