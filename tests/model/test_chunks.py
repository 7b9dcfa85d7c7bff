"""Trajectories in chunks of time: the same values and gradients as in one piece, in the memory of a chunk."""

import re
from typing import Any

import pytest
import torch
from planted import small_spec
from torch import Tensor

from ddco_pyro.inference import log_likelihood
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.model.networks import CLASSES, Inputs

SHAPES = {"state": (3,), "camera": (10, 9, 3)}
CONV = {"network": "conv", "layers": [{"filters": 3, "kernel": 3, "stride": 2, "padding": 1}], "hidden": [6]}
BRANCHES = {
    "network": "branches",
    "of": {"camera": {**CONV, "dropout": 0.2}, "state": {"network": "mlp", "hidden": [4]}},
}
IN_WINDOWS = {"network": "lstm", "over": CONV, "hidden": [5, 3], "horizon": 5}
OVER_BRANCHES = {"network": "lstm", "over": {**BRANCHES, "hidden": [5]}, "hidden": [4, 5]}
NETWORKS: dict[str, dict[str, Any]] = {
    "mlp": {"policy": {"network": "mlp", "hidden": [8], "dropout": 0.3, "inputs": ["state"]}},
    "conv": {"policy": {**CONV, "dropout": 0.3}},
    "lstm over conv": {"policy": {"network": "lstm", "over": CONV, "hidden": 5}},
    "lstm over conv, a horizon": {"policy": IN_WINDOWS},
    "lstm over branches, a trunk": {"whole": OVER_BRANCHES},
    "branches": {"policy": {**BRANCHES, "hidden": [7]}},
    "constant": {"policy": {"network": "constant"}, "whole": CONV},
    "per_timestep": {"policy": {"network": "per_timestep", "hidden": [4], "inputs": ["state"]}},
}
TRAJECTORIES, STEPS = 2, 13
NAMES = {"linear", *re.findall(r"'network': '(\w+)'", str(NETWORKS))}
assert set(CLASSES) == NAMES, "a new network belongs here"


def hierarchy(network: str, dtype: torch.dtype = torch.float64) -> Hierarchy:
    """Two levels of options."""
    own = dict(NETWORKS[network])
    whole = own.pop("whole", None)
    reads: dict[str, Any] = {"network": "mlp", "inputs": [] if whole else ["state"]}
    lower = {"name": "lower", "count": 3, "policy": {"network": "linear"}, "termination": reads, **own}
    upper = {"name": "upper", "count": 2, "policy": reads, "termination": reads}
    meta = reads if whole else {"network": "lstm", "over": reads, "hidden": 3}
    model = {"trunk": whole, "levels": [lower, upper], "meta_policy": meta}
    spec = small_spec(observations=list(SHAPES), control={"std": {"learn": True}}, hierarchy=model)
    torch.manual_seed(0)
    return Hierarchy(spec, Dimensions(SHAPES, 2, STEPS)).to(dtype).train()


def batch(dtype: torch.dtype = torch.float64) -> Batch:
    generator = torch.Generator().manual_seed(1)
    state = torch.randn(TRAJECTORIES, STEPS, 3, generator=generator).to(dtype)
    camera = torch.randint(256, (TRAJECTORIES, STEPS, 10, 9, 3), generator=generator, dtype=torch.uint8)
    actions = torch.randn(TRAJECTORIES, STEPS, 2, generator=generator).to(dtype)
    inputs = Inputs({"state": state}, {"camera": camera}, torch.arange(STEPS))
    return Batch(inputs, actions, torch.tensor([STEPS, STEPS - 4]))


def value_and_gradient(model: Hierarchy, seen: Batch, discovering: int | None) -> tuple[Tensor, Tensor]:
    """The log-likelihood, and its gradient in all parameters that it depends on."""
    torch.manual_seed(3)
    value = log_likelihood(model(seen.inputs, discovering).tables(seen.actions), seen.lengths).sum()
    used = list(model.parameters())
    gradients = torch.autograd.grad(value, used, allow_unused=True, materialize_grads=True)
    return value.detach(), torch.cat([gradient.flatten() for gradient in gradients])


def in_chunks(monkeypatch: pytest.MonkeyPatch, model: Hierarchy, steps: int) -> None:
    """So many steps of time in a chunk."""
    monkeypatch.setattr("ddco_pyro.model.hierarchy.BYTES_AT_ONCE", TRAJECTORIES * steps * model.step_bytes)


@pytest.mark.parametrize(
    ("network", "dtype"),
    [*((name, torch.float64) for name in NETWORKS), ("lstm over branches, a trunk", torch.float32)],
)
def test_chunks_give_the_same(network: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of 1, 4 and 12 of 13 steps; without dropout, whose numbers are drawn chunk by chunk."""
    tolerance = 1e-10 if dtype == torch.float64 else 1e-5
    model, seen = hierarchy(network, dtype).eval(), batch(dtype)
    for discovering in (None, 1):
        value, gradient = value_and_gradient(model, seen, discovering)
        for steps in (1, 4, 12):
            in_chunks(monkeypatch, model, steps)
            assert len(list(seen.inputs.chunks(model.steps_in_memory // TRAJECTORIES))) == -(-STEPS // steps)
            chunked = value_and_gradient(model, seen, discovering)
            assert abs(chunked[0] - value) <= tolerance * abs(value)
            assert (chunked[1] - gradient).abs().max() <= tolerance * gradient.abs().max()
        monkeypatch.undo()


@pytest.mark.parametrize("network", ["mlp", "lstm over branches, a trunk"])
def test_a_chunk_drops_the_same_in_both_passes(network: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With dropout: the gradient of chunks that are computed twice is that of the same chunks, all kept."""
    model, seen = hierarchy(network), batch()
    in_chunks(monkeypatch, model, 4)
    again = value_and_gradient(model, seen, None)
    monkeypatch.setattr(
        "ddco_pyro.model.hierarchy.checkpoint", lambda call, *arguments, **_: call(*arguments)
    )
    kept = value_and_gradient(model, seen, None)
    assert again[0] == kept[0]
    assert (again[1] - kept[1]).abs().max() <= 1e-10 * kept[1].abs().max()
    model.eval()
    assert value_and_gradient(model, seen, None)[0] != kept[0]  # dropout matters
