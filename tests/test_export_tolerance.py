"""How much an exported form may differ from the run: a few times what float32 itself does, and no more.

The truth is the same perceptron in float64, written out with numpy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import ddco_pyro.exporting as module
from ddco_pyro.errors import Failed
from ddco_pyro.exporting import export, runner
from ddco_pyro.exporting.recording import record, tolerance
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import UserNetwork
from ddco_pyro.spec import parse_spec

HALF = 32


def steep(gain: float) -> Fit:
    """A policy of pairs of hidden units that differ by 1 / gain, of which it takes gain times the difference: what
    float32 rounds in a unit it has gain times.
    """
    fit = perceptron(2 * HALF)
    first, *_, last = fit.hierarchy.meta_policy.network.layers
    with torch.no_grad():
        first.weight[..., HALF:] = first.weight[..., :HALF]
        first.bias[..., HALF:] = first.bias[..., :HALF] + 1 / gain
        last.weight[:, HALF:] = -last.weight[:, :HALF]
        last.weight.mul_(gain)
    return fit


def perceptron(units: int) -> Fit:
    """A policy with so many hidden units, which acts with its mean."""
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["state"],
            "baseline": {"kind": "flat", "policy": {"network": "mlp", "hidden": [units]}},
            "rollout": {"control": "mean"},
        }
    )
    torch.manual_seed(2)
    return Fit(spec, Hierarchy(spec, {"state": (5,)}, 2, 7).eval())


STEEP = 40.0


def measured(folder: Path) -> float:
    """How far the original's controls are from those of float64: what it says of an episode at once (``control_0``),
    and what it did (``controls``), one step after the other.
    """
    with np.load(folder / "weights.npz") as file:
        names = [f"caller_0.{layer}.{part}" for layer in (0, 1) for part in ("weight", "bias")]
        weight, bias, weight_2, bias_2 = (file[name][0].astype(np.float64) for name in names)
    largest = 0.0
    with np.load(folder / "check.npz") as file:
        for episode in file["seeds"]:
            seen = file[f"observation_{episode}_state"].astype(np.float32).astype(np.float64)
            exact = np.maximum(seen @ weight + bias, 0) @ weight_2 + bias_2
            for name in ("control_0", "controls"):
                error = np.abs(file[f"{name}_{episode}"].reshape(exact.shape) - exact) / np.maximum(1, np.abs(exact))
                largest = max(largest, error.max())
    return largest


def allowed(folder: Path) -> float:
    with np.load(folder / "check.npz") as file:
        return float(file["tolerance"])


def test_a_sound_fit_may_differ_by_what_float32_does(tmp_path, capsys, monkeypatch):
    differences = export(steep(STEEP), tmp_path, onnx=True)
    assert max(difference for difference, _ in differences.values()) > 1e-6  # which was refused before
    error = measured(tmp_path)
    assert 1e-6 < error < 2.5e-5
    assert allowed(tmp_path) == pytest.approx(4 * error, rel=1e-6)
    monkeypatch.setattr("sys.argv", ["runner.py", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 0
    assert f" of {allowed(tmp_path):.1e} that are allowed; " in capsys.readouterr().out


@pytest.mark.usefixtures("numpy_alone")
def test_what_a_wide_layer_rounds_one_step_at_a_time_counts(tmp_path):
    """A product with a vector adds up in another order than one with a matrix; exported forms act step by step."""
    export(perceptron(8000), tmp_path)
    assert allowed(tmp_path) == pytest.approx(max(1e-6, 4 * measured(tmp_path)), rel=1e-6)


@pytest.mark.usefixtures("numpy_alone")
def test_where_float32_is_exact_enough_the_tolerance_is_as_it_was(tmp_path):
    export(steep(0.5), tmp_path)
    assert measured(tmp_path) < 2.5e-7
    assert allowed(tmp_path) == 1e-6


def test_networks_for_float32_alone_have_the_least_tolerance():
    """Not by an export: whether two programs of such steep networks are that near each other is the processor's."""
    fit = steep(STEEP)
    episodes = record(fit.controller(), fit.hierarchy)
    assert tolerance(fit.hierarchy, episodes) > 1e-6
    network = fit.hierarchy.meta_policy.network
    fit.hierarchy.meta_policy.network = UserNetwork(Single(network), network.features, 1)
    assert tolerance(fit.hierarchy, episodes) == 1e-6


class Single(torch.nn.Module):
    """A user's network that has float32 written into it."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, inputs):
        return self.network(inputs.map(torch.Tensor.float, inputs.time))[0]


@pytest.mark.usefixtures("numpy_alone")
def test_large_pictures_are_compared_with_few_bytes(tmp_path):
    """60 pictures of 240 kB, in which places are told apart still: each has as many colours as its squares."""
    network = {"network": "conv", "layers": [{"filters": 4, "kernel": 5, "stride": 8}]}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["camera"],
            "baseline": {"kind": "flat", "policy": network},
        }
    )
    module._write(Fit(spec, Hierarchy(spec, {"camera": (250, 331, 3)}, 2, 7).eval()), tmp_path, onnx=False)
    assert (tmp_path / "check.npz").stat().st_size < 1.5e6
    with np.load(tmp_path / "check.npz") as file:
        pictures = file["observation_1_camera"]
    assert pictures.shape == (20, 250, 331, 3)
    assert pictures.dtype == np.uint8
    rows, columns = ((np.diff(pictures[0], axis=axis) != 0).any(axis=(1 - axis, 2)).sum() for axis in (0, 1))
    assert (rows, columns) == (49, 66)
    assert (np.diff(pictures, axis=0) != 0).mean() > 0.99


@pytest.mark.usefixtures("numpy_alone")
def test_no_fit_is_so_unsound_that_anything_goes(tmp_path):
    """A hundred thousand times the difference of units: what it says is rounding to 1 %."""
    with pytest.raises(
        Failed, match=r"^nothing was written: .* of 1\.0e-04 that are allowed; the weights are so large"
    ):
        export(steep(1e5), tmp_path / "out")


@pytest.mark.parametrize("array", [f"caller_0.{layer}.{part}" for layer in (0, 1) for part in ("weight", "bias")])
@pytest.mark.usefixtures("numpy_alone")
def test_weights_that_are_off_by_a_thousandth_are_refused(array, tmp_path, monkeypatch):
    """Each array alone, of numpy's form; replaying it later shows it too."""
    refused(tmp_path, monkeypatch, lambda folder: scale(folder / "weights.npz", array), "numpy")
    export(steep(STEEP), tmp_path / "later")
    scale(tmp_path / "later" / "weights.npz", array)
    monkeypatch.setattr("sys.argv", ["runner.py", str(tmp_path / "later")])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 1


@pytest.mark.parametrize("form", ["torch", "onnx"])
def test_programs_that_are_off_by_a_thousandth_are_refused(form, tmp_path, monkeypatch):
    refused(tmp_path, monkeypatch, {"torch": scale_torch, "onnx": scale_onnx}[form], form)


def scale(path: Path, array: str) -> None:
    with np.load(path) as file:
        weights = {name: file[name] for name in file.files}
    weights[array] = weights[array] * np.float32(1.001)
    np.savez(path, **weights)


def scale_torch(folder: Path) -> None:
    program = torch.export.load(folder / "controller.pt2")
    program.state_dict["hierarchy.meta_policy.network.layers.3.weight"].data *= 1.001
    torch.export.save(program, folder / "controller.pt2")


def scale_onnx(folder: Path) -> None:
    model = onnx.load(folder / "controller.onnx")
    (weight,) = (each for each in model.graph.initializer if np.prod(each.dims) == 2 * HALF * 2)  # of the last layer
    values = onnx.numpy_helper.to_array(weight) * np.float32(1.001)
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    onnx.save(model, folder / "controller.onnx")


def refused(tmp_path, monkeypatch, damage, form):
    """The export, where what was written is damaged on the disk before it is compared."""
    write = module._write

    def damaging(fit, folder, onnx):
        forms = write(fit, folder, onnx)
        damage(folder)
        return forms

    with monkeypatch.context() as patched:
        patched.setattr(module, "_write", damaging)
        with pytest.raises(Failed, match=rf"^nothing was written: as {form} it differs from the run by "):
            export(steep(STEEP), tmp_path / "out", onnx=form == "onnx")
    assert not (tmp_path / "out").exists()
