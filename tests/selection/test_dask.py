"""A selection on a cluster: a real scheduler with two worker processes, one of which is killed half way."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys

import joblib
import pytest
from killing import HANGS
from selecting import Told, kept, spec_at

from ddco_pyro.selection import Workers, select

distributed = pytest.importorskip("distributed")


class Killing(Told):
    """Kills a process when some folds have been scored."""

    def __init__(self, process, after):
        super().__init__()
        self.process, self.after = process, after

    def __call__(self, event):
        super().__call__(event)
        if len(self.pairs) == self.after and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """The address of a scheduler, and its two workers."""
    folder = tmp_path_factory.mktemp("dask")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    commands = [
        ["scheduler", "--host", address, "--no-dashboard", "--no-show"],
        *[["worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", folder]] * 2,
    ]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    processes = [
        subprocess.Popen([sys.executable, "-m", "dask", *command], env=environment, cwd=folder, **streams)
        for command in commands
    ]
    with distributed.Client(address, timeout=HANGS) as client:
        client.wait_for_workers(2, timeout=HANGS)
    yield address, processes[1:]
    for process in processes:
        process.send_signal(signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_nothing(cluster, tmp_path):
    address, workers = cluster
    spec = spec_at(tmp_path)
    told = Killing(workers[0], after=3)
    with distributed.Client(address), joblib.parallel_config("dask"):
        select(spec, tmp_path / "cluster", told)
    assert workers[0].returncode == -signal.SIGKILL
    assert workers[1].poll() is None
    assert sorted(pair[1] for pair in told.pairs) == [""] * 8
    select(spec, tmp_path / "here", Told(), Workers(1))
    for name in ("selection.json", "folds.json"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    there, here = kept(tmp_path / "cluster"), kept(tmp_path / "here")
    assert there.keys() == here.keys()
    assert all(there[key]["log_likelihood"] == here[key]["log_likelihood"] for key in here)
