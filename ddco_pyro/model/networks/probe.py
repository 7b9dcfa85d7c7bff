"""Networks on made-up observations: which users' networks are refused, and how much memory training takes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.perceptrons import Network, State

TRAJECTORIES, STEPS = 2, 3

TOLERANCE = 1e-3
"""Largest difference between a step alone and in its trajectory, as a part of the largest output, float32."""


def try_network(name: str, network: Network, shape: InputShape) -> None:
    """Compare a network's outputs for whole trajectories with those for one step after the other.

    Training calls a network in the first way, a controller in the second. Where both agree, no trajectory
    changes another, and no later step, padding included, changes an earlier one.

    :raises ShapeError: the network fails, gives another shape than [N, T, K, features], or the two differ.
    """
    inputs = _random_inputs(shape, TRAJECTORIES, STEPS)
    with _evaluating(network), torch.no_grad():
        _output(name, network, inputs)  # lazy modules have parameters from here on
        with _without_zeros(network):
            whole = _output(name, network, inputs)[0].double()
            rows = []
            for trajectory in range(TRAJECTORIES):
                state: State | None = None
                for step in inputs.part(slice(trajectory, trajectory + 1), slice(None)).chunks(1):
                    row, state = _output(name, network, step, state)
                    rows.append(row.double())
            alone = torch.cat(rows, dim=1).reshape(whole.shape)
    largest = float(torch.where(whole.isfinite(), whole, 0.0).abs().max())
    if not torch.allclose(alone, whole, rtol=0.0, atol=1e-5 + TOLERANCE * largest, equal_nan=True):
        if network.initial_state(1):
            raise ShapeError(
                f"network {name!r} gives other outputs step by step than for a whole trajectory: its state "
                "has to hold all that it knows of earlier steps, each trajectory's apart, and of later ones "
                "it can know nothing"
            )
        raise ShapeError(
            f"network {name!r} gives a step alone other outputs than within its trajectory: it depends on "
            "earlier steps (or later ones, other trajectories, or chance); one that remembers has to have "
            "initial_state(N), and to be called with a state and give the next one"
        )


def _output(name: str, network: Network, inputs: Inputs, state: State | None = None) -> tuple[Tensor, Any]:
    """The outputs and the state after them, both checked; ``state`` is None at the first step."""
    trajectories, steps = inputs.batch
    try:
        before: Any = network.initial_state(trajectories) if state is None else state
        given: Any = network(inputs, before)
    except Exception as error:  # whatever the user's code raises
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ShapeError(
            f"network {name!r} fails for random observations, N = {trajectories}, T = {steps}: {what}"
        ) from error
    after: Any
    output, after = given if isinstance(given, tuple) and len(given) == 2 else (given, None)
    states = _is_state(before, trajectories) and _is_state(after, trajectories)
    if not states or [tensor.shape for tensor in before] != [tensor.shape for tensor in after]:
        raise ShapeError(
            f"network {name!r} has initial_state(N), which has to give a tuple of tensors [N, ...]; each "
            f"call then has to give outputs and such a tuple of the same shapes, here N = {trajectories}"
        )
    found = f"shape {list(output.shape)}" if isinstance(output, Tensor) else f"a {type(output).__name__}"
    needed = [trajectories, steps, network.copies, network.features]
    if found != f"shape {needed}":
        raise ShapeError(
            f"network {name!r} gives {found}; it has to be a tensor [N, T, copies, outputs], here {needed}"
        )
    return output, after


def _is_state(state: Any, trajectories: int) -> bool:
    return isinstance(state, tuple) and all(
        isinstance(tensor, Tensor) and tensor.shape[:1] == (trajectories,) for tensor in state
    )


def _random_inputs(
    shape: InputShape, trajectories: int, steps: int, dtype: torch.dtype = torch.float32
) -> Inputs:
    """Vectors between 0 and 1, images, and numbers of steps that a network has parameters for."""
    generator, batch = torch.Generator().manual_seed(0), (trajectories, steps)
    sizes = shape.vectors.items()
    vectors = {key: torch.rand(*batch, size, generator=generator, dtype=dtype) for key, size in sizes}
    images = {
        key: torch.randint(256, (*batch, *image), generator=generator, dtype=torch.uint8)
        for key, image in shape.images.items()
    }
    return Inputs(vectors, images, torch.arange(steps).clamp(max=shape.steps - 1))


@contextmanager
def _evaluating(network: Network) -> Iterator[None]:
    """In evaluation mode, in which running statistics stay."""
    training = network.training
    network.eval()
    try:
        yield
    finally:
        network.train(training)


@contextmanager
def _without_zeros(network: Network) -> Iterator[None]:
    """Parameters that are 0 are random meanwhile: an output layer that starts at 0 would hide a memory."""
    generator = torch.Generator().manual_seed(1)
    kept = [(parameter, parameter.clone()) for parameter in network.parameters()]
    for parameter, values in kept:
        noise = 0.1 * torch.randn(values.shape, generator=generator).to(values)
        parameter.copy_(torch.where(values == 0, noise, values))
    try:
        yield
    finally:
        for parameter, values in kept:
            parameter.copy_(values)


def training_bytes(networks: Mapping[Network, InputShape]) -> int:
    """Bytes that these networks, each with what it reads, take for a step while they are trained together.

    Each keeps tensors until its gradient is computed. While that happens, what one network computed and its
    gradient are there too: measured with convolutions, at most twice what the largest network keeps.
    """
    kept = []
    for network, shape in networks.items():
        kept.append(_kept(network, shape, *_one_more(network)) - _kept(network, shape, 1, 1))
    return sum(kept) + 2 * max(kept)


def _one_more(network: Network) -> tuple[int, int]:
    """(N, T) one trajectory or step more than (1, 1).

    A step, since a network may have parameters for each; a trajectory where the network remembers, since what
    torch keeps of several steps grows in leaps.
    """
    return (2, 1) if network.initial_state(1) else (1, 2)


def _kept(network: Network, shape: InputShape, trajectories: int, steps: int) -> int:
    """Bytes of all tensors, parameters included, that torch keeps for the gradient."""
    dtype = next((parameter.dtype for parameter in network.parameters()), torch.float32)
    seen = _random_inputs(shape, trajectories, steps, dtype)
    storages: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage._cdata] = storage.nbytes()
        return tensor

    with _evaluating(network), torch.enable_grad():
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            outputs, _ = network(seen, network.initial_state(trajectories))
        del outputs  # kept until here: no two tensors that are kept share an address
    return sum(storages.values())
