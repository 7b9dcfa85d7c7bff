"""Demonstrations as a padded batch of what networks see, with the controls in scaled units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.model.controls import ControlScaling
from ddco_pyro.model.encoder import ObservationEncoder, padded
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.tables import consecutive, part

STEPS_AT_ONCE = 12288
"""Most steps of a piece of a batch. The cache holds most of what these need. More or fewer go together where
a step takes little or much memory (:attr:`~ddco_pyro.model.hierarchy.Hierarchy.steps_at_once`)."""

SIDE_BY_SIDE = 8
"""Trajectories that exact inference takes through a step together: other numbers leave some of them idle."""

LARGEST_SCALED = 1e12
"""Largest feature or control in scaled units. The squares of what networks make of it, divided by that of a
small σ, have to be float32 numbers, and those end at 3e38."""


@dataclass(frozen=True)
class Batch:
    """N demonstrations padded to T steps.

    :param inputs: what networks see of the observations.
    :param actions: the control dimensions that vary, in scaled units, [N, T, A'].
    :param lengths: steps of each demonstration, [N].
    """

    inputs: Inputs
    actions: Tensor
    lengths: Tensor

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def steps(self) -> int:
        """Steps of all demonstrations, without padding."""
        return int(self.lengths.sum())

    @property
    def alive(self) -> Tensor:
        """Whether a step is within its demonstration, [N, T]."""
        return self.inputs.time < self.lengths[:, None]

    @property
    def by_length(self) -> Tensor:
        """The demonstrations, the shortest first: pieces of them in this order have little padding, [N]."""
        return self.lengths.argsort(stable=True)

    def pieces(self, steps: int = STEPS_AT_ONCE) -> Iterator[tuple[Tensor, Batch]]:
        """Parts of at most ``steps`` steps with padding, or of one demonstration, each with its rows."""
        most = max(steps // int(self.lengths.max()), 1)
        most -= most % SIDE_BY_SIDE if most > SIDE_BY_SIDE else 0
        for rows in torch.arange(len(self)).split(most):
            yield rows, self.select(rows) if len(rows) < len(self) else self

    def parts(self, rows: Tensor, steps: int) -> Parts:
        """The demonstrations ``rows`` [M] in :meth:`pieces`, each with its own."""
        return [(rows[part], piece) for part, piece in self.select(rows).pieces(steps)]

    def select(self, rows: Tensor, at_most: int | None = None) -> Batch:
        """The demonstrations ``rows`` [M], padded to the longest among them.

        :param at_most: only this many of their first steps.
        """
        lengths = self.lengths[rows].clamp(max=at_most or int(self.lengths.max()))
        steps = int(lengths.max())
        chosen, first = consecutive(rows), slice(0, steps)
        return Batch(self.inputs.part(chosen, first), part(self.actions, chosen, first), lengths)

    def varied(self, most: Mapping[str, int], seed: int) -> Batch:
        """An augmented batch, with pictures shifted at random.

        :param most: by observation, the most pixels of a shift along either axis.
        """
        random, images = np.random.default_rng(seed), dict(self.inputs.images)
        for key, pixels in most.items():
            shifts = random.integers(-pixels, pixels + 1, (len(self), 2))
            images[key] = replace(images[key], shifts=shifts)
        return replace(self, inputs=replace(self.inputs, images=images)) if most else self


Parts = Sequence[tuple[Tensor, Batch]]
"""Demonstrations in pieces, each with its rows."""


def encode(
    demonstrations: Demonstrations, encoder: ObservationEncoder, scaling: ControlScaling, fitted: bool = False
) -> Batch:
    """All demonstrations as one padded batch.

    :param fitted: as in :func:`refuse_unusable`, which this calls.
    """
    refuse_unusable(demonstrations, encoder, scaling, fitted)
    inputs = encoder.inputs(demo.observations for demo in demonstrations)
    actions = padded([scaling.scaled(demo.controls(scaling.relative_to)) for demo in demonstrations]).float()
    return Batch(inputs, actions, torch.tensor([len(demo) for demo in demonstrations]))


def refuse_unusable(
    demonstrations: Demonstrations, encoder: ObservationEncoder, scaling: ControlScaling, fitted: bool = False
) -> None:
    """Check that networks can take every feature, and the emissions every control.

    :param fitted: whether the model is fitted, so that its kinds of controls stand.
    :raises DemonstrationsError: a number in scaled units is larger than :data:`LARGEST_SCALED`, or a switch
        or a discrete action has a value of probability 0.
    """
    places = np.repeat([f"obs/{name}" for name in encoder.keys], encoder.sizes)
    for demo in demonstrations:
        if problem := scaling.impossible(demo.name, demo.controls(scaling.relative_to)):
            declare, repair = "declare another kind in control.parts", f"repair it, or leave {demo.name} out"
            raise DemonstrationsError(f"{problem}; {repair if fitted else declare}")
        features = encoder.scaled(encoder.features(demo.observations))
        sizes = np.abs(np.concatenate([features, scaling.scaled(demo.controls(scaling.relative_to))], axis=1))
        if (sizes > LARGEST_SCALED).any():
            step, column = np.argwhere(sizes > LARGEST_SCALED)[0]
            place = places[column] if column < len(places) else "actions"
            raise DemonstrationsError(
                f"{demo.name}: {place} at step {step} is {sizes[step, column]:.2g} once it is scaled, and "
                f"networks take at most {LARGEST_SCALED:g}; repair it, or leave {demo.name} out "
                "(demonstrations.exclude)"
            )
