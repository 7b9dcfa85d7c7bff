"""Inference over demonstrations with a trained model, a piece of bounded size at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.memory import INFERENCE
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.inference.paths import Path, most_likely_path
from ddco_pyro.inference.posteriors import Decomposition, Posterior, decompose, posterior
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables

GROUP_BYTES = 5e8
"""The most bytes that the demonstrations of a piece, with the results of inference, may take."""

COPIES = 4
"""Bytes for each byte of an observation, with the encoded batch."""


@dataclass(frozen=True, eq=False)
class Inferred:
    """The inference for N demonstrations, padded to the longest, T steps; each result is computed when first read.

    :param names: of the demonstrations.
    :param batch: the demonstrations, encoded for the networks.
    """

    names: tuple[str, ...]
    batch: Batch
    hierarchy: Hierarchy

    @property
    def lengths(self) -> tuple[int, ...]:
        """Steps of each demonstration."""
        return tuple(self.batch.lengths.tolist())

    @cached_property
    def outputs(self) -> Outputs:
        """The outputs of the networks at every step."""
        with torch.no_grad():
            return self.hierarchy(self.batch.inputs)

    @cached_property
    def tables(self) -> Tables:
        """The log-probabilities that exact inference works on."""
        with torch.no_grad():
            return self.outputs.tables(self.batch.actions)

    @cached_property
    def log_likelihood(self) -> np.ndarray:
        """log p(ξ) of each demonstration, nats in the control's own units, [N]."""
        values: np.ndarray = log_likelihood(self.tables, self.batch.lengths).numpy()
        return values

    @cached_property
    def posterior(self) -> Posterior:
        """u, v and w of §4.1, [N, T, 1 + k] for each level."""
        return posterior(self.tables, self.batch.lengths)

    @cached_property
    def path(self) -> Path:
        """Choices and terminations of the most likely path, [N, T] for each level; -1 past a demonstration's end."""
        return most_likely_path(self.tables, self.batch.lengths)

    @cached_property
    def decomposition(self) -> Decomposition:
        """The contributions of each control dimension, and of the choice of options, to log p(ξ)."""
        return decompose(self.outputs, self.batch)


def infer(hierarchy: Hierarchy, demonstrations: Iterable[Demonstration]) -> Iterator[Inferred]:
    """Inference for demonstrations in order, as many together as the networks take at once.

    :param demonstrations: in memory, or an iterable that reads one after the other.
    :raises DemonstrationsError: there are none, their shapes differ, or a number is too large for networks.
    """
    for group in _groups(demonstrations, hierarchy.steps_at_once):
        demos = Demonstrations(tuple(group))
        yield Inferred(demos.names, encode(demos, hierarchy.encoder, hierarchy.scaling, fitted=True), hierarchy)


def _groups(demonstrations: Iterable[Demonstration], steps: int) -> Iterator[list[Demonstration]]:
    """Consecutive demonstrations with at most so many steps, padding included, and at least one demonstration."""
    group: list[Demonstration] = []
    for demo in demonstrations:
        observed = sum(array[0].nbytes for array in demo.observations.values() if isinstance(array, np.ndarray))
        at_most = min(steps, GROUP_BYTES / (COPIES * observed + INFERENCE))
        if group and (len(group) + 1) * max(len(demo), *map(len, group)) > at_most:
            yield group
            group = []
        group.append(demo)
    yield group
