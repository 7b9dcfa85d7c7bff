"""Vector quantisation (SM 2.2): clusters of the observations say, to begin with, which option is active when.

The paper clones one policy from each cluster. Here the whole model is trained with the choices of a level clamped to
the clusters, which clones those policies and starts the terminations from the clusters' boundaries in the same way,
at any level. Where every option has labelled steps, what tells those apart names all others (multinomial logistic
regression); where some options have, their clusters start from the means of those (seeded k-means, Basu et al. 2002).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from sklearn.cluster import KMeans
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import euclidean_distances
from torch import Tensor

from ddco_pyro.data.memory import share
from ddco_pyro.model.encoding import Batch
from ddco_pyro.model.hierarchy import BYTES_AT_ONCE
from ddco_pyro.model.networks.conv import POOLED

ITERATIONS = 300
"""Of k-means, or of logistic regression, at most."""


class Clusters:
    """k-means clusters of the observations of every step of a batch, named as the options 1 to k.

    :param controls: cluster observations and controls together, with as much weight on the controls as on the
        observations: steps that look alike but are acted on differently are then told apart.
    :param labels: the options of the steps that have one, 1 to m, -1 for the others, [N, T]. Where every option has
        labelled steps, a step belongs to the option that logistic regression of those gives it to. Where not, the
        clusters of these options start from the means of their steps, the others as k-means++ does from there.
    :param read: names of the observations that are clustered, those of the options' policies; all where there is none.

    Fewer than ``options`` clusters are found where there are fewer distinct observations. Of more steps than
    :func:`most_rows` as many are drawn at random, and the clusters are theirs.
    """

    def __init__(
        self,
        batch: Batch,
        options: int,
        seed: int,
        controls: bool = False,
        labels: Tensor | None = None,
        read: Sequence[str] = (),
    ) -> None:
        self._controls, self._read = controls, read
        self._most = most_rows(next(self._blocks(batch)).shape[1])
        chosen = np.ones(batch.steps, dtype=bool)
        chosen[np.random.default_rng(seed).permutation(batch.steps)[self._most :]] = False
        rows = np.concatenate(list(_only(chosen, self._blocks(batch))))
        known = None if labels is None else labels[_alive(batch)].numpy()[chosen]
        self._namer: LogisticRegression | KMeans
        if known is not None and options > 1 and len(_labelled(known, options)) == options:
            self._namer = LogisticRegression(max_iter=ITERATIONS).fit(rows[known > 0], known[known > 0] - 1)
        else:
            start = "k-means++" if known is None else _Start(known)
            number = distinct(rows, options)
            self._namer = KMeans(number, init=start, n_init=10, max_iter=ITERATIONS, random_state=seed).fit(rows)

    def choices(self, batch: Batch) -> Tensor:
        """The cluster of each step, [N, T], 1 to k; 0 where there is padding."""
        choices = torch.zeros(batch.inputs.batch, dtype=torch.long)
        each = [self._namer.predict(rows) for rows in _together(self._blocks(batch), self._most)]
        choices[_alive(batch)] = torch.as_tensor(np.concatenate(each), dtype=torch.long) + 1
        return choices

    def _blocks(self, batch: Batch) -> Iterator[np.ndarray]:
        """What is clustered of consecutive steps [B, F], trajectory after trajectory."""
        for row, length in enumerate(batch.lengths.tolist()):
            alone, first = batch.inputs.part(torch.tensor([row]), slice(0, length)), 0
            for inputs in alone.chunks(FRAMES_AT_ONCE if alone.images else length):
                loaded = inputs.loaded()
                given = loaded.select(self._read) if self._read else loaded
                means = [block_means(image[0].cpu()) for image in given.images.values()]
                seen = torch.cat([given.vector[0], *means], dim=-1).double().numpy()
                last = first + len(seen)
                yield joined(seen, batch.actions[row, first:last].double().numpy()) if self._controls else seen
                first = last


def _only(chosen: np.ndarray, blocks: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The chosen rows of each block; ``chosen`` has an entry for each row of all blocks."""
    first = 0
    for block in blocks:
        yield block[chosen[first : first + len(block)]]
        first += len(block)


def _together(blocks: Iterable[np.ndarray], rows: int) -> Iterator[np.ndarray]:
    """Blocks one below the other, a new one from about so many rows on."""
    waiting: list[np.ndarray] = []
    for block in blocks:
        waiting.append(block)
        if sum(map(len, waiting)) >= rows:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)


def most_rows(numbers: int) -> int:
    """The most steps, of so many numbers each, that are clustered together, for the sake of memory."""
    return max(1, int(min(BYTES_AT_ONCE, share())) // (8 * max(1, numbers)))


def joined(seen: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Observations [steps, F] and controls [steps, A], standardised, as [steps, F + A] with equal weight on either."""
    return np.concatenate([seen, np.sqrt(seen.shape[1] / actions.shape[1]) * actions], axis=1)


class EqualParts:
    """Every trajectory cut into ``options`` parts of equal length, in order named as the options 1 to k.

    The uniform segmentation that training of left-to-right hidden Markov models starts from.
    """

    def __init__(self, options: int) -> None:
        self.options = options

    def choices(self, batch: Batch) -> Tensor:
        """The part of each step, [N, T], 1 to k; 0 where there is padding."""
        part = batch.inputs.time * self.options // batch.lengths[:, None] + 1
        return torch.where(_alive(batch), part, 0)


class _Start:
    """Where k-means starts: from the mean of each labelled option's rows, and from rows drawn far from all before."""

    def __init__(self, labels: np.ndarray) -> None:
        self.labels = labels

    def __call__(self, rows: np.ndarray, clusters: int, random_state: np.random.RandomState) -> np.ndarray:
        labelled = _labelled(self.labels, clusters)
        means = {option: rows[self.labels == option].mean(0) for option in labelled}
        for option in set(range(1, clusters + 1)) - set(labelled):
            far = euclidean_distances(rows, np.stack(list(means.values())), squared=True).min(1)
            means[option] = rows[random_state.choice(len(rows), p=far / far.sum())]
        return np.stack([means[option] for option in range(1, clusters + 1)])


def _labelled(labels: np.ndarray, options: int) -> list[int]:
    """The first so many options that have labels, sorted."""
    return [int(option) for option in np.unique(labels) if 0 < option <= options]


def _alive(batch: Batch) -> Tensor:
    return batch.inputs.time < batch.lengths[:, None]


FRAMES_AT_ONCE = 64
"""Pictures whose pixels are floating-point numbers at the same time."""


def block_means(frames: Tensor) -> Tensor:
    """uint8 [T, H, W, C] to [T, C · POOLED²], in [0, 1]: as many numbers as a convolutional network keeps of a map."""
    pooled = [
        torch.nn.functional.adaptive_avg_pool2d(block.permute(0, 3, 1, 2).float() / 255, POOLED).flatten(1)
        for block in frames.split(FRAMES_AT_ONCE)
    ]
    return torch.cat(pooled)


def distinct(rows: np.ndarray, most: int) -> int:
    """How many different rows there are, counted up to ``most``."""
    seen: set[bytes] = set()
    for row in rows:
        seen.add((row + 0.0).tobytes())  # + 0.0: minus zero is zero
        if len(seen) == most:
            break
    return len(seen)
