"""What all restarts of a fit are trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ddco_pyro.data.reading import Readers
from ddco_pyro.model.encoding import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec
from ddco_pyro.training.checkpoint import State
from ddco_pyro.training.devices import device_of, room
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.networks import Dimensions, build_hierarchy


@dataclass(frozen=True)
class Material:
    """What all restarts share: demonstrations to train and to tune on, and how they were encoded and scaled.

    :param names: of the training demonstrations.
    :param labels: the labels that say which options are active; None where there are none.
    """

    spec: Spec
    dimensions: Dimensions
    train: Batch
    tune: Batch
    names: Sequence[str]
    encoder: State
    scaling: State
    labels: Labels | None = None

    def hierarchy(self, restart: int) -> Hierarchy:
        """A restart's hierarchy before any training, in evaluation mode, its networks on the spec's device."""
        hierarchy = build_hierarchy(self.spec, self.dimensions, self.seed(restart))
        hierarchy.encoder.load_state_dict(self.encoder)
        hierarchy.scaling.load_state_dict(self.scaling)
        return hierarchy.place(device_of(self.spec.training)).eval()

    def read_by(self, readers: Readers) -> Material:
        """The same with pictures that are in files read by these."""
        return replace(self, train=self.train.read_by(readers), tune=self.tune.read_by(readers))

    def held(self, device: torch.device) -> Material:
        """The same with all pictures on the device of the networks, where there is room for them (:func:`room`).

        :raises DemonstrationsError: a file cannot be read.
        """
        if self.train.picture_bytes + self.tune.picture_bytes > room(device):
            return self
        return replace(self, train=self.train.held(device), tune=self.tune.held(device))

    def seed(self, *where: int) -> int:
        """A seed for a restart, one of its stages, an epoch of a stage, or a shard of one of its minibatches.

        numpy pads with zeros: a stage has the seed of its first epoch, and the first stage that of its restart. They
        draw different things: weights, clusters, the order of minibatches. No two restarts, no two stages of one, and
        no two epochs or shards have the same seed.
        """
        own, training = self.spec.seed, self.spec.training.seed
        return int(np.random.SeedSequence([own if training is None else training, *where]).generate_state(1)[0])
