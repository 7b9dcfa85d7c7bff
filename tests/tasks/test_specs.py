"""Every spec of a task is checked against it; specs of pushing and bin picking are fitted, and act in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ddco_tasks import bin_picking
from ddco_tasks.bin_picking.supervisor import JAW_OPEN
from ddco_tasks.pushing import environment as pushing

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import check_networks

SPECS = sorted((Path(__file__).parents[2] / "specs").glob("*.yaml"))
# files that are not in this repository
OF_FILES = ("metaworld_pick_place", "metaworld_library", "many_tasks")
BIN_PICKING = next(path for path in SPECS if path.stem == "bin_picking")
CAMERAS = {"camera": pushing.camera(48, 64)}
QUICK = ("pushing_3level", "pushing_hybrid", "pushing_flat_mlp")
PUSHING = [
    pytest.param(path, marks=[] if path.stem in QUICK else pytest.mark.slow, id=path.stem)
    for path in SPECS
    if path.stem.startswith("pushing")
]
TINY = [
    "observations=[{key: image, resize: [16, 16]}, grasp, kin, load]",
    "demonstrations.valid_fraction=0",
    "compare_with=[]",
    "training.epochs=4",
    "rollout.policies=[]",
]


@pytest.mark.parametrize(
    "path", [path for path in SPECS if path.stem not in OF_FILES], ids=lambda path: path.stem
)
def test_specs_are_checked_against_their_tasks(path: Path) -> None:
    spec = load_spec(path, allow_code=True)
    known = dimensions(spec)
    assert check_networks(spec, known).depth == (len(spec.hierarchy.levels) if spec.hierarchy else 0)
    if path.stem.startswith("pushing"):
        assert (known.control_size, known.steps) == (3, pushing.GOAL_STEPS)
    if path.stem.startswith("bin_picking"):
        assert known.shapes == {"image": (72, 72, 2), "grasp": (6,), "kin": (7,), "load": (18,)}


@pytest.mark.parametrize(("form", "angles", "numbers"), [("pose", 6, 7), ("matrix", 12, 13)])
def test_other_controls_are_checked_against_their_tasks(form: str, angles: int, numbers: int) -> None:
    pose = f"{{name: pose, dims: {list(range(angles))}, kind: gaussian}}"
    parts = f"control.parts=[{pose}, {{name: jaw, dims: [{angles}], kind: binary}}]"
    spec = load_spec(BIN_PICKING, ["compare_with=[]", f"task=bin_picking_{form}", parts])
    known = dimensions(spec)
    assert known.control_size == numbers
    assert check_networks(spec, known).depth == 1


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with four demonstrations of pushing."""
    path = tmp_path_factory.mktemp("pushing") / "demonstrations.hdf5"
    single = replace(pushing.single, cameras=CAMERAS)
    episodes = [run_episode(single, "scripted_noisy", seed, observed=CAMERAS) for seed in range(4)]
    Demonstrations(tuple(one.record for one in episodes)).write(path)
    return path


@pytest.mark.parametrize("path", PUSHING)
def test_specs_fit_and_act(path: Path, pushed: Path, tmp_path: Path) -> None:
    found = fit(load_spec(path, [f"demonstrations.path={pushed}", "training.epochs=6"]), out=tmp_path / "run")
    assert found.metrics.engine_check.value < 1e-6
    brief = replace(pushing.limited, load=lambda seed: pushing.load_single(seed), cameras=CAMERAS)
    controller = Controller(found.hierarchy, found.spec.rollout.control, found.spec.rollout.options)
    episode = run_episode(brief, controller, 0, observed=found.spec.observed, keep=("tip",))
    assert episode.choices.shape == (len(episode.record.observations["tip"]), found.hierarchy.depth)
    lowest = 0 if path.stem.endswith("hybrid") else 1
    assert not found.hierarchy.depth or episode.choices.min() >= lowest
    assert np.ptp(episode.record.observations["tip"], axis=0).max() > 1e-3  # the arm moves


@pytest.fixture(scope="module")
def picked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two demonstrations of bins of three objects."""
    path = tmp_path_factory.mktemp("bin_picking") / "demonstrations.hdf5"
    episodes = [run_episode(bin_picking.task, "supervisor", seed) for seed in (2, 15)]
    Demonstrations(tuple(one.record for one in episodes)).write(path)
    return path


def test_demonstrations_show_what_the_person_saw(picked: Path) -> None:
    for demo in Demonstrations.read(picked, labels=("phase", "held", "kind", "left")):
        assert set(np.unique(np.asarray(demo.observations["image"]))) == {0, 255}
        opened = demo.observations["kin"][:, 6] > JAW_OPEN / 2
        # the jaws are as they were told to be
        np.testing.assert_array_equal(opened[1:], demo.actions[:-1, 6])
        carrying = demo.labels["phase"] == 4
        carried = np.diff(carrying, prepend=False) & carrying  # begins to be
        assert (demo.labels["kind"][carried] >= 0).all()
        back = np.diff(demo.labels["phase"] == 3, prepend=False) & (demo.labels["phase"] == 3)
        assert (demo.labels["held"][back] != 1).all()
        assert demo.labels["left"][0] == 3


@pytest.mark.slow
def test_bins_are_fitted_and_rolled_out(picked: Path, tmp_path: Path) -> None:
    fitted = fit(load_spec(BIN_PICKING, [f"demonstrations.path={picked}", *TINY]), out=tmp_path / "run")
    assert fitted.metrics.engine_check.value < 1e-6
    measures = roll_out(fitted, 1, jobs=1).methods[fitted.name].measures
    assert measures.keys() == bin_picking.task.measures.keys()
    assert measures["attempts"].mean >= 1
