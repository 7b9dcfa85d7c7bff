"""Ways to begin (``training.starts``): what the initial segments of a level are, and what is trained first.

Segments are clusters of observations (vector quantisation, SM 2.2), also with controls, or equal parts.

The paper clones one policy from each cluster. Here the whole model is trained with the choices of a level
clamped to these segments. This clones the policies and starts the terminations from the clusters' boundaries,
at any level.

In these clusters demonstrations that are left out choose the ridge of policies.

Labels name clusters. Where every option has labelled steps, multinomial logistic regression assigns the other
steps. Where some options have labelled steps, their clusters start from the means of these steps (seeded
k-means, Basu et al. 2002).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import BYTES_AT_ONCE, Hierarchy
from ddco_pyro.model.networks.perceptrons import Mlp
from ddco_pyro.model.recogniser import observed, window_means
from ddco_pyro.spec import Start
from ddco_pyro.training.em import BIAS

if TYPE_CHECKING:
    from sklearn.cluster import KMeans
    from sklearn.linear_model import LogisticRegression

ENOUGH = 20_000
"""The most steps that k-means without labels finds clusters of."""

ITERATIONS = 300
"""The most iterations of k-means or logistic regression."""


class Clusters:
    """k-means clusters of the observations of every step of a batch, named as the options 1 to k.

    Fewer than ``options`` clusters are found where there are fewer distinct observations. The clusters are
    fitted to at most :data:`ENOUGH` steps, with labels to :func:`most_rows`, drawn at random.

    :param controls: cluster observations and controls together, with equal weight on either. Steps with
        similar observations and different controls are then in different clusters.
    :param labels: the options of labelled steps, 1 to m, and -1 for the others, [N, T].
    :param read: names of the observations that are clustered; all where it is empty.
    :param best: the best of ten runs of k-means, nearly the same ones whatever the seed; otherwise a single
        run from steps drawn at random.
    :param window: steps before and after a step over which what is clustered is averaged.
    """

    def __init__(
        self,
        batch: Batch,
        options: int,
        seed: int,
        controls: bool = False,
        labels: Tensor | None = None,
        read: Sequence[str] = (),
        best: bool = True,
        window: int = 0,
    ) -> None:
        self._controls, self._read, self._window = controls, read, window
        most = most_rows(next(self._trajectories(batch)).shape[1])
        most = min(most, ENOUGH) if labels is None else most  # labels may be few
        chosen = np.ones(batch.steps, dtype=bool)
        chosen[np.random.default_rng(seed).permutation(batch.steps)[most:]] = False
        left, found = chosen, []
        for block in self._trajectories(batch):
            here, left = np.split(left, [len(block)])
            found.append(block[here])
        rows = np.concatenate(found)
        known = None if labels is None else labels[batch.alive].numpy()[chosen]
        self._namer: LogisticRegression | KMeans
        if known is not None and options > 1 and len(_labelled(known, options)) == options:
            from sklearn.linear_model import LogisticRegression

            self._namer = LogisticRegression(max_iter=ITERATIONS).fit(rows[known > 0], known[known > 0] - 1)
        else:
            start = None if known is None else _Start(known)
            self._namer = _k_means(rows.tobytes(), rows.shape[1], distinct(rows, options), start, best, seed)

    def choices(self, batch: Batch) -> Tensor:
        """The cluster of each step, [N, T], 1 to k; 0 where there is padding."""
        choices = torch.zeros(batch.inputs.batch, dtype=torch.long)
        clusters = [self._namer.predict(rows) for rows in self._trajectories(batch)]
        choices[batch.alive] = torch.as_tensor(np.concatenate(clusters), dtype=torch.long) + 1
        return choices

    def _trajectories(self, batch: Batch) -> Iterator[np.ndarray]:
        """The features of every step [T, F] of each trajectory."""
        for row, length in enumerate(batch.lengths.tolist()):
            inputs = batch.inputs.part(torch.tensor([row]), slice(0, length))
            rows = observed(inputs.select(self._read) if self._read else inputs)
            if self._controls:
                rows = joined(rows, batch.actions[row : row + 1, :length].double())
            if self._window:
                rows = window_means(rows, torch.tensor([length]), self._window, self._window)
            yield rows[0].numpy()


@lru_cache(maxsize=4)
def _k_means(rows: bytes, numbers: int, clusters: int, start: _Start | None, best: bool, seed: int) -> KMeans:
    """The clusters of rows of so many numbers. A model and the mixture beside it begin from the same ones."""
    from sklearn.cluster import KMeans

    init = start or ("k-means++" if best else "random")
    found = KMeans(clusters, init=init, n_init=10 if best else 1, max_iter=ITERATIONS, random_state=seed)
    return found.fit(np.frombuffer(rows).reshape(-1, numbers))


def most_rows(numbers: int) -> int:
    """The most steps, with so many numbers each, that are clustered together: memory bounds them."""
    return max(1, BYTES_AT_ONCE // (8 * max(1, numbers)))


def joined(seen: Tensor, actions: Tensor) -> Tensor:
    """Observations [..., F] and controls [..., A], standardised, as [..., F + A] with equal weights."""
    return torch.cat([seen, (seen.shape[-1] / actions.shape[-1]) ** 0.5 * actions], dim=-1)


def equal_parts(batch: Batch, options: int) -> Tensor:
    """The part of each step in trajectories cut into ``options`` equal parts, [N, T], 1 to k; 0 for padding.

    Training of left-to-right hidden Markov models starts from this uniform segmentation.
    """
    part = batch.inputs.time * options // batch.lengths[:, None] + 1
    return torch.where(batch.alive, part, 0)


# --- ways to begin ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """A way to begin: initial segments, and what is trained first.

    :param stage: names the stages that train on clusters, or on equal parts; empty for random weights.
    :param controls: whether clusters are of observations and controls, or of observations alone.
    :param windowed: whether clusters are of means over ``training.window`` steps before and after each.
    :param memoryless: whether the memoryless mixture is trained before options that last.
    :param ordered: whether segments are equal parts of each demonstration, numbered in the order of time.
    """

    stage: str = "vq"
    controls: bool = False
    windowed: bool = False
    memoryless: bool = False
    ordered: bool = False


WAYS: Mapping[Start | Literal["library"], Way] = {
    "vq": Way(),
    "vq_controls": Way(controls=True),
    "windows": Way(controls=True, windowed=True),
    "equal_parts": Way("parts", ordered=True),
    "mixture": Way(controls=True, memoryless=True),
    "random": Way(""),
    "library": Way(""),
}
"""Every way to begin, by its name in a spec, and that of a model with a library (``training.library``)."""


# --- labels and clusters ------------------------------------------------------------------------------------


class _Start:
    """Initial centres of k-means: means of labelled options, then rows far from them (as k-means++ draws)."""

    def __init__(self, labels: np.ndarray) -> None:
        self.labels = labels

    def __call__(self, rows: np.ndarray, clusters: int, random_state: np.random.RandomState) -> np.ndarray:
        from sklearn.metrics import euclidean_distances

        labelled = _labelled(self.labels, clusters)
        means = {option: rows[self.labels == option].mean(0) for option in labelled}
        for option in set(range(1, clusters + 1)) - set(labelled):
            far = euclidean_distances(rows, np.stack(list(means.values())), squared=True).min(1)
            means[option] = rows[random_state.choice(len(rows), p=far / far.sum())]
        return np.stack([means[option] for option in range(1, clusters + 1)])


def _labelled(labels: np.ndarray, options: int) -> list[int]:
    """The options that have labels, sorted."""
    return [int(option) for option in np.unique(labels) if 0 < option <= options]


def distinct(rows: np.ndarray, most: int) -> int:
    """The number of different rows, counted up to ``most``."""
    seen: set[bytes] = set()
    for row in rows:
        seen.add((row + 0.0).tobytes())  # + 0.0: minus zero is zero
        if len(seen) == most:
            break
    return len(seen)


# --- the ridge with which EM begins -------------------------------------------------------------------------

RAISED = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""The ridges that are tried, in units of the spec's own."""
FOLDS = 5
"""The parts into which training demonstrations are divided, each left out in turn."""
GAIN = 0.5
"""Nats per step: a ridge is large enough where no other gains more. Larger ones make policies act worse."""
LEAST = 0.01
"""σ of a policy, at least, in units of each dimension's spread."""


def cross_validated(model: Hierarchy, batch: Batch, ridge: float, seed: int) -> float:
    """The smallest of the ridges :data:`RAISED` that is large enough for the policies of a linear hierarchy.

    For each cluster of observations and controls, as many as the lowest level has options, ridge regression
    predicts the continuous controls of demonstrations that are left out. EM begins from such regressions.

    :param batch: the training demonstrations; one alone leaves nothing to predict.
    :param ridge: the spec's own.
    """
    scaling = model.scaling
    scaled = zip(scaling.groups, scaling.parts, strict=True)
    dims = [dim for own, part in scaled if part.continuous for dim in own]
    (policy, *_), count = model.networks().values(), model.option_levels()[0].count if model.depth else 1
    assert isinstance(policy, Mlp)  # EM trains no other
    if len(batch) < 2 or not dims or not ridge or not policy.reads:
        return ridge
    given = batch.inputs.select(policy.reads).vector.double()
    x = torch.cat([given, given.new_ones(*given.shape[:-1], 1)], dim=-1)
    alive = batch.alive
    clusters = (
        Clusters(batch, count, seed, controls=True, read=policy.reads).choices(batch) if count > 1 else alive
    )
    fold = (torch.arange(len(batch)) % min(FOLDS, len(batch))).unsqueeze(1)
    ridges = ridge * torch.tensor(RAISED, dtype=torch.float64)
    total, controls = torch.zeros_like(ridges), batch.actions[..., dims].double()
    for cluster in range(1, count + 1):
        parts = (alive & (clusters == cluster) & (fold == part) for part in fold.unique())
        each = [Moments.of(x[where], controls[where]) for where in parts]
        every = [sum(own) for own in zip(*each, strict=True)]
        for left_out in each:
            known = Moments(*(whole - out for whole, out in zip(every, left_out, strict=True)))
            total += left_out_likelihood(known, left_out, ridges)
    values = total / batch.steps
    return float(ridges[int((values >= values.max() - GAIN).nonzero()[0])])


class Moments(NamedTuple):
    """Sums over steps that regressions need: x x^T [F, F], x a^T [F, A], a² [A], and their number."""

    square: Tensor
    product: Tensor
    controls: Tensor
    steps: Tensor

    @classmethod
    def of(cls, x: Tensor, actions: Tensor) -> Moments:
        """Of steps with features [M, F] and controls [M, A]."""
        return cls(x.T @ x, x.T @ actions, actions.square().sum(0), torch.tensor(float(len(x))))

    def errors(self, weight: Tensor) -> Tensor:
        """Σ_t (a - W^T x)² of each of R regressions [R, F, A], [R, A]."""
        return (self.controls + (weight * (self.square @ weight - 2 * self.product)).sum(1)).clamp(min=0)


def left_out_likelihood(known: Moments, left_out: Moments, ridges: Tensor) -> Tensor:
    """The log-likelihood of left-out controls by regressions with R ridges, up to a constant, [R] nats."""
    features = len(known.square)
    prior = ridges.unsqueeze(-1).repeat(1, features)
    prior[:, -1] = BIAS
    weight = torch.linalg.solve(known.square + torch.diag_embed(prior), known.product)  # [R, F, A]
    square = known.errors(weight) + (prior.unsqueeze(-1) * weight.square()).sum(1)
    std = (square / (known.steps + features - 1).clamp(min=1)).sqrt().clamp(min=LEAST)
    return -0.5 * (left_out.errors(weight) / std.square()).sum(1) - left_out.steps * std.log().sum(1)
