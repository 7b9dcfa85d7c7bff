"""Fixtures that several test files share: one thread, a cache of their own, and a fitted run of the toy task.

No test depends on how busy the machine is, and every run draws the same examples.
"""

import os
import sys
from pathlib import Path
from unittest import mock

import pytest
import torch
import toy_task
import yaml
from dots import followed
from hypothesis import settings

from ddco_pyro.errors import Failed
from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import parse_spec

HERE = Path(__file__).parent
SUPPORT = HERE / "support"
INSTALLED = HERE / "fixtures" / "installed"
"""Like a folder that packages are installed in: it registers the toy task under the name ``toy``."""

sys.path.append(str(INSTALLED))
os.environ["PYTHONPATH"] = f"{SUPPORT}:{INSTALLED}"  # of the processes that tests start
os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that run episodes
os.environ["LOKY_MAX_CPU_COUNT"] = "1"  # "all cores" is one: the workers of pytest-xdist have the others
torch.set_num_threads(1)
settings.register_profile("deterministic", deadline=None, derandomize=True)
settings.load_profile("deterministic")


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """The folder where these tests, and the processes they start, keep collected demonstrations."""
    folder = tmp_path_factory.mktemp("cache")
    os.environ["DDCO_PYRO_CACHE"] = str(folder)
    return folder


@pytest.fixture(scope="session")
def toy_spec():
    return parse_spec(yaml.safe_load(toy_task.SPEC))


@pytest.fixture(scope="session")
def watched():
    """The events of the fit of the toy task."""
    return []


@pytest.fixture(scope="session")
def toy_run(cache, tmp_path_factory, toy_spec, watched):
    """A fit of the toy task with both baselines beside it; nobody changes its folder."""
    return fit(toy_spec, out=tmp_path_factory.mktemp("runs") / "toy", on_event=watched.append)


@pytest.fixture
def undecided(monkeypatch):
    """``init`` asks no small fits, as where they fail: they take most of its time."""
    monkeypatch.setattr("ddco_pyro.selection.small.decide", mock.Mock(side_effect=Failed("no small fits")))


@pytest.fixture(scope="session")
def few_dots(tmp_path_factory):
    """A file of six demonstrations whose pictures show a dot."""
    path = tmp_path_factory.mktemp("dots") / "few.hdf5"
    followed(6).write(path)
    return path
