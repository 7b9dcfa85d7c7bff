"""``OptionSegmenter``: :func:`ddco_pyro.fit` for arrays, in the convention of scikit-learn and hmmlearn."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.utils import check_array, check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.starting import STARTS
from ddco_pyro.errors import BadInput, check_whole
from ddco_pyro.fitting.fit import fit
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.spec import Spec, SpecError, parse_spec

Arrays = Any
"""An array or a data frame [ΣT, D], or a sequence of them, one for each demonstration."""

PARAMETERS = {
    "hierarchy.levels.0.count": "n_options",
    "hierarchy.levels.0.policy.network": "policy",
    "control.kind": "control",
    "seed": "random_state",
}
"""The parameter behind a key path of the spec."""

SEEDS = 2**31 - 1
"""Seeds that are drawn are smaller."""


class OptionSegmenter(BaseEstimator):
    """Options of observations X and controls U, as an estimator: one level, option h as label h − 1.

    Sequences are a list of arrays, or one array of all steps with the ``lengths`` of the sequences; without
    ``lengths`` an array is one sequence. Arrays have a row for each step. Data frames and series of pandas
    and polars count as arrays: their columns have to be named as in the fit, and an index is not read.
    ``score``, ``decode``, ``predict`` and ``predict_proba`` condition on all of a sequence.

    Without U, as in hmmlearn, X is emitted by the options, and there is no observation: a hidden Markov model
    with transition matrix diag(1 − ψ) + ψ ηᵀ, ``transmat_``. A one-dimensional U is hmmlearn's ``lengths``.

    >>> X, U = [demo.observations["place"] for demo in demos], [demo.actions for demo in demos]
    >>> model = ddco_pyro.OptionSegmenter(2, random_state=0).fit(X, U)
    >>> model.predict(X, U).shape, model.predict_proba(X, U).shape
    ((60,), (60, 2))
    >>> joined = np.concatenate(X), np.concatenate(U)
    >>> bool(np.isclose(model.score(X, U), model.score(*joined, lengths=[10] * 6)))
    True

    :param n_options: k.
    :param policy: the network of the options' policies: ``linear``, which EM trains, or ``mlp``.
    :param differences: whether networks read x_t − x_{t−1}, too.
    :param control: the distribution of the controls, as ``control.kind`` in a spec.
    :param random_state: the seed of the fit, a ``RandomState``, or None for another seed in each fit.
    :param settings: other settings by their key path in a spec, such as ``{"training.layerwise": False}``.

    ``fit_`` is the :class:`~ddco_pyro.Fit`, ``spec_`` its spec, ``n_features_in_`` the number of X's columns.
    """

    def __init__(
        self,
        n_options: int = 4,
        *,
        policy: str = "linear",
        differences: bool = True,
        control: str = "auto",
        random_state: Any = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.n_options = n_options
        self.policy = policy
        self.differences = differences
        self.control = control
        self.random_state = random_state
        self.settings = settings

    def fit(self, X: Arrays, U: Arrays | None = None, lengths: Sequence[int] | None = None) -> Self:
        """Fit to observations X [ΣT, D] and controls U [ΣT, A].

        :raises BadInput: the arrays are not sequences of the same steps, or a setting does not exist. It is a
            ``ValueError``.
        :raises DemonstrationsError: a value cannot be used.
        """
        demos = self._demonstrations(X, U, lengths, fitting=True)
        self.spec_ = self._spec()
        self.fit_ = fit(self.spec_, demos)
        if not self._has_controls:
            (piece,) = self.fit_.infer(demos[:1])
            tables = piece.tables
            selection, termination = (table[0].exp() for table in (tables.selection, tables.termination))
            self.startprob_ = selection[0, 0, 0, 1:].double().numpy()
            ending = termination[0, 0, :, 1:].double().numpy()
            self.transmat_ = np.diag(1 - ending[:, 0]) + ending * self.startprob_
        return self

    def predict(self, X: Arrays, U: Arrays | None = None, lengths: Sequence[int] | None = None) -> np.ndarray:
        """The option at each step of the most likely path, int64 [ΣT], from 0."""
        demos = self._demonstrations(X, U, lengths)
        return np.concatenate(self.fit_.segment(demos)[0]) - 1

    def predict_proba(
        self, X: Arrays, U: Arrays | None = None, lengths: Sequence[int] | None = None
    ) -> np.ndarray:
        """The posterior probability of each option at each step, u of §4.1, [ΣT, k]."""
        demos = self._demonstrations(X, U, lengths)
        padded = self.fit_.posterior(demos).u[0].numpy()
        return np.concatenate([row[:steps, 1:] for row, steps in zip(padded, demos.lengths, strict=True)])

    def score(self, X: Arrays, U: Arrays | None = None, lengths: Sequence[int] | None = None) -> float:
        """log p(ξ) of all sequences together, nats."""
        return float(self.fit_.log_likelihood(self._demonstrations(X, U, lengths)).sum())

    def decode(
        self, X: Arrays, U: Arrays | None = None, lengths: Sequence[int] | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(ξ, h) of the options h that :meth:`predict` gives, nats, and these options."""
        demos, total = self._demonstrations(X, U, lengths), 0.0
        for piece in self.fit_.infer(demos):
            clamped = replace(piece.tables.clamp(1, piece.path.choices[0]), power=1.0)
            total += float(log_likelihood(clamped, piece.batch.lengths).sum())
        return total, np.concatenate(self.fit_.segment(demos)[0]) - 1

    def sample(
        self, X: Any = 1, lengths: Sequence[int] | None = None, random_state: Any = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Controls drawn from the model [ΣT, A], and the options that emitted them [ΣT].

        :param X: the observations to which the controls react; for a fit without U, the number of steps.
        """
        check_is_fitted(self)
        if self._has_controls:
            observed = self._rows(X, None, lengths)[::2]
        else:
            check_whole("X", X, 1)
            observed = np.zeros((X, 1)), np.array([X])
        first = _drawn(random_state)
        controller = Controller(self.fit_.hierarchy, "sample", "sample")
        controls, options = [], []
        for number, rows in enumerate(self._split(*observed)):
            controller.reset(first + number)
            for row in rows:
                controls.append(controller.act({"x": row}))
                options.append(controller.choices[0] - 1)
        return np.array(controls), np.array(options)

    def _spec(self) -> Spec:
        seed, linear = self.random_state, self.policy == "linear"
        settings = {} if self.settings is None else self.settings
        if not isinstance(settings, Mapping) or not all(isinstance(path, str) for path in settings):
            raise BadInput(
                f"settings={settings!r}: has to be a mapping of key paths, such as "
                "{'training.layerwise': False}"
            )
        network = {"network": "linear"}
        level = {"count": self.n_options, "policy": {"network": self.policy}, "termination": network}
        data = {
            "demonstrations": {"path": "arrays in memory", "valid_fraction": 0},
            "observations": [{"key": "x", "differences": self.differences and self._has_controls}],
            "control": {"kind": self.control, "std": {"learn": True, "per_option": True}},
            "hierarchy": {"levels": [level], "meta_policy": network},
            "training": {
                "starts": STARTS,
                "optimizer": {"name": "em", "lr": 3e-3},
                "patience": 50,
                "tune_fraction": 0 if linear else 0.1,
            },
            "seed": seed if isinstance(seed, Integral) else _drawn(seed),
        }
        try:
            return parse_spec(data, settings)
        except SpecError as error:
            paths = {path: name for path, name in PARAMETERS.items() if path not in settings}
            problems = (problem.split(":", 1) for problem in error.problems)
            raise SpecError(*(f"{paths.get(path, path)}:{problem}" for path, problem in problems)) from None

    def _demonstrations(
        self, X: Arrays, U: Arrays | None, lengths: Sequence[int] | None, fitting: bool = False
    ) -> Demonstrations:
        """The sequences as demonstrations with the observation ``x``."""
        if not fitting:
            check_is_fitted(self)
        observed, controls, steps = self._rows(X, U, lengths, fitting)
        if fitting:
            self._has_controls = controls is not None
        elif (controls is not None) != self._has_controls:
            how, what = ("with", "give U") if self._has_controls else ("without", "leave U out of")
            raise BadInput(f"the model was fitted {how} controls U; {what} here, too")
        if controls is None:
            observed, controls = np.zeros((len(observed), 1)), observed
        pairs = zip(self._split(observed, steps), self._split(controls, steps), strict=True)
        demos = (Demonstration(f"sequence_{n}", {"x": x}, u) for n, (x, u) in enumerate(pairs))
        return Demonstrations(tuple(demos))

    def _rows(
        self, X: Any, U: Any, lengths: Any, fitting: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """X and U with a row for each step, and the lengths of the sequences."""
        X, U = (list(given) if isinstance(given, Iterator) else given for given in (X, U))
        if U is not None and _dimensions(U) == 1:
            if lengths is not None:
                raise BadInput("U has one dimension; give controls as [steps, dimensions]")
            U, lengths = None, U
        try:
            if 3 in (_dimensions(X), _dimensions(U)):
                if lengths is not None:
                    raise BadInput("a list of sequences has its own lengths; leave lengths out")
                if _dimensions(X) != 3:
                    raise BadInput("X and U must be lists of sequences [steps, dimensions]")
                lengths = [len(rows) for rows in X]
                for number, rows in enumerate(X):  # the names and the number of columns
                    validate_data(self, rows, reset=fitting and number == 0, skip_check_array=True)
                joined = np.concatenate([np.asarray(rows) for rows in X])
                X = check_array(joined, dtype=np.float64, input_name="X")
                if U is not None:
                    controls = [np.asarray(rows) for rows in U]
                    if [len(rows) for rows in controls] != lengths:
                        raise BadInput("X and U must be lists of sequences with equal numbers of steps")
                    for number, rows in enumerate(U):
                        self._check_controls(rows, fitting and number == 0)
                    U = np.concatenate([rows[:, None] if rows.ndim == 1 else rows for rows in controls])
            else:
                fewest = 2 if fitting else 1
                X = validate_data(self, X, reset=fitting, dtype=np.float64, ensure_min_samples=fewest)
                self._check_controls(U, fitting)
            U = None if U is None else check_array(U, input_name="U")
        except BadInput:
            raise
        except ValueError as error:
            raise BadInput(" ".join(str(error).split())) from None
        if U is not None and len(U) != len(X):
            raise BadInput(f"X has {len(X)} steps, and U has {len(U)}; give both for the same steps")
        lengths = np.array([len(X)] if lengths is None else lengths)
        if lengths.dtype.kind not in "iu" or (lengths < 1).any() or lengths.sum() != len(X):
            raise BadInput(f"lengths must be whole numbers from 1 on whose sum is {len(X)}, the steps of X")
        return X, U, lengths

    def _check_controls(self, U: Any, fitting: bool) -> None:
        """Refuse a data frame of controls whose columns are in another order than in the fit."""
        names = [*map(str, U.columns)] if hasattr(U, "columns") else None
        if fitting:
            self._control_names = names
        elif names and self._control_names and names != self._control_names:
            there = ", ".join(self._control_names)
            raise BadInput(f"U has the columns {', '.join(names)}; the fit had {there}")

    @staticmethod
    def _split(rows: np.ndarray, lengths: np.ndarray) -> list[np.ndarray]:
        return np.split(rows, np.cumsum(lengths)[:-1])


def _dimensions(values: Any) -> int:
    """The dimensions of an array, a data frame, or a sequence of them, which may have different lengths."""
    if hasattr(values, "columns"):
        return 2
    if getattr(values, "ndim", 0) > 1 or not isinstance(values, Iterable):
        return int(getattr(values, "ndim", 0))
    first = next(iter(values), None)
    return 1 if first is None else 1 + np.ndim(first)


def _drawn(random_state: Any) -> int:
    """A seed drawn from a random state.

    :raises BadInput: ``random_state`` is no random state.
    """
    try:
        return int(check_random_state(random_state).randint(SEEDS))
    except ValueError:
        raise BadInput(
            f"random_state={random_state!r}: has to be a whole number, a numpy.random.RandomState, or None"
        ) from None
