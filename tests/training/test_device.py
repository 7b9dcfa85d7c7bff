"""Networks on a device, all else on the host; the same fit wherever that is, or a line where it is not.

Without a GPU a double stands for one: it computes here, and refuses what a GPU would refuse.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from command_line import done, refused
from killing import Interrupting
from planted import small_spec
from random_demonstrations import numbered
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.spec import Spec
from ddco_pyro.training import processes
from ddco_pyro.training.networks import Dimensions, build_hierarchy
from ddco_pyro.training.restarts import OtherDevice

# the double is called meta
pytestmark = pytest.mark.filterwarnings("ignore:.*to a meta parameter:UserWarning")

# --- a double: tensors that say they are on ``THERE``, have their numbers here, and mix with no others ------

THERE = torch.device("meta")
"""What the double calls itself: a device that torch knows, and that needs no driver."""

MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class Elsewhere(Tensor):
    """A tensor on the double; ``here`` has its numbers."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        facts = {"strides": here.stride(), "storage_offset": here.storage_offset(), "dtype": here.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, here.size(), device=THERE, **facts)

    def __init__(self, here: Tensor) -> None:
        self.here = here

    def __repr__(self) -> str:  # torch's own would ask for numbers
        return f"Elsewhere({self.here!r})"

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class Device(TorchDispatchMode):
    """While it is active tensors can be moved to ``THERE`` and made there."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, Elsewhere)]
    left = [tensor for tensor in tensors if not isinstance(tensor, Elsewhere) and tensor.dim()]
    if operation not in MOVES and there and left:
        raise AssertionError(f"{operation} mixes devices: one tensor {list(left[0].shape)} is on the host")
    named = kwargs.get("device")
    goes = bool(there) if named is None else torch.device(named) == THERE
    if named is not None:
        kwargs = kwargs | {"device": "cpu"}
    own = {id(tensor.here): tensor for tensor in there}
    args, kwargs = tree_map(lambda leaf: leaf.here if isinstance(leaf, Elsewhere) else leaf, (args, kwargs))

    def back(result: Any) -> Any:
        if not isinstance(result, Tensor) or not goes:
            return result
        return own[id(result)] if id(result) in own else Elsewhere(result)

    return tree_map(back, operation(*args, **kwargs))


# --- the fits -----------------------------------------------------------------------------------------------

USERS = ("networks", "checkpoint", "restarts", "loop")
"""Who asks for the device of a spec."""

SPATIAL = {
    "network": "conv",
    "layers": [{"filters": 3, "kernel": 3, "stride": 2, "padding": 1}],
    "pool": "spatial_softmax",
    "hidden": [5],
}
MEANS = {"network": "conv", "layers": [{"filters": 2, "kernel": 3, "stride": 2, "padding": 1}], "hidden": [4]}
MLP = {"network": "mlp", "hidden": [6], "inputs": ["pose"]}
LINEAR = {"network": "linear", "inputs": ["pose"]}
LSTM = {"network": "lstm", "over": {"network": "mlp", "hidden": [4], "inputs": ["pose"]}, "hidden": 3}
TIMES = {"network": "per_timestep", "hidden": [4], "inputs": ["pose"]}
OF = {"camera": MEANS, "pose": {"network": "mlp", "hidden": [3]}}
BRANCHES = {"network": "branches", "of": OF, "hidden": [4]}
SAME = {"mlp": {"policy": MLP, "termination": LINEAR}}
"""Those of which a double computes every number as the host does."""

DROPPING = {"policy": {**MLP, "dropout": 0.2}, "termination": LINEAR}
"""Dropout draws other numbers on every kind of device."""

OTHER = {
    "spatial softmax": {"policy": SPATIAL, "termination": LINEAR},
    "field means": {"policy": MEANS, "termination": MLP},
    "per_timestep": {"policy": TIMES, "termination": MLP},
    "lstm": {"policy": LSTM, "termination": LINEAR},
    "constant": {"policy": MLP, "termination": {"network": "constant"}},
    "branches": {"policy": BRANCHES, "termination": LINEAR},
}
"""Those that are computed by another algorithm, or in another order, where they are not on the host."""

ALL = [name if name in SAME else pytest.param(name, marks=pytest.mark.slow) for name in (*SAME, *OTHER)]


@pytest.fixture(scope="module")
def demos() -> Demonstrations:
    random = np.random.default_rng(0)

    def one(steps: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
        camera = random.integers(0, 256, (steps, 9, 7, 3), dtype=np.uint8)
        return {"pose": random.normal(size=(steps, 3)), "camera": camera}, random.normal(size=(steps, 2))

    return numbered(one(steps) for steps in range(5, 12))


def spec_of(level: dict[str, Any], **training: Any) -> Spec:
    own = {"epochs": 3, "batch_size": 3, "average": 0.5, "layerwise": False}
    return small_spec(
        demonstrations={"path": "unused.hdf5", "valid_fraction": 0.2},
        observations=["pose", {"key": "camera", "shift": 1}],
        control={"std": {"learn": True}},
        hierarchy={"levels": [{"count": 2, **level}], "meta_policy": LINEAR},
        training=own | training,
    )


def on(monkeypatch: pytest.MonkeyPatch, device: torch.device) -> None:
    # networks are checked without weights on the device that the double is named after
    monkeypatch.setattr("ddco_pyro.training.networks.check_networks", build_hierarchy)
    for module in USERS:
        monkeypatch.setattr(f"ddco_pyro.training.{module}.device_of", lambda training: device)


def weights(fit: ddco_pyro.Fit) -> dict[str, np.ndarray]:
    return {name: value.detach().cpu().numpy() for name, value in fit.hierarchy.state_dict().items()}


# --- networks there, everything else here -------------------------------------------------------------------


@pytest.mark.parametrize("network", ALL)
def test_a_fit_with_networks_elsewhere(demos: Demonstrations, network: str, monkeypatch) -> None:
    """Each tensor that meets another is asked for its device; weights and numbers are a fit's on the host."""
    spec = spec_of(
        (SAME | OTHER)[network],
        optimizer={"name": "momentum", "lr": 0.01},  # Adam's steps hide their sizes
    )
    one = build_hierarchy(spec, Dimensions.of(demos))
    monkeypatch.setattr("ddco_pyro.model.hierarchy.BYTES_AT_ONCE", 6 * one.step_bytes)  # in chunks too
    here = ddco_pyro.fit(spec, demos)
    on(monkeypatch, THERE)
    with Device():
        there = ddco_pyro.fit(spec, demos)
        networks = there.hierarchy.networks().values()
        placed = [parameter for module in networks for parameter in module.parameters()]
        assert placed
        assert all(isinstance(parameter.data, Elsewhere) for parameter in placed)
        others = {id(parameter) for parameter in there.hierarchy.parameters()} - set(map(id, placed))
        assert others  # the spreads of controls
        assert {p.device.type for p in there.hierarchy.parameters() if id(p) in others} == {"cpu"}
        moved = weights(there)
        acted = there.controller().act({key: values[0] for key, values in demos[0].observations.items()})
    close = {"rtol": 0, "atol": 0} if network in SAME else {"rtol": 1e-4, "atol": 1e-5}
    for name, values in weights(here).items():
        np.testing.assert_allclose(moved[name], values, err_msg=name, **close)
    expected = here.controller().act({key: values[0] for key, values in demos[0].observations.items()})
    np.testing.assert_allclose(acted, expected, **close)
    assert there.metrics.training.device == THERE.type
    each = [fit.metrics.log_likelihood_per_step.valid for fit in (there, here)]
    assert each[0] == pytest.approx(each[1], rel=0 if network in SAME else 1e-3)


# --- what is said -------------------------------------------------------------------------------------------


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_no_gpu_is_one_line(demos: Demonstrations, tmp_path) -> None:
    demos.write(tmp_path / "demos.hdf5")
    data = json.loads(spec_of(SAME["mlp"], device="cuda").model_dump_json(by_alias=True))
    data["demonstrations"]["path"] = str(tmp_path / "demos.hdf5")
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(data))
    spec = tmp_path / "spec.yaml"
    for command in (["fit", spec, "--out", tmp_path / "run"], ["check", spec]):
        refused(f": training.device: cuda: torch {torch.__version__} has no GPU here", *command)
    assert not (tmp_path / "run").exists()
    assert "networks: on cpu" in done("check", tmp_path / "spec.yaml", "--set", "training.device=auto").out


def test_of_several_gpus_each_process_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    training = spec_of(SAME["mlp"], device="auto").training
    seen = []
    for rank in range(3):
        monkeypatch.setenv("LOCAL_RANK", str(rank))
        seen.append(processes.device_of(training))
    assert seen == [torch.device("cuda", index) for index in (0, 1, 0)]
    assert processes.device_of(spec_of(SAME["mlp"]).training) == torch.device("cpu")


def test_a_run_goes_on_where_it_was_begun(demos: Demonstrations, tmp_path, monkeypatch) -> None:
    """On the same kind of device bit for bit; on another it is refused before a bit is trained."""
    spec = spec_of(DROPPING, starts=["random"])
    on(monkeypatch, THERE)
    with Device():
        whole = ddco_pyro.fit(spec, demos, tmp_path / "whole")
        with pytest.raises(KeyboardInterrupt):
            ddco_pyro.fit(spec, demos, tmp_path / "killed", on_event=Interrupting(2))
    on(monkeypatch, torch.device("cpu"))
    says = r"restart-0.safetensors: was trained on meta, and networks are on cpu here"
    with pytest.raises(OtherDevice, match=says):
        ddco_pyro.fit(spec, demos, tmp_path / "killed")
    on(monkeypatch, THERE)
    with Device():
        again = ddco_pyro.fit(spec, demos, tmp_path / "killed")
        for name, values in weights(whole).items():
            np.testing.assert_array_equal(weights(again)[name], values)
    for name in ("model.safetensors", "history.csv"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_fit_leaves_generators_as_they_were(demos: Demonstrations, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of GPUs too, which torch's own seeding reaches."""
    seeded: list[int] = []
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeded.append)
    torch.manual_seed(0)
    assert seeded == [0]
    before = torch.get_rng_state()
    ddco_pyro.fit(spec_of(DROPPING, epochs=1, starts=["random"]), demos)
    assert seeded == [0]
    assert torch.equal(torch.get_rng_state(), before)


# --- a GPU --------------------------------------------------------------------------------------------------

gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch has no GPU here")


@gpu
@pytest.mark.parametrize("network", [*SAME, *OTHER, "dropout"])
def test_a_gpu_gives_the_same_bits_again(demos: Demonstrations, network: str) -> None:
    """Dropout too, whose numbers are those of the GPU's generator, which is left as it was."""
    spec = spec_of((SAME | OTHER | {"dropout": DROPPING})[network], device="cuda")
    torch.cuda.manual_seed(7)
    before = torch.cuda.get_rng_state()
    first = weights(ddco_pyro.fit(spec, demos))
    assert torch.equal(torch.cuda.get_rng_state(), before)
    torch.cuda.manual_seed(8)
    for name, values in weights(ddco_pyro.fit(spec, demos)).items():
        np.testing.assert_array_equal(values, first[name], err_msg=name)
