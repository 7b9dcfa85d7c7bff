"""Made-up episodes, what the original does in them, and how exact it is: what exported forms are compared with."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from ddco_pyro.acting.controller import Controller
from ddco_pyro.export import runner
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import STEP

EPISODES, STEPS = 3, 20
"""Made-up episodes on which every form has to act as the original does; without images the first one is a step longer
than the longest demonstration, so that networks of every step of time are among what is compared."""

FINEST = 48
"""Made-up pictures have about so many squares across the shorter side, or as many as they have pixels."""

ROUNDINGS = 4
"""An exported form may differ from the original by so many times what the original, in float32, differs from the same
networks in float64, in a whole episode at once or one step at a time (which adds in another order): either errs by
about that, in other places, and these are the largest of a few thousand numbers."""

MOST = 1e-4
"""No form may differ by more: networks whose own rounding is beyond a quarter of this say nothing in float32."""


def record(controller: Controller, hierarchy: Hierarchy) -> dict[str, np.ndarray]:
    """Made-up episodes: observations about as large as those that were fitted to, what was done, by whom, and what the
    networks say of the whole episode at once.

    ``seeds``, and for each episode ``observation_<episode>_<key>`` [T, ...], ``controls_<episode>`` [T, A],
    ``choices_<episode>`` [T, D], and the runner's outputs as ``<output>_<episode>`` [T, ...].
    """
    random = np.random.default_rng(0)
    arrays: dict[str, np.ndarray] = {"seeds": np.arange(EPISODES)}
    for episode in range(EPISODES):
        steps = STEPS if episode or hierarchy.encoder.images else max(STEPS, hierarchy.steps + 1)
        seen = _episode(hierarchy.encoder, steps, random)
        controller.reset(episode)
        acted = [
            (controller.act({key: obs[step] for key, obs in seen.items()}), controller.choices) for step in range(steps)
        ]
        arrays |= {f"observation_{episode}_{key}": obs for key, obs in seen.items()}
        arrays[f"controls_{episode}"] = np.stack([control for control, _ in acted])
        arrays[f"choices_{episode}"] = np.array([choices for _, choices in acted], dtype=int).reshape(steps, -1)
        said = _said(hierarchy, hierarchy.encoder.inputs([seen]))
        arrays |= {f"{name}_{episode}": values for name, values in said.items()}
    return arrays


def tolerance(hierarchy: Hierarchy, episodes: Mapping[str, np.ndarray]) -> float:
    """By how much a form may differ from the original in these recorded episodes, in the units of
    :func:`~ddco_pyro.export.runner.difference`: :data:`ROUNDINGS` times what float32 does to the original's networks,
    :data:`MOST` at most, and never less than :data:`~ddco_pyro.export.runner.TOLERANCE`, which networks have that
    cannot be evaluated in float64 (a user's).
    """
    exact, largest = copy.deepcopy(hierarchy).double(), 0.0
    for number in episodes["seeds"]:
        inputs = hierarchy.encoder.inputs([runner.seen(episodes, number)])
        vectors = {key: vector.double() for key, vector in inputs.vectors.items()}
        try:
            said = _said(exact, replace(inputs, vectors=vectors))
        except RuntimeError:  # torch does not mix types
            return runner.TOLERANCE
        recorded = {name: episodes[f"{name}_{number}"] for name in said}
        for rounded in (recorded, _said_stepwise(hierarchy, inputs)):
            largest = max(largest, *(runner.difference({}, name, rounded[name], said[name]) for name in said))
    return float(np.clip(ROUNDINGS * largest, runner.TOLERANCE, MOST))


def _said(hierarchy: Hierarchy, inputs: Inputs) -> runner.Outputs:
    """The runner's outputs at every step, [T, ...], from one pass over the episode, as in training."""
    with torch.no_grad():
        return _named(hierarchy(inputs))


def _said_stepwise(hierarchy: Hierarchy, inputs: Inputs) -> runner.Outputs:
    """The same from one step after the other, as a controller has them."""
    each: list[runner.Outputs] = []
    states: States | None = None
    with torch.no_grad():
        for step in inputs.chunks(1):
            said, states = hierarchy.advance(step, states)
            each.append(_named(said))
    return {name: np.concatenate([one[name] for one in each]) for name in each[0]}


def _named(said: Outputs) -> runner.Outputs:
    """The outputs for one episode by the runner's names, [T, ...]."""
    out: runner.Outputs = {}
    for level, caller in enumerate(said.callers):
        if caller.selection is not None:
            out[f"selection_{level}"] = caller.selection[0].numpy()
        if caller.numbers is not None:
            out[f"control_{level}"] = caller.numbers[0].numpy()
    return out | {f"termination_{level}": log[0, :, :, 1].exp().numpy() for level, log in enumerate(said.termination)}


def _episode(encoder: ObservationEncoder, steps: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Observations with the mean and spread that were fitted to, and with differences as large where those matter."""
    observations: dict[str, np.ndarray] = {}
    at = 0
    for spec, size in zip(encoder.specs, encoder.sizes, strict=True):
        if spec.key == STEP:
            at += size
            continue
        shape = encoder.shapes[spec.key]
        mean, std = (statistic[at : at + size].numpy() for statistic in (encoder.mean, encoder.std))
        length = int(np.prod(shape))
        values = mean[:length] + std[:length] * random.normal(size=(steps, length))
        if spec.differences:
            own = slice(length, 2 * length)
            differences = mean[own] + std[own] * random.normal(size=values.shape)
            values = _walk(values[0], differences, mean[:length], std[:length])
        observations[spec.key] = values.reshape(steps, *shape)
        at += size
    return observations | {key: _pictures(steps, encoder.shapes[key], random) for key in encoder.images}


def _pictures(steps: int, shape: tuple[int, ...], random: np.random.Generator) -> np.ndarray:
    """Noise [T, H, W, C], of squares where pictures are large: every pixel of its own would be most of an export."""
    side = max(1, min(shape[:2]) // FINEST)
    fewer = tuple(-(-size // side) for size in shape[:2])
    noise = random.integers(0, 256, (steps, *fewer, *shape[2:]), dtype=np.uint8)
    return noise.repeat(side, 1).repeat(side, 2)[:, : shape[0], : shape[1]]


def _walk(start: np.ndarray, differences: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Values [T, F] that go by these differences [T, F], or back where they would leave the mean by two deviations."""
    values = [start]
    for difference in differences[1:]:
        ahead, back = values[-1] + difference, values[-1] - np.copysign(difference, values[-1] - mean)
        values.append(np.where(np.abs(ahead - mean) > 2 * std, back, ahead))
    return np.stack(values)
