"""Baselines of segmentation: clusters, hidden Markov models, change points and rules.

>>> names = baselines.segment("hmm", train, valid, count=2, seed=0)  # [T] for each demonstration of ``valid``
>>> len(names) == len(valid), len(names[0]) == len(valid[0])
(True, True)
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import equal_lengths
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.recogniser import observed
from ddco_pyro.spec import ObservationSpec
from ddco_pyro.training.initialization import distinct, joined

RECOGNISER = "recogniser"
RECOGNISED = "recogniser alone"
"""The options of single steps that a run's recogniser finds, beside the baselines; and their name in tables."""

EQUAL = "equal"
"""The baseline of parts of equal length."""

PIECES = 2
"""Pieces of a demonstration between change points, for each kind of segment asked for."""

RESTARTS = 3
"""Restarts of hidden Markov models and mixtures; the likeliest is kept."""

SPREAD = 1e-3
"""Smallest variance of mixtures and hidden Markov models, in standardised units."""


def segment(
    name: str,
    train: Demonstrations,
    valid: Demonstrations,
    count: int,
    seed: int,
    observations: Sequence[ObservationSpec] | None = None,
    gripper: int = -1,
    relative_to: str | None = None,
) -> list[np.ndarray]:
    """Segments of a baseline that is fitted to ``train``: one of ``count`` kinds at each step of ``valid``, [T] each.

    Clusters, mixtures, hidden Markov models and change points read observations and controls, standardised by
    ``train`` and equally weighted. Pictures enter as block means.

    :param name: one of :data:`BASELINES`.
    :param observations: the observations to read; all of ``train`` for None.
    :param gripper: for ``gripper``, the control dimension whose changes divide; negative ones count from the end.
    :param relative_to: the observation that controls are relative to; None for none.
    :raises BadInput: there is no such baseline or control dimension, or a package is not installed.
    """
    if name not in BASELINES:
        raise BadInput(f"there is no baseline {name!r}{nearest(name, BASELINES)}; there is: {', '.join(BASELINES)}")
    check_installed([name])
    if name == EQUAL:
        return [equal_lengths(len(demo), count) for demo in valid]
    if name == "gripper":
        return _gripper(train, valid, gripper)
    rows = _rows_of(train, observations, relative_to)
    return METHODS[name]([rows(demo) for demo in train], [rows(demo) for demo in valid], count, seed)


def _rows_of(
    train: Demonstrations, observations: Sequence[ObservationSpec] | None, relative_to: str | None
) -> Callable[[Demonstration], np.ndarray]:
    """A function from a demonstration to a row of features for each step, standardised by the training ones."""
    shapes = train.observation_shapes
    encoder = ObservationEncoder(observations or [ObservationSpec(key=key) for key in shapes], shapes)
    encoder.fit(train)
    controls = np.concatenate([demo.controls(relative_to) for demo in train])
    middle, spread = controls.mean(0), controls.std(0)
    varying = spread > 1e-9 * np.maximum(np.abs(controls).max(0), 1e-9)

    def rows(demo: Demonstration) -> np.ndarray:
        (seen,) = observed(encoder.inputs([demo.observations]))
        scaled = (demo.controls(relative_to) - middle)[:, varying] / spread[varying]
        both = joined(seen, torch.as_tensor(scaled)) if varying.any() else seen
        return both.numpy()

    return rows


Rows = list[np.ndarray]


def _kmeans(train: Rows, valid: Rows, count: int, seed: int) -> Rows:
    from sklearn.cluster import KMeans

    rows = np.concatenate(train)
    fitted = KMeans(distinct(rows, count), n_init=10, random_state=seed).fit(rows)
    return [fitted.predict(own) for own in valid]


def _mixture(train: Rows, valid: Rows, count: int, seed: int) -> Rows:
    from sklearn.mixture import GaussianMixture

    rows = np.concatenate(train)
    count = distinct(rows, count)
    fitted = GaussianMixture(count, reg_covar=SPREAD, n_init=RESTARTS, max_iter=300, random_state=seed).fit(rows)
    return [fitted.predict(own) for own in valid]


def _hidden_markov(train: Rows, valid: Rows, count: int, seed: int) -> Rows:
    """Gaussian emissions with diagonal covariances; the most likely path."""
    from hmmlearn.hmm import GaussianHMM

    logging.getLogger("hmmlearn").setLevel(logging.ERROR)  # a warning for each restart that does not converge
    rows, lengths = np.concatenate(train), [len(own) for own in train]
    count = distinct(rows, count)
    # Dirichlet priors of 1.1: no state and no transition gets probability 0.
    fitted = [
        GaussianHMM(count, "diag", SPREAD, 1.1, 1.1, n_iter=100, random_state=seed + 7919 * restart).fit(rows, lengths)
        for restart in range(RESTARTS)
    ]
    best = max(fitted, key=lambda model: model.monitor_.history[-1])
    return [best.predict(own) for own in valid]


def _change_points(train: Rows, valid: Rows, count: int, seed: int) -> Rows:
    """Pieces of least variance (exact, by dynamic programming), clustered by their means."""
    import ruptures
    from sklearn.cluster import KMeans

    def divided(rows: np.ndarray) -> list[np.ndarray]:
        changes = min(PIECES * count, len(rows)) - 1
        if changes < 1:
            return [rows]
        ends = ruptures.KernelCPD(kernel="linear", min_size=1).fit(rows).predict(n_bkps=changes)
        return np.split(rows, ends[:-1])

    pieces = [piece for rows in train for piece in divided(rows)]
    means = np.array([piece.mean(0) for piece in pieces])
    clusters = KMeans(distinct(means, count), n_init=10, random_state=seed)
    clusters.fit(means, sample_weight=[len(piece) for piece in pieces])
    return [
        np.concatenate([np.full(len(piece), clusters.predict(piece.mean(0)[None])[0]) for piece in divided(rows)])
        for rows in valid
    ]


def _gripper(train: Demonstrations, valid: Demonstrations, dimension: int) -> Rows:
    """Pieces between the steps at which a control crosses the middle of its range, numbered in order."""
    if not -train.control_size <= dimension < train.control_size:
        raise BadInput(f"there is no control dimension {dimension}; there are {train.control_size}, counted from 0")
    values = np.concatenate([demo.actions[:, dimension] for demo in train])
    middle = (values.min() + values.max()) / 2
    sides = [demo.actions[:, dimension] > middle for demo in valid]
    return [np.cumsum(np.diff(side, prepend=side[:1])) for side in sides]


PACKAGES = {"hmm": "hmmlearn", "change_points": "ruptures"}
"""The packages that baselines need beside the project's own."""


def check_installed(names: Iterable[str]) -> None:
    """Check that baselines have the packages that they need.

    :raises BadInput: a package is not installed.
    """
    for name, package in PACKAGES.items():
        if name in names and find_spec(package) is None:
            raise BadInput(f"the baseline {name} needs {package}; install it with: pip install 'ddco-pyro[segments]'")


METHODS: dict[str, Callable[[Rows, Rows, int, int], Rows]] = {
    "kmeans": _kmeans,
    "gmm": _mixture,
    "hmm": _hidden_markov,
    "change_points": _change_points,
}

BASELINES = {
    "kmeans": "k-means",
    "gmm": "Gaussian mixture",
    "hmm": "Gaussian HMM",
    "change_points": "change points, clustered",
    EQUAL: "equal lengths",
    "gripper": "gripper changes",
}
"""The baselines and their names in tables."""
