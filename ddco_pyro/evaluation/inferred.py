"""The walk over demonstrations: what a fitted model says of them, a bounded piece at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.memory import INFERENCE
from ddco_pyro.inference.decomposition import Decomposition, decompose
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.inference.paths import Path, most_likely_path
from ddco_pyro.inference.posteriors import Posterior, posterior
from ddco_pyro.model.encoding import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables

GROUP_BYTES = 5e8
"""Demonstrations are taken together while they and what is made of them take no more than this."""

COPIES = 4
"""Bytes that a byte of an observation takes, with the batch that is made of it."""


@dataclass(frozen=True, eq=False)
class Inferred:
    """What a model says of N demonstrations, padded to the longest, T steps; each thing is computed once, when asked.

    :param names: of the demonstrations.
    :param batch: the demonstrations as the networks see them.
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
        """What the networks say at every step."""
        with torch.no_grad():
            return self.hierarchy(self.batch.inputs)

    @cached_property
    def tables(self) -> Tables:
        """The tables that exact inference works on."""
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
        """What each control dimension and choosing options add to log p(ξ)."""
        return decompose(self.outputs, self.batch)


def infer(hierarchy: Hierarchy, demonstrations: Iterable[Demonstration]) -> Iterator[Inferred]:
    """What a trained hierarchy says of demonstrations, as many together as the networks take at once.

    :param demonstrations: in memory, or read one by one while this goes on.
    :raises DemonstrationsError: there are none, they do not go together, or a number is too large for networks.
    """
    for group in _groups(demonstrations, hierarchy.steps_at_once):
        demos = Demonstrations(tuple(group))
        yield Inferred(demos.names, encode(demos, hierarchy.encoder, hierarchy.scaling, fitted=True), hierarchy)


def _groups(demonstrations: Iterable[Demonstration], steps: int) -> Iterator[list[Demonstration]]:
    """Consecutive demonstrations of at most so many steps, padding included; one demonstration at least."""
    group: list[Demonstration] = []
    for demo in demonstrations:
        observed = sum(array[0].nbytes for array in demo.observations.values() if isinstance(array, np.ndarray))
        at_most = min(steps, GROUP_BYTES / (COPIES * observed + INFERENCE))
        if group and (len(group) + 1) * max(len(demo), *map(len, group)) > at_most:
            yield group
            group = []
        group.append(demo)
    yield group
