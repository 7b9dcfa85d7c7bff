"""Controls that are targets of an observation: options are of the difference, all else is of the targets."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import done
from planted import small_spec
from targets import targets, velocities

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.exporting.runner import Runner
from ddco_pyro.spec import SpecError, with_overrides

ABSOLUTE = targets(velocities())
VELOCITIES = (replace(demo, actions=demo.actions - demo.observations["gripper"]) for demo in ABSOLUTE)
BY_HAND = Demonstrations(tuple(VELOCITIES))
"""The differences of the targets, which are the velocities, up to rounding."""

SPEC = small_spec(
    (3,),
    observations=["gripper", "object", "goal", "jaw"],
    control={"std": {"learn": True}},
    training={"epochs": 15, "starts": ["vq_controls"], "optimizer": {"name": "em"}},
)
RELATIVE = with_overrides(SPEC, {"control.relative_to": "gripper"})


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> tuple[ddco_pyro.Fit, ddco_pyro.Fit]:
    """A fit to targets, and one to the differences that were taken by hand."""
    ours = ddco_pyro.fit(RELATIVE, ABSOLUTE, out=tmp_path_factory.mktemp("relative") / "run")
    return ddco_pyro.load(ours.folder), ddco_pyro.fit(SPEC, BY_HAND)


Fits = tuple[ddco_pyro.Fit, ddco_pyro.Fit]


def test_it_is_the_fit_of_the_differences(fits: Fits) -> None:
    ours, theirs = fits
    weights = theirs.hierarchy.state_dict()
    for name, values in ours.hierarchy.state_dict().items():
        torch.testing.assert_close(values, weights[name], rtol=0, atol=0)
    assert ours.metrics.log_likelihood_per_step == theirs.metrics.log_likelihood_per_step
    for one, other in zip(ours.segment(ABSOLUTE)[0], theirs.segment(BY_HAND)[0], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(ours.log_likelihood(ABSOLUTE), theirs.log_likelihood(BY_HAND))


@pytest.mark.parametrize("control", ["mean", "sample"])
def test_its_controller_gives_targets(fits: Fits, control: str) -> None:
    ours, theirs = (ddco_pyro.Controller(fit.hierarchy, control, seed=3) for fit in fits)
    for step in range(10):
        seen = {key: rows[step] for key, rows in ABSOLUTE[2].observations.items()}
        np.testing.assert_array_equal(ours.act(seen), theirs.act(seen) + seen["gripper"])
        assert ours.choices == theirs.choices


def test_its_monitor_takes_targets(fits: Fits) -> None:
    ours, theirs = (fit.monitor() for fit in fits)
    for step in range(10):
        seen = {key: rows[step] for key, rows in ABSOLUTE[2].observations.items()}
        before = (demos[2].actions[step - 1] if step else None for demos in (ABSOLUTE, BY_HAND))
        pairs = zip((ours, theirs), before, strict=True)
        one, other = (monitor.step(seen, control) for monitor, control in pairs)
        assert one == other
    assert ours.log_likelihood == theirs.log_likelihood


@pytest.mark.parametrize("form", ["numpy", "onnx"])
def test_its_export_gives_targets(fits: Fits, form: str, tmp_path: Path) -> None:
    """The export replays what the run's controller does, and does so here too."""
    if form == "onnx":
        pytest.importorskip("onnxruntime")
        pytest.importorskip("onnxscript")
    run = fits[0]
    more = ["--onnx"] if form == "onnx" else []
    done("export", run.folder, "--out", tmp_path / "controller", *more)
    runner, controller = Runner(tmp_path / "controller", form), run.controller(seed=5)
    runner.reset(5)
    for step in range(10):
        seen = {key: rows[step] for key, rows in ABSOLUTE[4].observations.items()}
        np.testing.assert_allclose(runner.act(seen), controller.act(seen), atol=1e-6)


GRID = {"control.relative_to": "gripper", "selection.grid": {"control.relative_to": ["gripper", "jaw"]}}
REFUSED = {
    "unknown": ({"control.relative_to": "griper"}, "control.relative_to: there is no observation 'griper'"),
    "in a grid": (
        GRID,
        "selection.grid.control.relative_to: decides what the control is, for all candidates",
    ),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED)
def test_a_spec_that_cannot_be_meant_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError) as caught:
        with_overrides(SPEC, changes)
    assert str(caught.value).startswith(message)


def test_an_observation_of_another_size_is_refused() -> None:
    message = (
        r"control.relative_to: obs/jaw has shape \[1\] at each step, and the control \[3\]; both have to be"
    )
    with pytest.raises(DemonstrationsError, match=message):
        ddco_pyro.fit(with_overrides(RELATIVE, {"control.relative_to": "jaw"}), ABSOLUTE)
