"""What no policy should read, by its numbers or its name: left out by ``init``, told by ``inspect``."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import Inspection, inspect
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.data.starting import starting_spec

RANDOM = np.random.default_rng(0)

Observed = Callable[[np.ndarray, int], np.ndarray]
"""An observation [T, D] of the controls [T, A] and the number of the demonstration."""


def with_observation(path: Path, key: str, observed: Observed) -> Inspection:
    """Planted demonstrations with one more observation."""
    pick_and_place(8).write(path)
    with h5py.File(path, "r+") as file:
        for number, group in enumerate(file["data"].values()):
            group[f"obs/{key}"] = observed(group["actions"][:], number)
    return inspect(path)


def noisy(values: np.ndarray) -> np.ndarray:
    return values + 1e-4 * RANDOM.normal(size=values.shape)


def after(actions: np.ndarray) -> np.ndarray:
    """The controls of the step before; at first none."""
    return np.concatenate([0 * actions[:1], actions[:-1]])


UNEVEN = RANDOM.exponential(size=1000).cumsum()

CONTROL = "up to units and noise, which a policy has to predict"

LEFT_OUT: dict[str, tuple[str, Observed, str]] = {
    "seconds since 1970": ("stamp", lambda u, n: 1.7e9 + 86400 * n + np.arange(len(u)) / 20, "is a clock"),
    "frames": ("frame", lambda u, n: np.arange(len(u))[:, None], "is a clock"),
    "progress, as parts of each": ("progress", lambda u, n: np.linspace(0, 1, len(u)), "is a clock"),
    "uneven stamps by name": ("camera/timestamp", lambda u, n: UNEVEN[: len(u)], "is a clock"),
    "millimetres": ("mm", lambda u, n: 1000 * u[:, :3] + 7,
        f"is control dimensions 0-2 at the same step, {CONTROL}"),
    "noise of 1e-4": ("command", lambda u, n: noisy(u),
        f"is control dimensions 0-3 at the same step, {CONTROL}"),
    "the next one, reversed": (
        "ahead",
        lambda u, n: -np.concatenate([u[1:, :2], u[:1, :2]])[:, ::-1],
        f"is control dimensions 0-1 of the next step, {CONTROL}",
    ),
    "a signal of a subtask": (
        "datagen_info/subtask_term_signals/grasp",
        lambda u, n: (np.arange(len(u)) > 9).astype(float),
        "is a label, labels/subtask, and no observation",
    ),
    "a generator's pose": ("datagen_info/eef", lambda u, n: RANDOM.normal(size=(len(u), 16)),
        "is what a generator"),
    "a controller's target": ("target_eef_pose", lambda u, n: RANDOM.normal(size=(len(u), 3)),
        "is the target of a"),
}  # fmt: skip


@pytest.mark.parametrize(("key", "observed", "why"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_it_is_left_out_and_why_is_said(key: str, observed: Observed, why: str, tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    found = with_observation(path, key, observed)
    (reason,) = (note for note in found.notes if note.startswith(f"obs/{key}") and why in note)
    assert reason.startswith(f"obs/{key} {why}")
    text = starting_spec(found, path).text
    assert f"# - {key}   # {why}" in text
    assert key not in [one["key"] for one in yaml.safe_load(text)["observations"]]


READ: dict[str, Observed] = {
    "as much noise as control": lambda u, n: u + 0.1 * u.std(0) * RANDOM.normal(size=u.shape),
    "a lagging state that the control moves": lambda u, n: np.cumsum(after(u), axis=0),
    "a height that rises unevenly": lambda u, n: UNEVEN[: len(u)],
    "a ramp that once falls": lambda u, n: np.linspace(0, 1 if n else -1, len(u)),
    "a state that follows each control": lambda u, n: 2 * after(noisy(u)),
}


@pytest.mark.parametrize("observed", READ.values(), ids=READ)
def test_other_numbers_are_read(observed: Observed, tmp_path: Path) -> None:
    found = with_observation(tmp_path / "demos.hdf5", "sensor", observed)
    assert not found.leaks


def test_a_state_that_follows_slow_targets_closely_is_read(tmp_path: Path) -> None:
    """Its R² with the control of this step is above .999, with that of the step before higher still."""
    seen = with_observation(tmp_path / "demos.hdf5", "joints", lambda u, n: np.zeros(len(u)))
    with h5py.File(seen.path, "r+") as file:
        for group in file["data"].values():
            targets = np.sin(np.arange(len(group["actions"]))[:, None] / [200, 300, 500, 900])
            group["actions"][...], group["obs/near"] = targets, noisy(after(targets))
            group["obs/near"][0] = targets[0]
    assert "obs/near" not in inspect(seen.path).leaks


@pytest.mark.parametrize("place", ["datagen_info", "obs/datagen_info"], ids=["MimicGen", "Isaac Lab"])
def test_signals_of_subtasks_are_labels(place: str, tmp_path: Path) -> None:
    """A signal is 1 from the last step of its subtask on. What follows the last one has no signal."""
    path = tmp_path / "demos.hdf5"
    pick_and_place(6).write(path)
    with h5py.File(path, "r+") as file:
        for number, group in enumerate(file["data"].values()):
            steps = np.arange(len(group["actions"]))
            del group["labels"]
            group[f"{place}/subtask_term_signals/reach"] = (steps >= 4 + number).astype(int)
            group[f"{place}/subtask_term_signals/grasp"] = (steps >= 9).astype(int)
    lengths = [[5 + n, 5 - n, len(demo) - 10] for n, demo in enumerate(pick_and_place(6))]
    expected = [np.repeat([0, 1, 2], each) for each in lengths][:5]
    for read in (Demonstrations.read(path), Demonstrations.read(path, ["gripper"], ["subtask"])):
        for demo, labels in zip(read, expected, strict=False):
            assert demo.labels["subtask"].tolist() == labels.tolist()
    found = inspect(path)
    assert found.fields["labels/subtask"].names == ["reach", "grasp", "last"]
    spec = yaml.safe_load(starting_spec(found, path).text)
    assert spec["demonstrations"]["labels"] == "subtask"
    assert {one["key"] for one in spec["observations"]} == {"gripper", "goal", "jaw", "object"}


def test_labels_of_the_file_stand_before_signals(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    pick_and_place(3).write(path)
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            group.move("labels/phase", "labels/subtask")
            group["datagen_info/subtask_term_signals/reach"] = np.ones(len(group["actions"]), int)
    for demo, planted in zip(Demonstrations.read(path), pick_and_place(3), strict=True):
        assert demo.labels["subtask"].tolist() == planted.labels["phase"].tolist()
