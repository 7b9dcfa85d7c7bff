"""Several processes that share each gradient step: the same bits for any number, after a kill, no hang."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
import pytest
import torch
from command_line import Ended, call
from killing import alive
from planted import small_spec
from random_demonstrations import of_states

from ddco_pyro.errors import Failed
from ddco_pyro.events import Counted
from ddco_pyro.fitting.fit import fit
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.spec import dump_spec
from ddco_pyro.training import restarts as restarting
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.loop import StageTraining
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import Trainer
from ddco_pyro.training.stages import plan

DROPPING = {"network": "mlp", "hidden": [6], "dropout": 0.3}
TRAINING = {"shards": 4, "batch_size": 5, "epochs": 16, "starts": ["vq", "random"], "optimizer": {"lr": 0.03}}
"""Minibatches of 5 and of 3 demonstrations: a shard has two or one, or is empty."""


def make_spec(path="unused.hdf5", **training):
    control, training = {"std": 0.5}, {**TRAINING, **training}
    return small_spec(policy=DROPPING, demonstrations={"path": str(path)}, control=control, training=training)


@pytest.fixture(scope="module")
def demos():
    """Of unequal lengths."""
    return of_states(np.random.default_rng(0).integers(4, 9, 10).tolist())


# --- a gradient from shards ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "dtype", "close"), [(8, torch.float32, 1e-6), (3, torch.float64, 1e-12)])
def test_the_gradient_of_four_shards_is_that_of_one(demos, rows, dtype, close):
    minibatch, results = torch.randperm(8, generator=torch.Generator().manual_seed(rows))[:rows], []
    for count in (1, 4):
        data = Trainer(make_spec(shards=count), Dimensions.of(demos), *demos.split(0.2, 0)).data
        model = data.hierarchy(0)
        assert model.step_bytes > 0  # counted on the model as built
        batches = [
            replace(batch, inputs=batch.inputs.map(lambda array: array.to(dtype), batch.inputs.time))
            for batch in (data.train, data.tune)
        ]
        data, model = replace(data, train=batches[0], tune=batches[1]), model.to(dtype)
        stage = StageTraining(data, model, plan(data.spec, 1)[-1], Restart(Progress(0)), last=True)
        value = stage.step(data.train, minibatch, 0)
        results.append((value, [parameter.grad.clone() for parameter in stage.parameters]))
    (value, gradients), (other, others) = results
    assert other == pytest.approx(value, rel=close)
    largest = max(float(gradient.abs().max()) for gradient in gradients)
    assert largest > 0.01
    for gradient, shared in zip(gradients, others, strict=True):
        torch.testing.assert_close(shared, gradient, rtol=close, atol=close * largest)


# --- the command line ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(demos, tmp_path_factory):
    """A spec, and the run of it by a single process."""
    folder = tmp_path_factory.mktemp("whole")
    demos.write(folder / "demos.hdf5")
    spec = make_spec(folder / "demos.hdf5", patience=None)
    (folder / "spec.yaml").write_text(dump_spec(spec))
    fit(folder / "spec.yaml", out=folder / "run")
    return folder / "spec.yaml", folder / "run"


def assert_same_run(folder, run):
    for name in ("spec.yaml", "model.safetensors", "history.csv", "checkpoints/restart-0.safetensors"):
        assert (folder / name).read_bytes() == (run / name).read_bytes(), name


def assert_ends(process, seconds):
    """An orphan, which nobody waits for."""
    deadline = time.monotonic() + seconds
    while alive(process) and time.monotonic() < deadline:
        time.sleep(0.05)
    if alive(process):
        os.kill(process, signal.SIGKILL)
        pytest.fail("the other process goes on alone")


def under_torchrun(folder, *arguments, other=lambda: None):
    """What two processes, as torchrun starts them, end with: the first is this one, the other a copy of it.

    :param other: is called in the other before it begins.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    given = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    told = folder / "other.json"
    child = os.fork()
    if child == 0:
        try:
            os.environ |= given | {"RANK": "1"}
            other()
            told.write_text(json.dumps(call(*arguments)))
        finally:
            os._exit(0)
    with mock.patch.dict(os.environ, given | {"RANK": "0"}):
        first = call(*arguments)
    for _ in range(int(WAIT / 0.05)):
        if os.waitpid(child, os.WNOHANG)[0]:
            return first, Ended(*json.loads(told.read_text()))
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    pytest.fail(f"the other process still waits after the first has ended: {first}")


WAIT = 30.0
"""Seconds after the first process within which the other has to end; a tenth of one on an idle machine."""


def test_a_finished_run_keeps_no_process_of_torchrun_waiting(whole, tmp_path):
    spec, run = whole
    folder = shutil.copytree(run, tmp_path / "run")
    first, other = under_torchrun(tmp_path, "fit", spec, "--out", folder, "--resume")
    assert (first.status, first.out.count("report: ")) == (0, 1)
    assert other == (0, "", "")


def test_what_is_refused_under_torchrun_is_one_line_of_one_process(whole, tmp_path):
    spec, run = whole
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "model.safetensors").unlink()
    checkpoint = folder / "checkpoints" / "restart-0.safetensors"
    checkpoint.write_text("damaged")
    first, other = under_torchrun(tmp_path, "fit", spec, "--out", folder, "--resume")
    assert (first.status, first.err.count("\n")) == (2, 1)
    assert first.err.startswith(f"ddco-pyro: {checkpoint}: is damaged: ")
    assert other == (0, "", "")


LOST = "ddco-pyro: a process that trained together with this one was ended from outside"


def with_training_of_the_other(train, spec, folder):
    """What two processes end with, where the second trains in another way."""
    command = ("fit", spec, "--out", folder / "run")
    return under_torchrun(folder, *command, other=lambda: setattr(restarting, "train", train))


def test_what_goes_wrong_in_one_process_alone_is_said_by_itself(whole, tmp_path):
    def fails(*_, **__):
        raise RuntimeError("no room on this device")

    first, other = with_training_of_the_other(fails, whole[0], tmp_path)
    assert (first.status, first.err.count("\n"), first.err.startswith(LOST)) == (1, 1, True)
    assert (other.status, other.err.count("no room on this device")) == (1, 1)


def test_after_another_process_is_killed_one_process_goes_on_to_the_same_bits(whole, tmp_path):
    spec, run = whole
    real = restarting.train

    def dies(data, restart, *rest):
        (tmp_path / "other.json").write_text('[1, "", ""]')
        real(data, restart, restart.progress.epoch + 1, *rest[1:])
        os.kill(os.getpid(), signal.SIGKILL)

    first, _ = with_training_of_the_other(dies, spec, tmp_path)
    assert (first.status, first.err.count("\n"), first.err.startswith(LOST)) == (1, 1, True)
    assert (tmp_path / "run" / "checkpoints" / "restart-0.safetensors").exists()
    fit(spec, out=tmp_path / "run")
    assert_same_run(tmp_path / "run", run)


LABELS = {"level": "level-1", "from": "phase", "recogniser": "cross_validated"}
MOMENTUM = {"optimizer": {"name": "momentum"}, "average": 0.9}


@pytest.mark.slow  # the two processes above stand for torchrun's
@pytest.mark.parametrize(("number", "training"), [(2, {}), (3, MOMENTUM), (2, {"labels": LABELS})])
def test_processes_of_torchrun_give_the_bits_of_one(demos, tmp_path, number, training):
    each = (
        np.arange(len(demo)) * 2 // len(demo) if n < 3 else np.full(len(demo), -1)
        for n, demo in enumerate(demos)
    )
    phases = (replace(demo, labels={"phase": own}) for demo, own in zip(demos, each, strict=True))
    replace(demos, demonstrations=tuple(phases)).write(tmp_path / "demos.hdf5")
    short = make_spec(tmp_path / "demos.hdf5", patience=None, epochs=4, starts=["vq"], **training)
    (tmp_path / "spec.yaml").write_text(dump_spec(short))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(number)]
    command += ["-m", "ddco_pyro.cli", "fit", "spec.yaml", "--out", "run"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("report: ") == 1
    fit(tmp_path / "spec.yaml", out=tmp_path / "alone")
    assert_same_run(tmp_path / "run", tmp_path / "alone")


def test_more_processes_than_shards_are_refused(whole, tmp_path):
    asked = ("fit", whole[0], "--set", "training.shards=1", "--out", tmp_path / "run")
    first, other = under_torchrun(tmp_path, *asked)
    said = "torchrun started 2 processes, but a minibatch is cut into training.shards=1; add --set "
    said += "training.shards=2"
    assert (first.status, first.err.count("\n"), said in first.err) == (2, 1, True)
    assert other == (0, "", "")
    assert not (tmp_path / "run").exists()


# --- many calls ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_events_come_call_after_call_and_the_wait_is_announced_once(jobs) -> None:
    def tell(number, on_event):  # pickled by value, as it is in no module
        on_event(Counted("seeds", number))
        on_event(Counted("calls", 3, done=number))

    told, calls = [], {n: partial(tell, n) for n in range(3)}
    how = {"ordered": True, "beside": True, "waiting": {n: Counted("seeds", n) for n in calls}}
    with run_all(calls, Workers(jobs), "worked", told.append, **how) as results:
        order = [number for number, _ in results]
    assert order == [0, 1, 2]
    assert told == [event for n in order for event in (Counted("seeds", n), Counted("calls", 3, done=n))]


def test_a_process_that_is_killed_is_one_line(capfd) -> None:
    kill = partial(signal.raise_signal, signal.SIGKILL)
    with (
        pytest.raises(Failed, match=r"^a process that worked was ended from outside"),
        run_all({"kill": kill}, Workers(2), "worked", beside=True) as results,
    ):
        next(results)
    assert capfd.readouterr().err == ""


def test_an_error_ends_what_is_not_done(tmp_path, capfd) -> None:
    def hangs() -> None:
        (tmp_path / str(os.getpid())).touch()
        time.sleep(60)

    with pytest.raises(ValueError), run_all({0: hangs}, Workers(2), "worked", beside=True):  # noqa: PT011, PT012
        while not (begun := [*tmp_path.iterdir()]):
            time.sleep(0.01)
        raise ValueError
    assert_ends(int(begun[0].name), 10)
    assert capfd.readouterr().err == ""


KILLED = """
import os, signal
from ddco_pyro.jobs import Workers, run_all
with run_all(dict.fromkeys(range(9), os.getpid), Workers(2), "worked"{how}) as results:
    process = next(process for _, process in results)
    os.kill(process, 0)
    print(process, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("how", ["", ", beside=True"])
def test_a_process_ends_with_the_one_that_is_killed_while_it_waits_for_work(tmp_path, how) -> None:
    with open(tmp_path / "process", "w") as file:
        killed = subprocess.run([sys.executable, "-c", KILLED.format(how=how)], stdout=file)
    assert killed.returncode == -signal.SIGKILL
    assert_ends(int((tmp_path / "process").read_text()), 10)
