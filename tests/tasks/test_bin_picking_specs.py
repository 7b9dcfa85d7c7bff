"""The specs of bin picking, on two demonstrations with tiny pictures: fitted and rolled out as any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ddco_tasks.bin_picking import task
from ddco_tasks.bin_picking.supervisor import JAW_OPEN

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import check_networks

SPECS = sorted((Path(__file__).parents[2] / "specs").glob("bin_picking*.yaml"))
SEEDS = (2, 15)  # bins of three objects
TINY = [
    "observations=[{key: image, resize: [16, 16]}, grasp, kin, load]",
    "demonstrations.valid_fraction=0",
    "compare_with=[]",
    "training.epochs=4",
    "rollout.policies=[]",
]


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two demonstrations."""
    path = tmp_path_factory.mktemp("bin_picking") / "demonstrations.hdf5"
    Demonstrations(tuple(run_episode(task, "supervisor", seed).record for seed in SEEDS)).write(path)
    return path


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_specs_are_checked_against_the_task(path: Path) -> None:
    spec = load_spec(path)
    known = dimensions(spec)
    assert known.shapes == {"image": (72, 72, 2), "grasp": (6,), "kin": (7,), "load": (18,)}
    assert check_networks(spec, known).depth == 1


@pytest.mark.parametrize(("form", "angles", "numbers"), [("pose", 6, 7), ("matrix", 12, 13)])
def test_other_controls_are_checked_against_their_tasks(form: str, angles: int, numbers: int) -> None:
    pose = f"{{name: pose, dims: {list(range(angles))}, kind: gaussian}}"
    parts = f"control.parts=[{pose}, {{name: jaw, dims: [{angles}], kind: binary}}]"
    spec = load_spec(SPECS[0], ["compare_with=[]", f"task=bin_picking_{form}", parts])
    known = dimensions(spec)
    assert known.control_size == numbers
    assert check_networks(spec, known).depth == 1


def test_demonstrations_show_what_the_person_saw(demonstrations: Path) -> None:
    demos = Demonstrations.read(demonstrations, labels=("phase", "held", "kind", "left"))
    for demo in demos:
        assert set(np.unique(np.asarray(demo.observations["image"]))) == {0, 255}
        opened = demo.observations["kin"][:, 6] > JAW_OPEN / 2
        np.testing.assert_array_equal(opened[1:], demo.actions[:-1, 6])  # the jaws are as they were told to be
        carried = np.diff(demo.labels["phase"] == 4, prepend=False) & (demo.labels["phase"] == 4)  # begins to be
        assert (demo.labels["kind"][carried] >= 0).all()
        back = np.diff(demo.labels["phase"] == 3, prepend=False) & (demo.labels["phase"] == 3)
        assert (demo.labels["held"][back] != 1).all()
        assert demo.labels["left"][0] == 3


@pytest.mark.slow
def test_demonstrations_are_fitted_and_rolled_out(demonstrations: Path, tmp_path: Path) -> None:
    fitted = fit(load_spec(SPECS[0], [f"demonstrations.path={demonstrations}", *TINY]), out=tmp_path / "run")
    assert fitted.metrics.engine_check.value < 1e-6
    rolled = roll_out(fitted, 1, jobs=1)
    measures = rolled.methods[fitted.name].measures
    assert measures.keys() == task.measures.keys()
    assert measures["attempts"].mean >= 1
