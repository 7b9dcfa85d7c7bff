"""Logs of training, read back by the programs that they are for."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import call, done
from planted import LINEAR, small_spec
from random_demonstrations import demonstrations

import ddco_pyro
from ddco_pyro.events import LOGS, Counted, EpochEnded, Log, TrainingBegan
from ddco_pyro.spec import dump_spec


@pytest.fixture(scope="module")
def spec(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    demonstrations(8).write(folder / "demos.hdf5")
    path = folder / "spec.yaml"
    spec = small_spec(
        demonstrations={"path": str(folder / "demos.hdf5")},
        observations=["pose"],
        compare_with=[{"kind": "flat", "policy": LINEAR}],
        training={"epochs": 4, "starts": ["random"], "layerwise": False},
    )
    path.write_text(dump_spec(spec))
    return path


def history(run: Path) -> dict[str, list[tuple[int, float]]]:
    """The epochs of ``history.csv`` by the names of the log."""
    found: dict[str, list[tuple[int, float]]] = {}
    for folder, model in ((run, "ddco"), (run / "baselines" / "flat", "flat")):
        for row in csv.DictReader((folder / "history.csv").open()):
            for part in ("train", "tune"):
                point = (int(row["epoch"]), float(row[part]))
                found.setdefault(f"{model}/{row['stage']}/{part}", []).append(point)
    return found


def held_out(run: Path) -> dict[str, float]:
    metrics = ddco_pyro.load(run).metrics
    return {
        "ddco/held_out": metrics.log_likelihood_per_step.valid,
        "flat/held_out": metrics.comparison["flat"].log_likelihood_per_step.valid,
    }


class Kept:
    """In place of a program: what it got; ``fails`` at that number."""

    def __init__(self, fails=None):
        self.got, self.fails = [], fails

    def __call__(self, folder, spec):
        self.got.append((folder, spec))
        return self.add, self.close

    def add(self, values, step):
        if step == self.fails:
            raise ConnectionError("the server\nis gone")
        self.got.append((values, step))

    def close(self):
        self.got.append("closed")


def test_restarts_have_names_of_their_own_and_numbers_are_finite(tmp_path, monkeypatch) -> None:
    said, kept = [], Kept()
    monkeypatch.setitem(LOGS, "tensorboard", (kept, "ddco_pyro"))
    with Log("tensorboard", tmp_path / "run", {"seed": 3}, said.append) as log:
        log(Counted("seeds", 2))
        log(TrainingBegan("DDCO", 5))
        assert kept.got == []  # the run folder may not be there yet
        log(EpochEnded(0, "joint", 2, -1.0, float("nan")))
        log(EpochEnded(1, "joint", 3, -2.0, -3.0))
    assert said == []
    assert kept.got == [
        (tmp_path / "run", {"seed": 3}),
        ({"DDCO/joint/train": -1.0}, 2),
        ({"DDCO/joint/restart 1/train": -2.0, "DDCO/joint/restart 1/tune": -3.0}, 3),
        "closed",
    ]


def test_the_fit_goes_on_where_a_log_fails(spec: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(LOGS, "tensorboard", (Kept(fails=2), "ddco_pyro"))
    ended = done("fit", spec, "--out", tmp_path / "run", "--log", "tensorboard")
    assert ended.out.count("the fit goes on without this log") == 1


def test_what_is_no_log_is_refused_in_a_line(spec: Path, tmp_path: Path, monkeypatch) -> None:
    for name, package in {"tensorbord": "", **{name: package for name, (_, package) in LOGS.items()}}.items():
        monkeypatch.setitem(sys.modules, package, None)
        ended = call("fit", spec, "--out", tmp_path / "run", "--log", name)
        assert (ended.status, ended.err.count("\n")) == (2, 1)
        said = f"--log {name}: needs {package}; install it with: pip install 'ddco-pyro[{package}]'"
        unknown = "there is no log 'tensorbord' (did you mean 'tensorboard'?); there is: tensorboard"
        said = said if package else unknown
        assert said in ended.err
        assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_tensorboards_own_reader_reads_the_history(spec: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = tmp_path / "run"
    done("fit", spec, "--out", run, "--log", "tensorboard")
    read = EventAccumulator(str(run / "tensorboard")).Reload()
    expected = history(run) | {name: [(0, value)] for name, value in held_out(run).items()}
    assert set(read.Tags()["scalars"]) == set(expected)
    for name, values in expected.items():
        found = [(event.step, event.value) for event in read.Scalars(name)]
        np.testing.assert_allclose(found, values, rtol=1e-5)


@pytest.mark.slow
def test_wandb_writes_a_run_to_upload_later(spec: Path, tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    run = tmp_path / "run"
    done("fit", spec, "--out", run, "--log", "wandb-offline")
    (written,) = (run / "wandb").glob("offline-run-*/run-*.wandb")
    assert written.stat().st_size > 0
