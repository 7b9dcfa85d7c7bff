"""Fixtures that several test files share: one thread, a cache of their own, and a run of the toy task."""

from __future__ import annotations

import os

import pytest
import torch

os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that run episodes
torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    os.environ["DDCO_PYRO_CACHE"] = str(tmp_path_factory.mktemp("cache"))
