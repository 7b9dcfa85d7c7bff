"""Controls that are targets of an observation are known by their numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from command_line import call
from targets import targets, velocities

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec


def test_init_recognises_targets_and_what_it_writes_can_be_fitted(tmp_path: Path) -> None:
    path, spec = tmp_path / "targets.hdf5", tmp_path / "spec.yaml"
    targets(velocities()).write(path)
    assert "the control is a target of obs/gripper" in call("inspect", path).out
    assert call("init", path, "--out", spec).status == 0
    assert yaml.safe_load(spec.read_text())["control"]["relative_to"] == "gripper"
    ended = call("check", spec)
    assert ended.status == 0, ended.err
    ended = call("fit", spec, "--out", tmp_path / "run", "--set", "compare_with=[]", "--set", "training.epochs=5")
    assert ended.status == 0, ended.err


def lagging(demos: Demonstrations, share: float) -> Demonstrations:
    """Positions that cover a share of the way to their target in each step; the target leads them by its inverse."""
    return Demonstrations(
        tuple(replace(demo, actions=demo.observations["gripper"] + demo.actions / share) for demo in demos)
    )


def in_other_units(demos: Demonstrations) -> Demonstrations:
    return Demonstrations(tuple(replace(demo, actions=1000 * demo.actions) for demo in demos))


def reordered(demos: Demonstrations) -> Demonstrations:
    return Demonstrations(tuple(replace(demo, actions=demo.actions[:, [1, 2, 0]]) for demo in demos))


FILES: dict[str, tuple[Demonstrations, str | None]] = {
    "the next state": (targets(velocities()), "gripper"),
    "a target that the state lags behind": (lagging(velocities(), 0.7), "gripper"),
    "velocities": (velocities(), None),
    "in millimetres": (in_other_units(targets(velocities())), None),
    "in another order": (reordered(targets(velocities())), None),
}


@pytest.mark.parametrize(("demos", "key"), FILES.values(), ids=FILES)
def test_targets_are_known_by_their_numbers(demos: Demonstrations, key: str | None, tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    demos.write(path)
    found = inspect(path)
    assert found.relative_to == key
    assert found.leaks == {}
    assert yaml.safe_load(starting_spec(found, path).text)["control"].get("relative_to") == key
    assert not any("tend to repeat" in note for note in found.notes if key)
