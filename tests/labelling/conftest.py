"""A fit of planted demonstrations, for sessions, their page and their server."""

import pytest

from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import parse_spec


@pytest.fixture(scope="package")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "demos.hdf5"
    pick_and_place(6).write(path)
    return path


@pytest.fixture(scope="package")
def run(file, tmp_path_factory):
    linear = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
    spec = {
        "demonstrations": {"path": str(file), "valid_fraction": 0},
        "observations": ["gripper", "object", "goal", "jaw"],
        "control": {"std": {"learn": True, "floor": 0.01, "per_option": True}, "power": 0.1},
        "hierarchy": {"levels": [{"name": "skill", "count": 4, **linear}], "meta_policy": linear["policy"]},
        "training": {"optimizer": {"name": "em"}, "tune_fraction": 0, "epochs": 5},
        "report": {"trajectory": "gripper"},
        "compare_with": [],
    }
    return fit(parse_spec(spec), out=tmp_path_factory.mktemp("run") / "run")
