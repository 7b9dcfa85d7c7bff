"""Exported controllers act as the original does, with numpy alone, as a torch.export program, and as ONNX."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_cli import call

import ddco_pyro
from ddco_pyro.controller import Controller
from ddco_pyro.export import TOLERANCE, export, runner
from ddco_pyro.export.program import StepProgram
from ddco_pyro.hierarchy import Hierarchy
from ddco_pyro.run import Fit
from ddco_pyro.spec import parse_spec

SHAPES = {"state": (3,), "goal": (2, 2), "camera": (9, 12, 3)}


def make(network="mlp", counts=(3,), emits=("options",), camera=False, **rollout):
    """A run that was never fitted: random weights, observations with a mean and a spread."""
    levels = [
        {"name": f"level-{d}", "count": k, "policy": {"network": network} | ({"emits": list(emits)} if d else {})}
        for d, k in enumerate(counts)
    ]
    endings = {"network": network if network in ("conv", "per_timestep") else "linear"}
    model = {
        "hierarchy": {
            "levels": [level | {"termination": endings} for level in levels],
            "meta_policy": {"network": network, "emits": list(emits)},
        }
    }
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": [{"key": "state", "differences": True}, "goal", *(["camera"] if camera else [])],
            "control": {"std": {"learn": True}},
            "rollout": rollout,
            **(model if counts else {"baseline": {"kind": "flat", "policy": {"network": network}}}),
        }
    )
    torch.manual_seed(1)
    hierarchy = Hierarchy(spec, SHAPES, 2, steps=7)
    hierarchy.encoder.mean.uniform_(-3, 3)
    hierarchy.encoder.std.uniform_(0.5, 2)
    hierarchy.encoder.mean[3:6] = 0  # of the differences: it goes to and fro
    hierarchy.scaling.scale.copy_(torch.tensor([10.0, 0.3]))
    hierarchy.scaling.shift.copy_(torch.tensor([-4.0, 1.0]))
    return Fit(Path("run"), spec, hierarchy.eval())


@pytest.mark.parametrize(
    "fit",
    [
        make("linear", options="most_likely"),
        make("mlp", control="sample"),
        make("per_timestep"),
        make("conv", camera=True),
        make("mlp", (2, 3), ("options", "control"), control="sample"),
        make("mlp", (2, 3, 2), ("options", "control")),
        make("mlp", ()),
    ],
    ids=["linear", "mlp", "per_timestep", "conv", "hybrid", "three levels", "flat"],
)
def test_numpy_acts_as_the_controller_does(fit, tmp_path, monkeypatch):
    monkeypatch.setattr("ddco_pyro.export._write_programs", lambda *arguments: None)
    found = export(fit, tmp_path)
    assert found["numpy"][0] < TOLERANCE
    exported, original = runner.Runner(tmp_path), Controller.from_spec(fit.hierarchy, fit.spec.rollout)
    random, active = np.random.default_rng(3), set()
    for seed in range(4):
        exported.reset(seed)
        original.reset(seed)
        for _ in range(12):
            seen = {key: random.normal(size=shape) for key, shape in SHAPES.items()}
            seen["camera"] = random.integers(0, 256, SHAPES["camera"], dtype=np.uint8)
            difference = np.abs(exported.act(seen) - original.act(seen))
            assert (difference < TOLERANCE * np.array([10.0, 1.0])).all()
            assert exported.choices == original.choices
            assert exported.terminations == pytest.approx(original.terminations, abs=1e-6)
            active.add(original.choices)
    assert len(active) > 1 or not original.choices


@pytest.fixture(scope="module")
def exported(toy_run, tmp_path_factory):
    """The folder that the command wrote, and how it ended."""
    folder = tmp_path_factory.mktemp("exported") / "controller"
    return folder, call("export", toy_run.folder, "--out", folder, "--onnx")


def test_the_command_says_how_well_each_form_does(exported):
    folder, ended = exported
    assert ended.status == 0, ended.err
    numpy, onnx, last = ended.out.splitlines()
    for line, form in ((numpy, "numpy"), (onnx, "onnx")):
        assert line.startswith(f"{form}: largest difference of a control ")
    assert last == f"{folder}: try it with: python {folder / 'runner.py'} {folder}"
    names = {"controller.json", "controller.onnx", "controller.pt2", "weights.npz", "check.npz", "runner.py"}
    assert {path.name for path in folder.iterdir()} == names


ALONE = """
import sys
import runner
form, sys.argv = sys.argv[1], ["runner.py", ".", sys.argv[1]]
try:
    runner.main()
except SystemExit as ended:
    assert ended.code == 0
assert not {"torch", "pyro", "ddco_pyro"} & set(sys.modules)
"""


@pytest.mark.parametrize("form", ["numpy", "onnx"])
def test_both_forms_run_without_this_library(exported, form):
    folder, _ = exported
    code = ALONE + ("assert 'onnxruntime' not in sys.modules\n" if form == "numpy" else "")
    ended = subprocess.run([sys.executable, "-c", code, form], cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("largest difference of a control: ")


def test_the_torch_program_gives_the_networks_outputs(exported, toy_run):
    folder, _ = exported
    program = torch.export.load(folder / "controller.pt2").module()
    own = StepProgram(ddco_pyro.load(toy_run.folder).hierarchy)
    features = torch.randn(len(own.mean), dtype=torch.float64)
    with torch.no_grad():
        for found, expected in zip(program(features, torch.tensor([3])), own(features, torch.tensor([3])), strict=True):
            torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"visited": np.zeros(1)}, r"the observation has no 'offsets' \(it has: visited\)"),
        (
            {"offsets": np.zeros(3), "visited": np.zeros(1)},
            r"'offsets' has shape \(3,\), the demonst",
        ),
        ({"offsets": np.full(4, np.nan), "visited": np.zeros(1)}, "'offsets' is not finite"),
        ({"offsets": np.array(list("abcd")), "visited": np.zeros(1)}, "'offsets' is <U1, it has to be numbers"),
    ],
)
def test_both_refuse_the_same_observations(exported, toy_run, observation, message):
    folder, _ = exported
    for controller in (runner.Runner(folder), ddco_pyro.load(toy_run.folder).controller()):
        with pytest.raises(ValueError, match=message):
            controller.act(observation)


def test_a_picture_has_to_be_bytes():
    fit = make("conv", camera=True)
    seen = {key: np.zeros(shape) for key, shape in SHAPES.items()}
    with pytest.raises(ValueError, match="observation 'camera' is float64, it has to be uint8"):
        fit.controller().act(seen)


def test_a_form_that_acts_otherwise_is_not_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("ddco_pyro.export._write_programs", lambda *arguments: None)
    monkeypatch.setattr("ddco_pyro.export.TOLERANCE", 0.0)
    with pytest.raises(RuntimeError, match=r"as numpy a control differs by .*: this is a defect; report it"):
        export(make(), tmp_path)
    assert not (tmp_path / "controller.json").exists()


def test_what_numpy_cannot_evaluate_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("ddco_pyro.export._write_programs", lambda *arguments: None)
    fit = make("linear")
    fit.hierarchy.meta_policy.network = torch.nn.Sequential(fit.hierarchy.meta_policy.network)
    assert export(fit, tmp_path) == {}
    assert not json.loads((tmp_path / "controller.json").read_text())["numpy"]
    with pytest.raises(ValueError, match="it has networks that numpy cannot evaluate"):
        runner.Runner(tmp_path)
