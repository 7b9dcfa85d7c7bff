"""How much memory networks take for a step, found by looking at what torch keeps for the gradient."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.head import Head
from ddco_pyro.model.networks.inputs import Inputs, InputShape
from ddco_pyro.model.networks.state import answer, remembers


def training_bytes(networks: Iterable[nn.Module], shape: InputShape) -> int:
    """Bytes that these networks take for each step while all of them are trained together.

    Each keeps tensors until its gradient is computed; meanwhile what it computed, and the gradient of that, are there
    too: measured with convolutions, that is at most twice what the largest network keeps.
    """
    kept = [_kept(network, shape, *_another(network)) - _kept(network, shape, 1, 1) for network in networks]
    return sum(kept) + 2 * max(kept)


def _another(network: nn.Module) -> tuple[int, int]:
    """Trajectories and steps that are one more than (1, 1): a step, since a network may have parameters for each; where
    it remembers a trajectory, since what torch keeps of several steps grows in leaps.
    """
    return (2, 1) if remembers(network) else (1, 2)


def _zeros(shape: InputShape, trajectories: int, steps: int, dtype: torch.dtype) -> Inputs:
    """Observations that are 0."""
    batch = (trajectories, steps)
    vectors = {key: torch.zeros(*batch, size, dtype=dtype) for key, size in shape.vectors.items()}
    images = {key: torch.zeros(*batch, *image, dtype=torch.uint8) for key, image in shape.images.items()}
    time = torch.arange(steps).clamp(max=shape.steps - 1)  # a network may have parameters for each step
    return Inputs(vectors, images, time)


def _kept(network: nn.Module, shape: InputShape, trajectories: int, steps: int) -> int:
    """Bytes of all tensors, parameters too, that are kept for the gradient."""
    batch = (trajectories, steps)
    dtype = next((parameter.dtype for parameter in network.parameters()), torch.float32)
    if isinstance(network, Head):
        seen: Inputs | Tensor = torch.zeros(*batch, *network.reads, dtype=dtype)
    else:
        seen = _zeros(shape, *batch, dtype)
    storages: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage._cdata] = storage.nbytes()
        return tensor

    training = network.training
    network.eval()  # nothing it keeps track of is to change
    try:
        with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            outputs, _ = answer(
                network, seen
            )  # while they are there, so is what was kept: no two tensors share a place
        del outputs
    finally:
        network.train(training)
    return sum(storages.values())
