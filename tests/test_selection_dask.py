"""A selection on a cluster: a real scheduler with two worker processes, one of which is killed half way."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys

import pytest
import yaml
from command_line import call
from killing import HANGS
from selecting import Told, data_at, kept, spec_at

from ddco_pyro.jobs import BackendError
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
    select(spec, tmp_path / "cluster", told, Workers(scheduler=address))
    assert workers[0].returncode == -signal.SIGKILL
    assert workers[1].poll() is None
    assert sorted(pair[1] for pair in told.pairs) == [""] * 8
    select(spec, tmp_path / "here", Told(), Workers(1))
    for name in ("selection.json", "folds.json"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    there, here = kept(tmp_path / "cluster"), kept(tmp_path / "here")
    assert there.keys() == here.keys()
    assert all(there[key]["log_likelihood"] == here[key]["log_likelihood"] for key in here)


@pytest.mark.slow
def test_the_command_runs_on_the_cluster(cluster, tmp_path):
    """After the other test, with the worker that is left."""
    address, _ = cluster
    spec = tmp_path / "spec.yaml"
    spec.write_text(yaml.safe_dump(data_at(tmp_path) | {"selection": {"folds": 2, "grid": {"seed": [1, 2]}}}))
    out = tmp_path / "run"
    ended = call("select", spec, "--backend", "dask", "--scheduler", address, "--out", out)
    assert ended.status == 0, ended.err
    assert len(json.loads((out / "selection.json").read_text())["candidates"]) == 2


def test_a_scheduler_that_does_not_answer_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("ddco_pyro.jobs.CONNECT_SECONDS", 0.5)
    with pytest.raises(BackendError, match=r"^--scheduler tcp://127.0.0.1:9: no dask scheduler answers there within"):
        Workers(scheduler="tcp://127.0.0.1:9").check()


def test_without_dask_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BackendError, match=r"dask is not installed; pip install 'ddco-pyro\[dask\]'"):
        Workers(scheduler="tcp://127.0.0.1:9").check()
