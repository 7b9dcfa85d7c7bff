"""Vector quantisation (SM 2.2): clusters of the observations say, to begin with, which option is active when.

The paper clones one policy from each cluster. Here the whole model is trained with the choices of a level clamped to
the clusters, which clones those policies and starts the terminations from the clusters' boundaries in the same way,
at any level.
"""

from __future__ import annotations

import numpy as np
import torch
from sklearn.cluster import KMeans
from torch import Tensor

from ddco_pyro.model.encoding import Batch

POOLED = 8
"""Images are clustered by their POOLED × POOLED block means."""


class Clusters:
    """k-means clusters of the observations of every step of a batch, named as the options 1 to k.

    :param controls: cluster observations and controls together, with as much weight on the controls as on the
        observations: steps that look alike but are acted on differently are then told apart.

    Fewer than ``options`` clusters are found where there are fewer distinct observations.
    """

    def __init__(self, batch: Batch, options: int, seed: int, controls: bool = False) -> None:
        self._controls = controls
        rows = self._rows(batch)
        distinct = len(np.unique(rows, axis=0))
        self._kmeans = KMeans(min(options, distinct), n_init=10, random_state=seed).fit(rows)

    def choices(self, batch: Batch) -> Tensor:
        """The cluster of each step, [N, T], 1 to k; 0 where there is padding."""
        found = torch.zeros(batch.inputs.batch, dtype=torch.long)
        found[_alive(batch)] = torch.as_tensor(self._kmeans.predict(self._rows(batch)), dtype=torch.long) + 1
        return found

    def _rows(self, batch: Batch) -> np.ndarray:
        seen = _observations(batch)
        if not self._controls:
            return seen
        actions = batch.actions[_alive(batch)].double().numpy()
        return np.concatenate([seen, np.sqrt(seen.shape[1] / actions.shape[1]) * actions], axis=1)


def _alive(batch: Batch) -> Tensor:
    return batch.inputs.time < batch.lengths[:, None]


def _observations(batch: Batch) -> np.ndarray:
    """Observations of every step, [steps, features]."""
    columns = [batch.inputs.vector]
    for image in batch.inputs.images.values():
        pixels = image.flatten(0, 1).permute(0, 3, 1, 2).float() / 255
        pooled = torch.nn.functional.adaptive_avg_pool2d(pixels, POOLED)
        columns.append(pooled.reshape(*batch.inputs.batch, -1))
    rows: np.ndarray = torch.cat(columns, dim=-1)[_alive(batch)].double().numpy()
    return rows
