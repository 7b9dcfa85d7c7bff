"""Tries a user's network when it is built: its output's shape, and that steps one by one give what all at once give."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from operator import itemgetter
from typing import Any

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.state import State, initial_state, remembers

TRAJECTORIES, STEPS = 2, 3

TOLERANCE = 1e-3
"""Part of the largest output by which those of one step, alone and in its trajectory, may differ: they are float32."""


def try_network(name: str, network: nn.Module, shape: InputShape, size: tuple[int, int]) -> None:
    """Run a new network on random observations: on whole trajectories, as in training, and on each trajectory step by
    step, as a controller does, with the state carried where it has one. Where both are the same, no trajectory changes
    another, and no later step, padding among them, an earlier one.

    :param size: (copies, outputs).
    :raises ShapeError: it fails, gives another shape than [N, T, copies, outputs], or gives a step alone other outputs.
    """

    def output(inputs: Inputs, state: State | None = None) -> tuple[Tensor, State]:
        return _output(name, network, inputs, state, size)

    inputs = _random_inputs(shape)
    with _evaluated(network), torch.no_grad():
        output(inputs)  # lazy modules have parameters from here on
        with _without_zeros(network):
            whole = output(inputs)[0].double()
            rows = []
            for steps in _trajectories(inputs):
                state: State | None = None
                for step in steps:
                    row, state = output(step, state)
                    rows.append(row.double())
            alone = torch.cat(rows, dim=1).reshape(whole.shape)
    largest = float(torch.where(whole.isfinite(), whole, 0.0).abs().max())
    if not torch.allclose(alone, whole, rtol=0.0, atol=1e-5 + TOLERANCE * largest, equal_nan=True):
        if remembers(network):
            raise ShapeError(
                f"network {name!r} gives other outputs step by step than for a whole trajectory: its state has to hold "
                "all that it knows of earlier steps, each trajectory's apart, and of later ones it can know nothing"
            )
        raise ShapeError(
            f"network {name!r} gives a step alone other outputs than within its trajectory: it depends on earlier "
            "steps (or later ones, other trajectories, or chance); one that remembers has to have initial_state(N), "
            "and to be called with a state and give the next one"
        )


def _output(
    name: str, network: nn.Module, inputs: Inputs, state: State | None, size: tuple[int, int]
) -> tuple[Tensor, Any]:
    trajectories, steps = inputs.batch
    try:
        before: State = initial_state(network, trajectories) if state is None else state
        said: Any = network(inputs, before) if remembers(network) else (network(inputs), ())
    except Exception as error:  # whatever the user's code raises
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ShapeError(
            f"network {name!r} fails for random observations, N = {trajectories}, T = {steps}: {what}"
        ) from error
    output, after = said if isinstance(said, tuple) and len(said) == 2 else (said, None)
    if not _go_on(before, after, trajectories):
        raise ShapeError(
            f"network {name!r} has initial_state(N), which has to give a tuple of tensors [N, ...]; each call then "
            f"has to give outputs and such a tuple of the same shapes, here N = {trajectories}"
        )
    given = f"shape {list(output.shape)}" if isinstance(output, Tensor) else f"a {type(output).__name__}"
    needed = [trajectories, steps, *size]
    if given != f"shape {needed}":
        raise ShapeError(
            f"network {name!r} gives {given}; it has to be a tensor [N, T, copies, outputs], here {needed}"
        )
    return output, after


def _go_on(before: Any, after: Any, trajectories: int) -> bool:
    """Whether both are states of so many trajectories, of the same shapes."""
    if not isinstance(before, tuple) or not isinstance(after, tuple):
        return False
    if not all(isinstance(tensor, Tensor) and tensor.shape[:1] == (trajectories,) for tensor in (*before, *after)):
        return False
    return [tensor.shape for tensor in before] == [tensor.shape for tensor in after]


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


def _trajectories(inputs: Inputs) -> Iterator[list[Inputs]]:
    """Every step of each trajectory as inputs of their own, N = T = 1."""
    for trajectory in range(TRAJECTORIES):
        places = [(slice(trajectory, trajectory + 1), slice(step, step + 1)) for step in range(STEPS)]
        yield [inputs.map(itemgetter(place), inputs.time[place[1]]) for place in places]


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
