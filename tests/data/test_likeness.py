"""Demonstrations unlike the others of their file, or unlike those of a fit, are named with the reason."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call, done
from planted import small_spec

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import load
from ddco_pyro.labelling.session import Session
from ddco_pyro.spec import dump_spec, load_spec

Change = Callable[[Demonstration, Demonstration], tuple[dict[str, Any], np.ndarray]]
"""The observations and controls of a spoilt demonstration; gets another one, too."""


def seen(demo: Demonstration) -> dict[str, np.ndarray]:
    return {key: np.asarray(array) for key, array in demo.observations.items()}


def scaled(factor: float, *keys: str) -> Change:
    def change(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
        factors = {key: factor if key in keys else 1 for key in seen(demo)}
        return {key: array * factors[key] for key, array in seen(demo).items()}, demo.actions

    return change


def reversed_gripper(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
    return seen(demo), demo.actions * [1, 1, 1, -1]


def joined(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
    observed = {key: np.concatenate([array, other.observations[key]]) for key, array in seen(demo).items()}
    return observed, np.concatenate([demo.actions, other.actions])


def third(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
    """At a third of the rate."""
    steps = demo.actions[::3] * [3, 3, 3, 1]
    return {key: array[::3] for key, array in seen(demo).items()}, steps


def moved(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
    """With the origin elsewhere."""
    return {key: array + 3.0 * (key != "jaw") for key, array in seen(demo).items()}, demo.actions


POSITIONS = ("gripper", "object", "goal")

GRIPPER = "obs/gripper dimensions 0-2"
FAULTS: dict[str, tuple[Change, str, str]] = {
    "millimetres": (scaled(1000, *POSITIONS), GRIPPER, "1000 times as large as {}, perhaps milli"),
    "metres": (scaled(0.01, "gripper"), GRIPPER, "100 times as small as {}, perhaps metres for"),
    "degrees": (scaled(57.3, "gripper"), "obs/gripper", "57.3 times as large as {}, perhaps degrees for"),
    "gripper": (reversed_gripper, "control dimension 3", "the other sign than {}, perhaps reversed"),
    "joined": (joined, "observations jump at once, in demo_3 at step 4", "perhaps two recordings are joined"),
}


def spoilt(demos: Demonstrations, change: Change, which: Sequence[int]) -> Demonstrations:
    new = [
        Demonstration(demo.name, *change(demo, demos[number - 1])) if number in which else demo
        for number, demo in enumerate(Demonstration(d.name, d.observations, d.actions) for d in demos)
    ]
    return Demonstrations(tuple(new))


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.usefixtures("undecided")
def test_a_share_of_a_file_that_is_unlike_the_rest_is_named_and_left_out(name: str, tmp_path: Path) -> None:
    change, what, why = FAULTS[name]
    path, names = tmp_path / "demos.hdf5", ("demo_3", "demo_8", "demo_12", "demo_17")
    spoilt(pick_and_place(20), change, (3, 8, 12, 17)).write(path)
    line, *others = inspect(path).exclusions
    assert line.startswith(f"demo_3, demo_8, demo_12, ... (4 of 20): {what}")
    assert why.format("in most") in line
    assert line.endswith("; exclude such ones (demonstrations.exclude)")
    assert not others
    assert line in " ".join(call("inspect", path).out.split())
    done("init", path, "--out", tmp_path / "spec.yaml")
    assert f"# {line}\n" in (tmp_path / "spec.yaml").read_text()
    assert load_spec(tmp_path / "spec.yaml").demonstrations.exclude == names


@pytest.mark.parametrize("seed", range(2))
def test_objects_and_goals_elsewhere_are_no_fault(seed: int, tmp_path: Path) -> None:
    def elsewhere(demo: Demonstration, other: Demonstration) -> tuple[dict[str, Any], np.ndarray]:
        """The scene turned by half a turn: positions and motions have the other sign."""
        turned = {key: array * ([-1, -1, 1] if key in POSITIONS else 1) for key, array in seen(demo).items()}
        return turned, demo.actions * [-1, -1, 1, 1]

    path = tmp_path / "demos.hdf5"
    spoilt(pick_and_place(20, seed), elsewhere, (1, 4, 6, 9, 12, 15)).write(path)
    assert inspect(path).exclusions == []


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unlike")
    demos = pick_and_place(12)
    Demonstrations(demos.demonstrations, attributes={"control_frequency": 30}).write(folder / "demos.hdf5")
    spec = small_spec(
        (4,),
        demonstrations={"path": str(folder / "demos.hdf5")},
        observations=["gripper", "object", "goal", "jaw"],
        control={"std": {"learn": True, "floor": 0.01}},
        training={"optimizer": {"name": "em"}, "tune_fraction": 0, "epochs": 5},
    )
    fit(spec, out=folder / "run")
    return folder / "run"


OTHERS: dict[str, tuple[Change, str, str]] = {
    **{name: FAULTS[name] for name in ("millimetres", "gripper", "joined")},
    "rate": (third, "steps are 2.", "times as long as {}, perhaps at another rate"),
    "origin": (moved, "-", "nats a step, and"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_segment_names_demonstrations_unlike_those_of_the_fit(name: str, run: Path, tmp_path: Path) -> None:
    change, what, why = OTHERS[name]
    path, which = tmp_path / "demos.hdf5", range(6) if name == "rate" else (3, 5)
    spoilt(pick_and_place(6, seed=1), change, which).write(path)
    ended = call("segment", run, path, "--csv", tmp_path / "segments.csv")
    (line,) = (line for line in ended.err.splitlines() if line.startswith("note: "))
    members = "demo_0, demo_1, demo_2, ... (6 of 6)" if name == "rate" else "demo_3, demo_5 (2 of 6)"
    assert line.startswith(f"note: unlike the demonstrations of the fit: {members}: {what}")
    assert why.format("in the fit") in line
    assert (tmp_path / "segments.csv").exists()


def test_label_warns_of_demonstrations_unlike_those_of_the_fit(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    spoilt(pick_and_place(6, seed=1), reversed_gripper, (3, 5)).write(path)
    session = Session(load(run), path, tmp_path / "labels.hdf5")
    try:
        (line,) = session.warnings()
    finally:
        session.close()
    says = "unlike the demonstrations of the fit: demo_3, demo_5 (2 of 6): control dimension 3"
    assert line.startswith(says)


def test_fit_warns_of_demonstrations_unlike_the_others(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    spoilt(pick_and_place(8), reversed_gripper, (3, 5)).write(path)
    training = {"optimizer": {"name": "em"}, "tune_fraction": 0, "epochs": 2}
    known = {"demonstrations": {"path": str(path)}, "observations": ["gripper", "object", "jaw"]}
    spec = small_spec(**known, training=training)
    (tmp_path / "spec.yaml").write_text(dump_spec(spec))
    said = call("fit", tmp_path / "spec.yaml", "--out", tmp_path / "run", "--jobs", 1).out
    assert "warning: demo_3, demo_5 (2 of 8): control dimension 3 has the other sign than in most" in said


@pytest.mark.parametrize(("rate", "notes"), [(30, 0), (10, 1)])
def test_segment_says_where_files_have_other_rates_and_nothing_else_of_the_same_kind(
    rate: int, notes: int, run: Path, tmp_path: Path
) -> None:
    path = tmp_path / "demos.hdf5"
    demos = pick_and_place(6, seed=1).demonstrations
    Demonstrations(demos, attributes={"control_frequency": rate}).write(path)
    said = call("segment", run, path, "--csv", tmp_path / "segments.csv").err
    assert said.count("note: ") == said.count("(6 of 6): 10 Hz, and 30 Hz in the fit\n") == notes
