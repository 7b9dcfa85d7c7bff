"""Numbers that overflow: refused in a line that names demonstration, key and step, never a likelihood."""

import json
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import torch
from command_line import call, done
from planted import LINEAR, small_spec
from random_demonstrations import of_states

from ddco_pyro.errors import Failed
from ddco_pyro.fitting.evaluation import evaluate
from ddco_pyro.fitting.fit import fit
from ddco_pyro.model.networks import Inputs, InputShape
from ddco_pyro.spec import dump_spec
from ddco_pyro.training.objective import TrainingError


def spec_with(folder: Path, place: str, value: float) -> Path:
    """The spec for demonstrations with one number replaced: ``data/demo_N/KEY`` at step 5, dimension 2."""
    random, path = np.random.default_rng(0), folder / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for number in range(8):
            file[f"data/demo_{number}/obs/pose"] = random.normal(size=(12, 3))
            file[f"data/demo_{number}/actions"] = random.normal(size=(12, 2))
        file["mask/valid"] = [b"demo_6", b"demo_7"]
        file[place][5, 1] = value
    spec = small_spec(
        demonstrations={"path": str(path)},
        observations=[{"key": "pose", "differences": True}],
        control={"std": {"learn": True}},
        training={"starts": ["vq_controls"], "epochs": 1},
        compare_with=[{"kind": "flat", "policy": LINEAR}],
    )
    (folder / "spec.yaml").write_text(dump_spec(spec))
    return folder / "spec.yaml"


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [("demo_1", "actions", 1e300), ("demo_6", "obs/pose", 2e30)],
)
def test_numbers_that_nothing_can_hold(tmp_path: Path, name: str, key: str, value: float) -> None:
    """Trained with or held out; their variance is infinite, or float32 cannot hold them."""
    spec = spec_with(tmp_path, f"data/{name}/{key}", value)
    check = [["check", spec]] if key == "actions" else []  # which reads no observations
    for command in (*check, ["fit", spec, "--out", tmp_path / "run"]):
        ended = call(*command)
        assert (ended.status, ended.out) == (2, "")
        assert ended.err == (
            f"ddco-pyro: {tmp_path / 'demos.hdf5'}: {name}: {key} is {value:g} at step 5, index [1], and at "
            f"most 1e+30 can be used; repair it, or leave {name} out (demonstrations.exclude)\n"
        )
    assert not (tmp_path / "run").exists()
    assert "beyond ±1e+30, the first in" in call("inspect", tmp_path / "demos.hdf5").out


@pytest.mark.parametrize(("key", "value"), [("actions", -1e15), ("obs/pose", 1e25)])
def test_numbers_whose_squares_networks_cannot_hold(tmp_path: Path, key: str, value: float) -> None:
    """What is standardised with them is small in training: there it is held out that they are too large."""
    ended = call("fit", spec_with(tmp_path, f"data/demo_6/{key}", value), "--out", tmp_path / "run")
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert ended.err.startswith(f"ddco-pyro: demo_6: {key} at step 5 is 1")
    assert "once it is scaled, and networks take at most 1e+12; repair it, or leave demo_6 out (" in ended.err
    assert not list(tmp_path.glob("run/*.safetensors"))
    assert "training" not in ended.err  # it was said before


@pytest.mark.parametrize("key", ["actions", "obs/pose"])
def test_what_can_be_held_has_a_likelihood(tmp_path: Path, key: str) -> None:
    """Held out, just within the limit; every number of the result is one."""
    ended = done("fit", spec_with(tmp_path, f"data/demo_6/{key}", 9e11), "--out", tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text(), parse_constant=lambda name: 1 / 0)
    assert all(np.isfinite(metrics["log_likelihood_per_step"][part]) for part in ("train", "valid"))
    assert "nan" not in ended.out


class Undefined(torch.nn.Module):
    """A network that gives NaN."""

    def __init__(self, shape: InputShape, outputs: int, copies: int) -> None:
        super().__init__()
        self.size = (copies, outputs)
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(self, inputs: Inputs) -> torch.Tensor:
        return torch.full((*inputs.batch, *self.size), torch.nan) * self.weight


def test_networks_that_give_no_numbers_are_named_before_training() -> None:
    spec = small_spec(policy={"network": f"{__name__}:Undefined"})
    says = "before any training a network gives values that are NaN or infinite; loo"
    with pytest.raises(TrainingError, match=says):
        fit(spec, of_states([5] * 5))


def test_a_likelihood_that_is_none_is_not_reported(tmp_path: Path) -> None:
    demos = of_states([5] * 5)
    found = fit(small_spec(training={"epochs": 1}), demos, out=tmp_path / "run")
    with torch.no_grad():
        next(found.hierarchy.levels[0].policy.parameters())[:] = torch.inf
    says = r"run: the log-likelihood of demo_0 under the fitted model is (nan|-inf); "
    with pytest.raises(Failed, match=says):
        evaluate(found, Mock(), Mock(), {"train": demos}, contained=(), whole=False)
