"""Tries a user's network when it is built: its output's shape, and that each step is answered from that step alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError

TRAJECTORIES, STEPS = 2, 3

TOLERANCE = 1e-3
"""Part of the largest output by which those of one step, alone and in its trajectory, may differ: they are float32."""


def try_network(name: str, network: nn.Module, shape: InputShape, size: tuple[int, int]) -> None:
    """Run a new network on random observations: on whole trajectories, as in training, and on each step by itself, as a
    controller does.

    :param size: (copies, outputs).
    :raises ShapeError: it fails, gives another shape than [N, T, copies, outputs], or gives a step alone other outputs.
    """

    def output(inputs: Inputs) -> Tensor:
        return _output(name, network, inputs, size)

    inputs = _random_inputs(shape)
    with _evaluated(network), torch.no_grad():
        output(inputs)  # lazy modules have parameters from here on
        with _without_zeros(network):
            whole = output(inputs).double()
            alone = torch.cat([output(step).double() for step in _steps(inputs)], dim=1).reshape(whole.shape)
    largest = float(torch.where(whole.isfinite(), whole, 0.0).abs().max())
    if not torch.allclose(alone, whole, rtol=0.0, atol=1e-5 + TOLERANCE * largest, equal_nan=True):
        raise ShapeError(
            f"network {name!r} gives a step alone other outputs than within its trajectory: it depends on earlier "
            "steps (or later ones, other trajectories, or chance); networks with a memory are not supported yet"
        )


def _output(name: str, network: nn.Module, inputs: Inputs, size: tuple[int, int]) -> Tensor:
    trajectories, steps = inputs.batch
    try:
        output = network(inputs)
    except Exception as error:  # whatever the user's code raises
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ShapeError(
            f"network {name!r} fails for random observations, N = {trajectories}, T = {steps}: {what}"
        ) from error
    given = f"shape {list(output.shape)}" if isinstance(output, Tensor) else f"a {type(output).__name__}"
    needed = [trajectories, steps, *size]
    if given != f"shape {needed}":
        raise ShapeError(
            f"network {name!r} gives {given}; it has to be a tensor [N, T, copies, outputs], here {needed}"
        )
    return output


def _random_inputs(shape: InputShape) -> Inputs:
    """Vectors between 0 and 1, and images."""
    generator = torch.Generator().manual_seed(0)
    batch = (TRAJECTORIES, STEPS)
    vectors = {key: torch.rand(*batch, size, generator=generator) for key, size in shape.vectors.items()}
    images = {
        key: torch.randint(256, (*batch, *image), generator=generator, dtype=torch.uint8)
        for key, image in shape.images.items()
    }
    time = torch.arange(STEPS).clamp(max=shape.steps - 1)  # it may have parameters for each step
    return Inputs(vectors, images, time)


def _steps(inputs: Inputs) -> Iterator[Inputs]:
    """Every step of every trajectory as inputs of their own, N = T = 1."""
    for trajectory in range(TRAJECTORIES):
        for step in range(STEPS):
            here = (slice(trajectory, trajectory + 1), slice(step, step + 1))
            yield inputs.map(lambda array, here=here: array[here], inputs.time[step : step + 1])  # type: ignore[misc]


@contextmanager
def _evaluated(network: nn.Module) -> Iterator[None]:
    """In evaluation mode, in which nothing that the network keeps track of changes."""
    training = network.training
    network.eval()
    try:
        yield
    finally:
        network.train(training)


@contextmanager
def _without_zeros(network: nn.Module) -> Iterator[None]:
    """Parameters that are 0 are random meanwhile: an output layer that starts at 0 would hide a memory before it."""
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
