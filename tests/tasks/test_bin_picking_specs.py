"""The specs of bin picking, on two demonstrations with tiny pictures: collected, fitted and rolled out as any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ddco_tasks.bin_picking import task

from ddco_pyro.fitting.building import check_networks
from ddco_pyro.fitting.prepare import demonstrations, dimensions
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.fitting.run import fit
from ddco_pyro.spec import Spec, load_spec

SPECS = sorted((Path(__file__).parents[2] / "specs").glob("bin_picking*.yaml"))
FIRST = 10  # seed of the first of two bins of four objects
TINY = [
    "observations=[{key: image, resize: [16, 16]}, grasp, kin]",
    "demonstrations.count=2",
    f"demonstrations.seed={FIRST}",
    "demonstrations.valid_fraction=0",
    "compare_with=[]",
    "training.epochs=4",
    "rollout.policies=[]",
]


def tiny(path: Path) -> Spec:
    """The spec, on two demonstrations and for four epochs in all."""
    return load_spec(path, TINY)


def test_both_specs_are_here() -> None:
    assert [path.stem for path in SPECS] == ["bin_picking", "bin_picking_hybrid"]


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_specs_are_checked_against_the_task(path: Path) -> None:
    spec = load_spec(path)
    known = dimensions(spec)
    assert known.shapes == {"image": (64, 64, 2), "grasp": (6,), "kin": (7,)}
    assert check_networks(spec, known).depth == 1


def test_two_demonstrations_are_collected_fitted_and_rolled_out(tmp_path: Path) -> None:
    spec = tiny(SPECS[0])
    demos = demonstrations(spec)
    assert [set(one.labels["phase"]) >= {0, 1, 2, 4, 5} for one in demos] == [True, True]
    images = np.asarray(demos[0].observations["image"])
    assert images.dtype == np.uint8
    assert set(np.unique(images)) == {0, 255}
    fitted = fit(spec, out=tmp_path / "run")
    assert fitted.metrics["engine_check"]["value"] < 1e-6
    parts = fitted.metrics["control"]["parts"]
    assert [part["kind"] for part in parts] == ["binary", "gaussian"]
    rolled = roll_out(fitted, 1, jobs=1)
    assert rolled["methods"][fitted.name]["measures"].keys() == task.measures.keys()
