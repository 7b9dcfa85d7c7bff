"""The specs of bin picking, on two demonstrations with tiny pictures: fitted and rolled out as any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bin_picking import criteria
from bin_picking_recovery import Load, Trial, counted
from ddco_tasks.bin_picking import task
from ddco_tasks.bin_picking.supervisor import JAW_OPEN
from ddco_tasks.bin_picking.trials import Attempt, Trials

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


# --- what the studies make of demonstrations --------------------------------------------------------------------------


def test_criteria_are_sums_over_bins() -> None:
    nothing = Trials(()).measures() | dict.fromkeys(("cleared", "success"), 0.0)
    first = nothing | {"cleared": 1, "attempts": 4, "single": 3, "due_recoveries": 2, "nothing": 1, "recovered": 2}
    second = nothing | {"attempts": 2, "single": 0, "due_recoveries": 2, "recovered": 1, "nothing_recovered": 0}
    found = criteria([first | {"nothing_recovered": 1}, second])
    assert found["success"] == (1, 2)
    assert found["grasp of exactly one"] == (3, 6)
    assert found["recovery, recall"] == (3, 4)
    assert found["recall where nothing is held"] == (1, 1)
    assert found["recall where several are"] == (2, 3)


def test_recoveries_are_of_what_is_held_where_it_is_shown() -> None:
    """What is lost after it was shown alone is nobody's to take back; trials without a decision do not count."""
    none, first, both = frozenset[int](), frozenset({0}), frozenset({0, 1})
    back, several = Attempt(2, none, none, ("bin",), 10), Attempt(2, both, both, ("bin", "bin"), 10)
    cup, lost = Attempt(2, first, first, ("accept",), 10), Attempt(2, first, none, ("accept",), 10)
    dropped, kept = Attempt(2, first, first, ("bin",), 10), Attempt(2, first, first, (), 20)
    shown = [(none, back), (none, lost), (both, several), (both, cup), (first, cup), (first, lost)]
    others = [(first, dropped), (first, None), (None, back), (first, kept)]
    trials = []
    for held, attempt in shown + others:
        load = None if held is None else Load(held, shown=True, seen=bool(held))
        trials.append(Trial(slice(0, 10), first, attempt, load))
    found = counted(trials)
    falling = counted([Trial(slice(0, 10), first, lost, Load(none, shown=True, seen=True))])
    assert found == {
        "nothing": 2, "nothing back": 1, "unseen": 2, "unseen back": 1, "several": 2, "several back": 1, "one": 3,
        "one back": 1, "one lost": 1, "due back": 4, "back": 2,
    }  # fmt: skip
    assert (falling["nothing"], falling["unseen"]) == (1, 0)
