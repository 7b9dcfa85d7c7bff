"""Controls that are targets of an observation are known by their numbers."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import call, done
from targets import targets, velocities

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec


def test_init_recognises_targets_and_what_it_writes_can_be_fitted(tmp_path: Path) -> None:
    path, spec = tmp_path / "targets.hdf5", tmp_path / "spec.yaml"
    targets(velocities()).write(path)
    assert "the control is a target of obs/gripper" in call("inspect", path).out
    done("init", path, "--out", spec)
    assert yaml.safe_load(spec.read_text())["control"]["relative_to"] == "gripper"
    done("check", spec)
    done("fit", spec, "--out", tmp_path / "run", "--set", "compare_with=[]", "--set", "training.epochs=5")


def acted(demos: Demonstrations, control: Callable[[Demonstration], np.ndarray]) -> Demonstrations:
    """The same demonstrations with other controls."""
    return Demonstrations(tuple(replace(demo, actions=control(demo)) for demo in demos))


FILES: dict[str, tuple[Demonstrations, str | None]] = {
    "the next state": (targets(velocities()), "gripper"),
    "a target that the state lags behind": (
        acted(velocities(), lambda demo: demo.observations["gripper"] + demo.actions / 0.7), "gripper"
    ),
    "velocities": (velocities(), None),
    "in millimetres": (acted(targets(velocities()), lambda demo: 1000 * demo.actions), None),
    "in another order": (acted(targets(velocities()), lambda demo: demo.actions[:, [1, 2, 0]]), None),
}  # fmt: skip


@pytest.mark.parametrize(("demos", "key"), FILES.values(), ids=FILES)
def test_targets_are_known_by_their_numbers(demos: Demonstrations, key: str | None, tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    demos.write(path)
    found = inspect(path)
    assert found.relative_to == key
    assert found.leaks == {}
    assert yaml.safe_load(starting_spec(found, path).text)["control"].get("relative_to") == key
    assert not any("tend to repeat" in note for note in found.notes if key)
