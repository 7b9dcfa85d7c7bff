"""A damaged file of a run: one line with the file and what to do, from every command that reads it."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import call

import ddco_pyro
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.training.data import demonstrations


@pytest.fixture(scope="module")
def rolled(toy_run: Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was rolled out, and its demonstrations; nobody changes it."""
    folder = tmp_path_factory.mktemp("rolled")
    shutil.copytree(toy_run.folder, folder / "run")
    demonstrations(toy_run.spec).write(folder / "demos.hdf5")
    roll_out(ddco_pyro.load(folder / "run"), 2, jobs=1)
    return folder


@pytest.fixture
def run(rolled: Path, tmp_path: Path) -> Path:
    shutil.copytree(rolled, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


COMMANDS = {
    "compare": ("compare", "RUN/baselines/flat", "RUN", "--out", "compared"),
    "report": ("report", "RUN"),
    "rollout": ("rollout", "RUN", "--episodes", "1", "--jobs", "1"),
    "segment": ("segment", "RUN", "DEMOS", "--csv", "a.csv"),
    "export": ("export", "RUN", "--out", "controller"),
}


def refused(run: Path, command: tuple[str, ...], path: Path, what: str) -> None:
    """The command says in one line that this file is damaged, and changes nothing."""
    before = {one: one.read_bytes() for one in run.parent.rglob("*") if one.is_file()}
    named = [one.replace("RUN", str(run)).replace("DEMOS", str(run.parent / "demos.hdf5")) for one in command]
    ended = call(*named)
    assert (ended.status, ended.err.count("\n")) == (2, 1), ended.err
    assert ended.err.startswith(f"ddco-pyro: {path}: is damaged: {what}")
    assert "; remove it and " in ended.err
    assert {one: one.read_bytes() for one in run.parent.rglob("*") if one.is_file()} == before


# --- metrics.json -------------------------------------------------------------------------------------------


def test_damaged_metrics(run: Path) -> None:
    path = run / "metrics.json"
    whole = path.read_text()
    data = json.loads(whole)
    many = whole.replace('"parameters": ', '"parameters": "many", "was": ')
    (table,) = data["agreement"]["confusion"]
    tables = {**data["agreement"], "confusion": [{**table, "steps": table["steps"][:-1]}]}
    of_options = json.dumps(data | {"options": [[*data["options"][0], data["options"][0][-1]]]})
    for content, what in (
        (whole[: len(whole) // 2], "is no JSON: EOF while parsing"),
        ("[]", "must be a mapping (key: value), got []"),
        (many, "comparison.flat.parameters: must be a whole number, got 'many'"),
        (of_options, "is not about levels with 2"),
        (json.dumps(data | {"agreement": tables}), "agreement.confusion.0: is no table of labels by options"),
        ('{"model": NaN}', ""),
    ):
        path.write_text(content)
        refused(run, COMMANDS["report"], path, what)
    path.write_bytes(b"\xff\xfe\x00")
    refused(run, COMMANDS["report"], path, "")
    path.write_text(whole)
    (run / "baselines" / "flat" / "metrics.json").write_text("{}")
    refused(run, COMMANDS["report"], run / "baselines" / "flat" / "metrics.json", "model: missing")


def test_every_command_refuses_damaged_metrics_and_a_damaged_model(run: Path, monkeypatch) -> None:
    monkeypatch.chdir(run.parent)
    metrics, model = run / "metrics.json", run / "model.safetensors"
    whole, content = metrics.read_text(), model.read_bytes()
    for command in COMMANDS.values():
        metrics.write_text("{}")
        refused(run, command, metrics, "model: missing")
        metrics.write_text(whole)
        model.write_bytes(content[:-3] + bytes([content[-3] ^ 1]) + content[-2:])
        refused(run, command, model, "its contents are not what was written")
        model.write_bytes(content)
    for damaged in (b"", content[:40], content[:-8], b"\xff" * 100):
        model.write_bytes(damaged)
        refused(run, COMMANDS["report"], model, "")


def test_weights_that_are_not_finite(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.parent)
    for model, value in ((".", float("nan")), ("baselines/flat", float("inf"))):
        path = run / model / "model.safetensors"
        content, (tensors, metadata) = path.read_bytes(), read_tensors(path)
        real = {name: one for name, one in sorted(tensors.items()) if one.is_floating_point()}
        name = next(name for name, one in real.items() if one.numel() > 1)
        tensors[name].view(-1)[1] = value
        write_tensors(path, tensors, metadata)
        refused(run, COMMANDS["compare"], path, f"{name} has numbers that are NaN or infinite")
        path.write_bytes(content)


def test_what_is_removed_is_made_again(run: Path) -> None:
    """As the line says that is to be done."""
    metrics = json.loads((run / "metrics.json").read_text())
    model = (run / "model.safetensors").read_bytes()
    (run / "model.safetensors").write_text("damaged")
    command = call("report", run).err.partition("; remove it and fit again: ddco-pyro ")[2].split()
    assert command == ["fit", str(run / "spec.yaml"), "--out", str(run), "--resume"]
    path = run / "checkpoints" / "restart-0.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[:-3] + bytes([content[-3] ^ 1]) + content[-2:])
    for name in ("metrics.json", "model.safetensors"):
        (run / name).unlink()
    refused(run, tuple(command), path, "its contents are not what was written")
    path.unlink()
    ddco_pyro.fit(run / "spec.yaml", out=run)
    assert (run / "model.safetensors").read_bytes() == model
    again = json.loads((run / "metrics.json").read_text())
    aside = {"seconds": ..., "rollouts": ..., "engine_check": ...}
    assert again | aside == metrics | aside


@pytest.mark.parametrize(
    ("name", "content", "command"),
    [
        ("rollouts.csv", b"method,seed,success\nddco,x,1\n", "compare"),
        ("rollouts.csv", b"\xff\xfe", "compare"),
        ("history.csv", b"a\n1\n", "report"),
    ],
)
def test_a_damaged_table(run: Path, monkeypatch, name: str, content: bytes, command: str) -> None:
    monkeypatch.chdir(run.parent)
    (run / "videos").mkdir(exist_ok=True)
    (run / "videos" / "ddco-1000.mp4").touch()  # a film, whose outcome is in the table
    (run / name).write_bytes(content)
    refused(run, COMMANDS[command], run / name, "")
    assert call("report", run).err.startswith(f"ddco-pyro: {run / name}: is damaged: ")
