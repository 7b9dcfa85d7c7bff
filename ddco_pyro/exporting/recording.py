"""Synthetic episodes to check exports: the original's actions in them, and the comparison's tolerance."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from ddco_pyro.acting.controller import Controller
from ddco_pyro.exporting import runner
from ddco_pyro.exporting.description import named
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import STEP

EPISODES, STEPS = 3, 20
"""Number and length of synthetic episodes. Without images the first one is a step longer than the longest
demonstration, so that the comparison includes the networks of every time step."""

FINEST = 48
"""Largest number of squares across the shorter side of a synthetic picture."""

ROUNDINGS = 4
"""Allowed difference in units of the original's own rounding error. The rounding error is the largest
difference between float32 and float64 outputs, over an episode in one pass and step by step, which add in
different orders."""

MOST = 1e-4
"""Largest tolerance. Networks with a rounding error beyond a quarter of it are meaningless in float32."""


def record(controller: Controller, hierarchy: Hierarchy) -> dict[str, np.ndarray]:
    """Synthetic episodes: observations as large as the training data's, actions, options, network outputs.

    ``seeds``, and for each episode ``observation_<episode>_<key>`` [T, ...], ``controls_<episode>`` [T, A],
    ``choices_<episode>`` [T, D], and the runner's outputs as ``<output>_<episode>`` [T, ...].
    """
    random = np.random.default_rng(0)
    arrays: dict[str, np.ndarray] = {"seeds": np.arange(EPISODES)}
    for episode in range(EPISODES):
        steps = STEPS if episode or hierarchy.encoder.images else max(STEPS, hierarchy.steps + 1)
        seen = _episode(hierarchy.encoder, steps, random)
        controller.reset(episode)
        at_steps = ({key: obs[step] for key, obs in seen.items()} for step in range(steps))
        acted = [(controller.act(observation), controller.choices) for observation in at_steps]
        arrays |= {f"observation_{episode}_{key}": obs for key, obs in seen.items()}
        arrays[f"controls_{episode}"] = np.stack([control for control, _ in acted])
        choices = np.array([own for _, own in acted], dtype=int)
        arrays[f"choices_{episode}"] = choices.reshape(steps, -1)
        outputs = _at_once(hierarchy, hierarchy.encoder.inputs([seen]))
        arrays |= {f"{name}_{episode}": values for name, values in outputs.items()}
    return arrays


def tolerance(hierarchy: Hierarchy, episodes: Mapping[str, np.ndarray]) -> float:
    """Allowed difference of a form from the original, in the units of
    :func:`~ddco_pyro.exporting.runner.difference`.

    The tolerance is :data:`ROUNDINGS` times the original's rounding error in these recorded episodes, clipped
    to :data:`~ddco_pyro.exporting.runner.TOLERANCE` and :data:`MOST`. The lower end applies to a user's
    networks that cannot be evaluated in float64.
    """
    exact, largest = copy.deepcopy(hierarchy).double(), 0.0
    for number in episodes["seeds"]:
        inputs = hierarchy.encoder.inputs([runner.seen(episodes, number)])
        vectors = {key: vector.double() for key, vector in inputs.vectors.items()}
        try:
            outputs = _at_once(exact, replace(inputs, vectors=vectors))
        except RuntimeError:  # torch does not mix types
            return runner.TOLERANCE
        recorded = {name: episodes[f"{name}_{number}"] for name in outputs}
        for rounded in (recorded, _stepwise(hierarchy, inputs)):
            each = (runner.difference({}, name, rounded[name], outputs[name]) for name in outputs)
            largest = max(largest, *each)
    return float(np.clip(ROUNDINGS * largest, runner.TOLERANCE, MOST))


@torch.no_grad()
def _at_once(hierarchy: Hierarchy, inputs: Inputs) -> runner.Outputs:
    """The outputs at every step, [T, ...], from one pass over the episode, as in training."""
    return _arrays(hierarchy(inputs))


@torch.no_grad()
def _stepwise(hierarchy: Hierarchy, inputs: Inputs) -> runner.Outputs:
    """The outputs at every step, [T, ...], from one call for each step, as in a controller."""
    steps: list[runner.Outputs] = []
    states: States | None = None
    for step in inputs.chunks(1):
        outputs, states = hierarchy.advance(step, states)
        steps.append(_arrays(outputs))
    return {name: np.concatenate([step[name] for step in steps]) for name in steps[0]}


def _arrays(outputs: Outputs) -> runner.Outputs:
    """The outputs for one episode by the runner's names, [T, ...]."""
    return {name: values[0].numpy() for name, values in named(outputs).items()}


def _episode(encoder: ObservationEncoder, steps: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Random observations with the mean and spread of training data, and of its differences if used.

    Angles are of a turn, and quaternions have norm 1.
    """
    observations: dict[str, np.ndarray] = {}
    each = (statistic.split(encoder.sizes) for statistic in (encoder.mean, encoder.std))
    means, stds = ((part.numpy() for part in parts) for parts in each)
    for spec, mean, std in zip(encoder.specs, means, stds, strict=True):
        if spec.key == STEP:
            continue
        shape = encoder.shapes[spec.key]
        values = random.uniform(-np.pi, np.pi, (steps, int(np.prod(shape))))
        quaternions = [[first + place for place in range(4)] for first in spec.quaternions]
        rest = np.delete(np.arange(values.shape[1]), [*spec.angles, *np.ravel(quaternions).astype(int)])
        values[:, rest] = mean[: len(rest)] + std[: len(rest)] * random.normal(size=(steps, len(rest)))
        for four in quaternions:
            values[:, four] /= np.linalg.norm(values[:, four], axis=1, keepdims=True)
        if spec.differences and len(rest) == values.shape[1]:
            behind = slice(len(rest), 2 * len(rest))
            differences = mean[behind] + std[behind] * random.normal(size=values.shape)
            values = _walk(values[0], differences, mean[: len(rest)], std[: len(rest)])
        if spec.minus:
            other = observations.setdefault(spec.minus, random.normal(size=(steps, *shape)))
            values = values + other.reshape(steps, -1)
        observations[spec.key] = values.reshape(steps, *shape)
    return observations | {key: _pictures(steps, encoder.shapes[key], random) for key in encoder.images}


def _pictures(steps: int, shape: tuple[int, ...], random: np.random.Generator) -> np.ndarray:
    """Noise [T, H, W, C]. Large pictures consist of squares, so that they compress to a small file."""
    side = max(1, min(shape[:2]) // FINEST)
    fewer = tuple(-(-size // side) for size in shape[:2])
    noise = random.integers(0, 256, (steps, *fewer, *shape[2:]), dtype=np.uint8)
    return noise.repeat(side, 1).repeat(side, 2)[:, : shape[0], : shape[1]]


def _walk(start: np.ndarray, differences: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Values [T, F] that change by differences [T, F], reflected at two standard deviations from the mean."""
    values = [start]
    for difference in differences[1:]:
        ahead, back = values[-1] + difference, values[-1] - np.copysign(difference, values[-1] - mean)
        values.append(np.where(np.abs(ahead - mean) > 2 * std, back, ahead))
    return np.stack(values)
