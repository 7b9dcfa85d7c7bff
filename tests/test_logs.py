"""Logs of training, read back by the programs that they are for."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import call
from random_demonstrations import demonstrations

import ddco_pyro
from ddco_pyro.errors import BadInput
from ddco_pyro.events import DemonstrationsDone, EpochEnded, TrainingBegan
from ddco_pyro.logs import LOGS, Logged, find_log

SPEC = {
    "observations": ["pose"],
    "hierarchy": {"levels": [{"count": 2, "policy": {"network": "linear"}}], "meta_policy": {"network": "linear"}},
    "compare_with": [{"kind": "flat", "policy": {"network": "linear"}}],
    "training": {"epochs": 4, "starts": ["random"], "layerwise": False},
}


@pytest.fixture(scope="module")
def spec(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    demonstrations(8).write(folder / "demos.hdf5")
    path = folder / "spec.yaml"
    path.write_text(yaml.safe_dump(SPEC | {"demonstrations": {"path": str(folder / "demos.hdf5")}}))
    return path


def history(run: Path) -> dict[str, list[tuple[int, float]]]:
    """The epochs of ``history.csv`` by the names of the log."""
    found: dict[str, list[tuple[int, float]]] = {}
    for folder, model in ((run, "ddco"), (run / "baselines" / "flat", "flat")):
        for row in csv.DictReader((folder / "history.csv").open()):
            for part in ("train", "tune"):
                found.setdefault(f"{model}/{row['stage']}/{part}", []).append((int(row["epoch"]), float(row[part])))
    return found


def held_out(run: Path) -> dict[str, float]:
    metrics = ddco_pyro.load(run).metrics
    return {
        "ddco/held_out": metrics.log_likelihood_per_step.valid,
        "flat/held_out": metrics.comparison["flat"].log_likelihood_per_step.valid,
    }


def test_a_class_of_ones_own_gets_the_history(spec: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    refused = call("fit", spec, "--out", run, "--log", "user_logs:Lines")
    assert (refused.status, refused.err.count("\n")) == (2, 1)
    assert "--log user_logs:Lines: would import user code; pass --allow-code" in refused.err
    assert not run.exists()
    assert call("fit", spec, "--out", run, "--log", "user_logs:Lines", "--allow-code").status == 0
    (_, first), *rows = map(json.loads, (run / "log.jsonl").read_text().splitlines())
    assert first == {"seed": 0}
    logged: dict[str, list[tuple[int, float]]] = {}
    for step, values in rows:
        for name, value in values.items():
            logged.setdefault(name, []).append((step, value))
    last = {name: logged.pop(name) for name in list(logged) if name.endswith("held_out")}
    assert last == {name: [(0, value)] for name, value in held_out(run).items()}
    expected = history(run)
    assert set(logged) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(logged[name], values)


def test_restarts_have_names_of_their_own_and_numbers_are_finite(tmp_path: Path) -> None:
    got = []

    class Kept:
        def __init__(self, folder, spec):
            got.append((folder, spec))

        def scalars(self, values, step):
            got.append((values, step))

        def close(self):
            got.append("closed")

    with Logged(Kept, tmp_path / "run", {"seed": 3}) as log:
        log(DemonstrationsDone(1, 2))
        assert got == []  # the run folder is not there yet
        log(TrainingBegan("DDCO", 5))
        log(EpochEnded(0, "joint", 2, -1.0, float("nan")))
        log(EpochEnded(1, "joint", 3, -2.0, -3.0))
    assert got == [
        (tmp_path / "run", {"seed": 3}),
        ({"DDCO/joint/train": -1.0}, 2),
        ({"DDCO/joint/restart 1/train": -2.0, "DDCO/joint/restart 1/tune": -3.0}, 3),
        "closed",
    ]


def test_what_is_no_log_is_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    with pytest.raises(BadInput, match=r"no log 'tensorbord' \(did you mean 'tensorboard'\?\); there is: tensorboard"):
        find_log("tensorbord")
    with pytest.raises(BadInput, match="user_logs:Line: cannot be imported: AttributeError"):
        find_log("user_logs:Line", allow_code=True)
    for name, (_, package) in LOGS.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(BadInput, match=rf"--log {name}: needs .*pip install 'ddco-pyro\[{name.split('-')[0]}\]'"):
            find_log(name)


@pytest.mark.slow
def test_tensorboards_own_reader_reads_the_history(spec: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = tmp_path / "run"
    assert call("fit", spec, "--out", run, "--log", "tensorboard").status == 0
    read = EventAccumulator(str(run / "tensorboard")).Reload()
    expected = history(run) | {name: [(0, value)] for name, value in held_out(run).items()}
    assert set(read.Tags()["scalars"]) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose([(event.step, event.value) for event in read.Scalars(name)], values, rtol=1e-5)


@pytest.mark.slow
def test_mlflow_has_the_history_and_the_spec(spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"file://{tmp_path / 'mlruns'}")
    monkeypatch.delenv("MLFLOW_ALLOW_FILE_STORE", raising=False)
    ended = call("fit", spec, "--out", tmp_path / "refused", "--log", "mlflow")
    assert (ended.status, "--log: the log cannot be made: " in ended.err) == (1, True)
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    from mlflow import MlflowClient

    run = tmp_path / "run"
    assert call("fit", spec, "--out", run, "--log", "mlflow").status == 0
    client = MlflowClient(f"file://{tmp_path / 'mlruns'}")
    (found,) = client.search_runs(["0"])
    assert (found.info.run_name, found.info.status) == ("run", "FINISHED")
    for name, values in history(run).items():
        read = sorted((metric.step, metric.value) for metric in client.get_metric_history(found.info.run_id, name))
        np.testing.assert_allclose(read, values)


@pytest.mark.slow
def test_wandb_writes_a_run_to_upload_later(spec: Path, tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    run = tmp_path / "run"
    assert call("fit", spec, "--out", run, "--log", "wandb-offline").status == 0
    (written,) = (run / "wandb").glob("offline-run-*/run-*.wandb")
    assert written.stat().st_size > 0
