"""The estimator: the numbers of ``ddco_pyro.fit``, scikit-learn's conventions, and the model of hmmlearn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hmmlearn.hmm import GaussianHMM
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.utils.estimator_checks import parametrize_with_checks

import ddco_pyro
from ddco_pyro import OptionSegmenter
from ddco_pyro.errors import BadInput

ONE_START = {"training.starts": ["vq_controls"]}
QUICK = {"training.epochs": 6, **ONE_START}


def two_options(number: int = 5, steps: int = 16, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Sequences whose control leads to the origin, later away from it."""
    random = np.random.default_rng(seed)
    X = [random.normal(size=(steps, 2)) for _ in range(number)]
    signs = np.repeat([[-1.0], [1.0]], steps // 2, 0)
    return X, [signs * x + 0.05 * random.normal(size=x.shape) for x in X]


def hidden_markov_model() -> GaussianHMM:
    """A hidden Markov model whose states last, and are then selected anew."""
    model = GaussianHMM(3, "diag")
    model.startprob_, ending = np.array([0.5, 0.3, 0.2]), np.array([[0.1], [0.2], [0.15]])
    model.transmat_ = np.diag(1 - ending[:, 0]) + ending * model.startprob_
    model.means_ = np.array([[0, 0], [3, 1], [-2, 4.0]])
    model.covars_ = np.array([[0.5, 0.2], [0.3, 0.4], [0.6, 0.6]])
    return model


# --- the same fit -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted() -> OptionSegmenter:
    return OptionSegmenter(2, random_state=3, settings=ONE_START).fit(*two_options())


def test_it_is_the_fit_of_its_spec(fitted: OptionSegmenter) -> None:
    X, U = two_options()
    pairs = enumerate(zip(X, U, strict=True))
    each = (ddco_pyro.Demonstration(f"sequence_{n}", {"x": x}, u) for n, (x, u) in pairs)
    demos = ddco_pyro.Demonstrations(tuple(each))
    fit = ddco_pyro.fit(fitted.spec_, demos)
    assert fitted.spec_.seed == 3
    assert fitted.score(X, U) == fit.log_likelihood(demos).sum()
    np.testing.assert_array_equal(fitted.predict(X, U), np.concatenate(fit.segment(demos)[0]) - 1)
    np.testing.assert_array_equal(fitted.predict_proba(X, U), fit.posterior(demos).u[0].flatten(0, 1)[:, 1:])


def test_planted_options_are_found(fitted: OptionSegmenter) -> None:
    X, U = two_options(seed=1)
    halves = np.tile(np.repeat([0, 1], 8), 5)
    found = fitted.predict(X, U)
    assert max((found == halves).mean(), (found != halves).mean()) > 0.95
    assert ((fitted.predict_proba(X, U).argmax(1) == found).mean()) > 0.95


def test_a_list_is_an_array_with_lengths(fitted: OptionSegmenter) -> None:
    X, U = two_options(3, seed=1)
    X[1], U[1] = X[1][:9], U[1][:9]
    lengths = [16, 9, 16]
    for ask in (fitted.predict, fitted.predict_proba, fitted.score):
        np.testing.assert_array_equal(ask(X, U), ask(np.concatenate(X), np.concatenate(U), lengths))
    assert fitted.score(X, U) == pytest.approx(sum(fitted.score(x, u) for x, u in zip(X, U, strict=True)))


def test_sampled_controls_lead_where_the_options_do(fitted: OptionSegmenter) -> None:
    X = np.random.default_rng(5).normal(size=(200, 2))
    U, options = fitted.sample(X, random_state=0)
    (again, _), (other, _) = fitted.sample(X, random_state=0), fitted.sample(X, random_state=1)
    np.testing.assert_array_equal(U, again)
    assert not np.array_equal(U, other)
    slopes = sorted((U * X)[options == option].sum() / (X * X)[options == option].sum() for option in (0, 1))
    assert slopes == pytest.approx([-1, 1], abs=0.1)
    assert set(fitted.predict(X, U)) == {0, 1}


def test_perceptrons_and_other_settings() -> None:
    X, U = two_options()
    settings = {**QUICK, "hierarchy.levels.0.policy.hidden": [4], "compare_with": ["mixture"]}
    settings |= {"demonstrations.valid_fraction": 0.2}
    own = {"policy": "mlp", "differences": False, "random_state": None, "settings": settings}
    model = OptionSegmenter(2, **own).fit(X, U)
    assert model.fit_.spec.hierarchy.levels[0].policy.hidden == (4,)
    assert set(model.fit_.baselines) == {"mixture"}
    assert model.fit_.metrics.demonstrations.valid == 1


def of_no_state(model: Any, X: Any, U: Any) -> None:
    model.set_params(random_state="x").fit(X, U)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda model, X, U: model.predict(X), "fitted with controls U; give U"),
        (lambda model, X, U: model.predict(X[0], U[0][:5]), "X has 16 steps, and U has 5"),
        (lambda model, X, U: model.predict(X, U, [16] * 5), "leave lengths out"),
        (lambda model, X, U: model.set_params(settings={"training.epoch": 3}).fit(X, U), "training.epochs"),
        (lambda model, X, U: model.set_params(n_options=2.5).fit(X, U), "^n_options: must be a whole number"),
        (of_no_state, "^random_state='x': has to be a whole"),
        (lambda model, X, U: model.predict([np.hstack([x, x]) for x in X], U), "X has 4 features, but"),
        (lambda model, X, U: model.score(X, [np.hstack([u, u]) for u in U]), r"actions has shape \(4,\)"),
        (lambda model, X, U: model.predict_proba(X, [np.nan * u for u in U]), "U contains NaN"),
        (lambda model, X, U: model.predict("demos.hdf5", U), "lists of sequences"),
        (lambda model, X, U: model.predict(X[0], U[0], [8.5, 7.5]), "whole numbers"),
    ],
)
def test_wrong_arrays_are_refused_in_a_line(ask: Any, says: str, fitted: OptionSegmenter) -> None:
    before = fitted.get_params()
    with pytest.raises(BadInput, match=says) as refused:
        ask(fitted, *two_options())
    fitted.set_params(**before)
    assert "\n" not in str(refused.value)


def listed(values: Any, make: Any) -> list[Any]:
    return [make(each) for each in values]


KINDS = {
    "a 3-D array": lambda _, X, U: (np.array(X), np.array(U)),
    "pandas": lambda pd, X, U: (
        listed(X, lambda x: pd.DataFrame(x, index=range(9, 25))),
        listed(U, pd.DataFrame),
    ),
    "a polars frame, lengths in a series": lambda pl, X, U: (
        pl.DataFrame(np.concatenate(X)),
        pl.DataFrame(np.concatenate(U)),
        pl.Series([16] * 5),
    ),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:X (has|does not have) (valid )?feature names")
def test_the_data_that_people_hold_are_taken(kind: str, fitted: OptionSegmenter) -> None:
    package = "polars" if "polars" in kind else "pandas" if "frame" in kind or "pandas" in kind else "numpy"
    given = KINDS[kind](pytest.importorskip(package), *two_options())
    assert fitted.score(*given) == pytest.approx(fitted.score(*two_options()))
    given = KINDS[kind](pytest.importorskip(package), *two_options())
    again = OptionSegmenter(np.int64(2), random_state=np.int64(3), settings=ONE_START).fit(*given)
    np.testing.assert_array_equal(again.predict(*two_options()), fitted.predict(*two_options()))


def test_the_columns_of_a_frame_have_to_be_those_of_the_fit() -> None:
    pandas = pytest.importorskip("pandas")
    X, U = (listed(each, lambda rows: pandas.DataFrame(rows, columns=["a", "b"])) for each in two_options())
    model = OptionSegmenter(2, settings=QUICK).fit(X, U)
    assert model.feature_names_in_.tolist() == ["a", "b"]
    with pytest.raises(BadInput, match="feature names should match"):
        model.predict(listed(X, lambda rows: rows[["b", "a"]]), U)
    with pytest.raises(BadInput, match="U has the columns b, a; the fit had a, b"):
        model.predict(X, listed(U, lambda rows: rows[["b", "a"]]))


# --- hmmlearn -----------------------------------------------------------------------------------------------


def test_without_controls_it_is_a_hidden_markov_model() -> None:
    """hmmlearn with the fitted parameters gives the same likelihood, posterior and decoded probability."""
    lengths = [150, 90, 60]
    X = np.concatenate([hidden_markov_model().sample(n, random_state=n)[0] for n in lengths])
    ours = OptionSegmenter(3, control="gaussian").fit(X, lengths)
    theirs = GaussianHMM(3, "diag")
    (piece,) = ours.fit_.infer(ours.fit_.demonstrations[:1])
    emission, scaling = piece.outputs.emissions[0], ours.fit_.hierarchy.scaling
    theirs.startprob_, theirs.transmat_ = ours.startprob_, ours.transmat_
    theirs.means_ = scaling.emitted(emission.mode[0, 0]).numpy()
    theirs.covars_ = (emission.std.detach().numpy() * X.std(0)) ** 2
    assert ours.score(X, lengths) == pytest.approx(theirs.score(X, lengths), abs=2e-3)
    np.testing.assert_allclose(ours.predict_proba(X, lengths), theirs.predict_proba(X, lengths), atol=1e-4)
    value, states = ours.decode(X, lengths)
    best, best_states = theirs.decode(X, lengths)
    assert (states == best_states).mean() > 0.98  # ours are the most likely together with terminations
    assert best - 1.0 < value < best + 2e-3
    np.testing.assert_array_equal(ours.predict(X, lengths), states)


def test_it_fits_a_hidden_markov_model_as_well_as_hmmlearn() -> None:
    """Held out, in nats per step; the truth is within the family of both."""
    truth = hidden_markov_model()
    X, held_out = (truth.sample(n, random_state=n)[0] for n in (900, 600))
    ours = OptionSegmenter(3, control="gaussian").fit(X)
    theirs = GaussianHMM(3, "diag", n_iter=200, random_state=0).fit(X)
    values = [model.score(held_out) / len(held_out) for model in (ours, theirs, truth)]
    assert values[0] > max(values[1:]) - 0.03
    drawn, states = ours.sample(1000, random_state=0)
    assert drawn.shape == (1000, 2)
    order = np.argsort(ours.startprob_)
    shares = np.bincount(states, minlength=3) / 1000
    long_run = np.linalg.matrix_power(ours.transmat_, 500)[0]
    np.testing.assert_allclose(shares[order], long_run[order], atol=0.1)


# --- scikit-learn -------------------------------------------------------------------------------------------


def test_sequences_are_the_samples_of_model_selection() -> None:
    X, U = two_options(6)
    scores = cross_val_score(OptionSegmenter(2, settings=QUICK), X, U, cv=3)
    model = OptionSegmenter(2, settings=QUICK).fit(X[2:], U[2:])
    assert scores[0] == pytest.approx(model.score(X[:2], U[:2]), rel=1e-6)
    found = GridSearchCV(OptionSegmenter(settings=QUICK), {"n_options": np.arange(1, 3)}, cv=2).fit(X, U)
    assert found.best_params_ == {"n_options": 2}


class RowsAlone(OptionSegmenter):
    """Without controls; scikit-learn's checks pass labels of rows as the second argument, ignored here."""

    def fit(self, X: Any, y: Any = None) -> RowsAlone:
        super().fit(X)
        return self

    def score(self, X: Any, y: Any = None) -> float:
        return super().score(X)


NOT_OF_SEQUENCES = {
    "check_methods_sample_order_invariance": "rows are steps: their order matters",
    "check_methods_subset_invariance": "rows are steps: a step's posterior depends on the other steps",
}


@parametrize_with_checks(
    [RowsAlone(2, settings={**QUICK, "training.epochs": 2})],
    expected_failed_checks=lambda _: NOT_OF_SEQUENCES,
)
def test_the_checks_of_scikit_learn(estimator: Any, check: Any) -> None:
    check(estimator)
