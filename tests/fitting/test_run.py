"""The run folder: what is in it, that its numbers can be computed from it, and it comes back to a bit."""

import csv
import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
from killing import Interrupting

import ddco_pyro
from ddco_pyro.errors import BadInput
from ddco_pyro.events import EpochEnded
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.run import claim, claimed
from ddco_pyro.metrics import Counts
from ddco_pyro.spec import dump_spec, with_overrides
from ddco_pyro.training.data import demonstrations


@pytest.fixture(scope="module")
def demos(toy_spec, cache):
    return demonstrations(toy_spec)


@pytest.fixture(scope="module")
def parts(toy_spec, demos):
    train, valid = demos.split(toy_spec.demonstrations.valid_fraction, toy_spec.seed)
    return {"train": train, "valid": valid}


@pytest.fixture
def copied(toy_run, tmp_path):
    return shutil.copytree(toy_run.folder, tmp_path / "run")


# --- contents -----------------------------------------------------------------------------------------------

FILES = {
    "spec.yaml",
    "demonstrations.json",
    "model.safetensors",
    "metrics.json",
    "history.csv",
    "checkpoints/restart-0.safetensors",
}


def test_the_folder_holds_what_it_promises(toy_run):
    files = {str(path.relative_to(toy_run.folder)) for path in toy_run.folder.rglob("*") if path.is_file()}
    beside = {f"baselines/{kind}/{name}" for kind in ("flat", "per_timestep") for name in FILES}
    assert files == FILES | beside | {"names.yaml"}


def test_the_history_has_every_epoch(toy_run, watched):
    rows = list(csv.DictReader((toy_run.folder / "history.csv").open()))
    told = [asdict(row) for row in watched if isinstance(row, EpochEnded) and row.stage != "policy"]
    assert [{**row, "restart": str(row["restart"]), "epoch": str(row["epoch"])} for row in told] == [
        {**row, "train": float(row["train"]), "tune": float(row["tune"])} for row in rows
    ]
    stages = ["vq-1"] * 6 + ["level-1"] * 6 + ["meta-policy"] * 6 + ["joint"] * 6
    assert [row["stage"] for row in rows] == stages


# --- the numbers again --------------------------------------------------------------------------------------


def test_log_likelihoods_can_be_computed_again(toy_run, parts):
    metrics, loaded = toy_run.metrics, ddco_pyro.load(toy_run.folder)
    for name, part in parts.items():
        value = loaded.log_likelihood(part).sum() / sum(part.lengths)
        assert getattr(metrics.log_likelihood_per_step, name) == pytest.approx(value, rel=1e-12)
    assert [dict(one) for one in metrics.valid] == [
        {"name": demo.name, "steps": len(demo), "log_likelihood": pytest.approx(value)}
        for demo, value in zip(parts["valid"], loaded.log_likelihood(parts["valid"]), strict=True)
    ]


def test_baselines_are_trained_on_the_same_split(toy_run):
    metrics = toy_run.metrics
    supervisor = metrics.demonstrations.supervisor
    assert metrics.demonstrations == Counts(train=8, tune=1, valid=3, supervisor=supervisor)
    for baseline in toy_run.baselines.values():
        for key in ("name", "steps"):
            own, ours = ([getattr(one, key) for one in each.valid] for each in (baseline.metrics, metrics))
            assert own == ours
        assert baseline.metrics.demonstrations == metrics.demonstrations
        for name in ("mean", "std"):
            ours, theirs = (getattr(one.hierarchy.encoder, name) for one in (toy_run, baseline))
            np.testing.assert_array_equal(ours, theirs)


def test_only_the_training_demonstrations_standardise(toy_run, parts, toy_spec):
    kept, _ = parts["train"].split(toy_spec.training.tune_fraction, toy_spec.seed)
    rows = np.concatenate([demo.observations["offsets"] for demo in kept])
    np.testing.assert_allclose(toy_run.hierarchy.encoder.mean[:4], rows.mean(0))
    controls = np.concatenate([demo.actions for demo in kept])
    np.testing.assert_allclose(toy_run.hierarchy.scaling.scale, controls.std(0))


# --- going on -----------------------------------------------------------------------------------------------


def test_an_interrupted_run_goes_on_to_the_same_bytes(toy_run, toy_spec, tmp_path):
    """In a baseline."""
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        fit(toy_spec, out=folder, on_event=Interrupting(29))
    fit(toy_spec, out=folder)
    for name in ("model.safetensors", "history.csv", "baselines/flat/model.safetensors", "spec.yaml"):
        assert (folder / name).read_bytes() == (toy_run.folder / name).read_bytes()
    for name in ("metrics.json", "baselines/flat/metrics.json"):
        texts = [(one / name).read_text() for one in (folder, toy_run.folder)]
        ours, theirs = (json.loads(text) | {"seconds": ...} for text in texts)
        assert ours == theirs
    assert not list(folder.rglob("*.tmp"))


def test_a_finished_run_is_left_as_it_is(copied, toy_spec):
    metrics = copied / "metrics.json"
    metrics.write_text(json.dumps(json.loads(metrics.read_text()) | {"note": "kept"}))
    paths = [path for path in copied.rglob("*") if path.is_file()]
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}
    assert fit(toy_spec, out=copied, on_event=Interrupting(1)).metrics.model_extra == {"note": "kept"}
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in before} == before


def test_claiming_a_folder(tmp_path, toy_spec):
    folder = tmp_path / "run"
    claim(folder, toy_spec, resume=False)
    assert (folder / "spec.yaml").read_text() == dump_spec(toy_spec)
    (folder / ".spec.yaml-killed.tmp").touch()  # what a killed process left
    claim(folder, toy_spec, resume=False)
    (folder / "model.safetensors").touch()
    (folder / "metrics.json").touch()
    claim(folder, toy_spec, resume=False)  # killed before its report
    (folder / "report.html").touch()
    claim(folder, toy_spec, resume=True)
    says = r"run: holds a run of this spec already; show it with --resume, or choose"
    with pytest.raises(BadInput, match=says):
        claim(folder, toy_spec, resume=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r": is not empty and not a run; choose another --out$"):
        claim(tmp_path, toy_spec)
    says = r"file: is a file; choose another --out$"
    with pytest.raises(BadInput, match=says), claimed(tmp_path / "file", toy_spec):
        pass


UNFINISHED = r"run: an unfinished run: fit it again to continue it \(it has no "


@pytest.mark.parametrize(
    ("removed", "message"),
    [
        ("spec.yaml", r"run: not a run folder \(it has no spec\.yaml\)$"),
        ("model.safetensors", UNFINISHED + r"model\.safetensors\)$"),
        ("metrics.json", UNFINISHED + r"metrics\.json\)$"),
    ],
)
def test_what_is_not_a_finished_run_is_not_loaded(copied, removed, message):
    (copied / removed).unlink()
    with pytest.raises(BadInput, match=message):
        ddco_pyro.load(copied)


def test_a_model_of_another_spec_is_not_loaded(copied, toy_spec):
    (copied / "spec.yaml").write_text(dump_spec(with_overrides(toy_spec, {"hierarchy.levels.0.count": 3})))
    says = r"run/model\.safetensors: is of another spec than spec\.yaml; remove it and"
    with pytest.raises(BadInput, match=says):
        ddco_pyro.load(copied)
