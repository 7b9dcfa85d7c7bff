"""The prior that a library is: closed forms, EM against the Pyro program, a task from one demonstration."""

import copy
from functools import partial

import numpy as np
import pyro
import pytest
import torch
from hierarchies import make_batch
from linear import (
    ACTIONS,
    CLIPPED,
    EVERYTHING,
    HURDLE,
    LEARNED,
    MIXED,
    STUDENT,
    batch_for,
    in_double,
    linear,
    score,
)
from planted import CONTROL, in_units_of, make_spec, make_truth, per_step, plant, small_spec, tabulated

from ddco_pyro.inference.marginal import bayesian_ahmm
from ddco_pyro.model.batch import Batch
from ddco_pyro.spec import RidgeSpec, with_overrides
from ddco_pyro.training.em import Expectation
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.objective import TrainingError
from ddco_pyro.training.prior import Prior
from ddco_pyro.training.restarts import Trainer, train_model


def moved(model, seed):
    """A copy with other weights."""
    torch.manual_seed(seed)
    other = copy.deepcopy(model)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return other


def converged(expectation, batch):
    while not expectation.converged:
        expectation.step(batch)


@pytest.mark.parametrize("per_option", [False, True])
def test_a_linear_policy_ends_at_ridge_regression_centred_at_the_library(per_option):
    """W = (X'X + ρI)^-1 (X'A + ρ W0), and σ² = (|A - XW|² + ρ|W - W0|² + c s²) / (N + F + c)."""
    model = linear((), std=LEARNED | {"per_option": per_option})
    library = moved(model, 1)
    batch = make_batch(6, 9)
    converged(Expectation(model, EVERYTHING, score, RidgeSpec(), prior=Prior(library, 30.0, 20.0)), batch)
    alive = torch.arange(9) < batch.lengths[:, None]
    states = batch.inputs.vectors["state"][alive].numpy()
    x = np.column_stack([states, np.ones(int(alive.sum()))]).astype(float)
    actions = batch.actions[alive].double().numpy()
    (layer,), (center,) = (one.meta_policy.network.layers for one in (model, library))
    w0 = torch.cat([center.weight, center.bias], 1)[0].detach().double().numpy()
    w = np.linalg.solve(x.T @ x + 30 * np.eye(4), x.T @ actions + 30 * w0)
    known = library.meta_policy.std.table().detach().double().numpy().reshape(-1)
    squares = ((actions - x @ w) ** 2).sum(0) + 30 * ((w - w0) ** 2).sum(0) + 20 * known**2
    found = torch.cat([layer.weight, layer.bias], 1)[0].detach().numpy()
    assert found == pytest.approx(w, abs=1e-5)
    std = model.meta_policy.std.table().detach().numpy().reshape(-1)
    assert std == pytest.approx(np.sqrt(squares / (len(x) + 4 + 20)), abs=1e-5)


def test_without_a_prior_of_sigma_it_collapses():
    """A library that says exactly what was done makes residuals of 0, which a centred ridge counts."""
    library = linear((), std=LEARNED)
    batch = make_batch(3, 9)
    with torch.no_grad():
        numbers, _ = library.meta_policy.network(batch.inputs)
    batch = Batch(batch.inputs, numbers[:, :, 0], batch.lengths)
    found = {}
    for spread in (1e-9, 20.0):
        model = copy.deepcopy(library)
        known = Prior(library, 1000.0, spread)
        converged(Expectation(model, EVERYTHING, score, RidgeSpec(), prior=known), batch)
        found[spread] = float(model.meta_policy.std.table().detach().max())
    assert found[1e-9] < 0.02  # the floor is 0.01
    assert found[20.0] > 0.2


KINDS = {"gaussian": None, "clipped": CLIPPED, "mixed": MIXED, "actions": ACTIONS}
KINDS |= {"student": STUDENT, "hurdle": HURDLE}


STDS = [((2, 3), LEARNED), ((2,), LEARNED | {"per_option": True}), ((), LEARNED | {"per_state": True})]


@pytest.mark.parametrize("parts", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize(("counts", "std"), STDS)
def test_em_has_the_prior_of_the_program(parts, std, counts):
    """Differences between two models: densities have constants of their own."""
    model = linear(counts, parts, emits=("options", "control"), std=std, power=0.5)
    prior, batch = Prior(moved(model, 1), 30.0, 20.0), batch_for(parts)
    both = moved(model, 2), moved(model, 3)
    by_em = [Expectation(one, EVERYTHING, score, RidgeSpec(), prior=prior).log_prior(batch) for one in both]
    by_program = [float(prior.log_density(one).detach()) for one in both]
    assert by_em[1] - by_em[0] == pytest.approx(by_program[1] - by_program[0], abs=1e-8)


def test_the_program_with_likelihood_has_em_s_objective():
    """The joint density of `bayesian_ahmm` at two models' parameters, against what EM maximises."""
    model = linear((2,), std=LEARNED | {"per_option": True})
    prior, batch = Prior(moved(model, 1), 30.0, 20.0), in_double(make_batch(3, 5))
    drawn, objectives, densities = model.double(), [], []
    for seed in (2, 3):
        other = moved(model, seed)
        whole = Expectation(moved(model, seed), EVERYTHING, score, RidgeSpec(), prior=prior)
        whole.step(batch)
        objectives.append(whole.value)  # of the parameters that the step began at
        values = {}
        prior._sites(other, lambda name, _, value, __, known=values: known.setdefault(name, value.detach()))
        program = pyro.condition(partial(bayesian_ahmm, drawn, partial(prior.program, drawn)), values)
        densities.append(float(pyro.poutine.trace(program).get_trace(batch).log_prob_sum()))
    assert densities[1] - densities[0] == pytest.approx(objectives[1] - objectives[0], rel=1e-6)


def planted(**training):
    """A library's truth of four corners, and a new task whose two first corners lie nearer."""
    by_em = {"training.optimizer": {"name": "em"}, **training}
    spec = with_overrides(make_spec((4,), control=CONTROL), by_em)
    library, new = make_truth(spec), make_truth(spec)
    with torch.no_grad():
        new.levels[0].policy.network.layers[0].bias[:2] *= 0.7
    return spec, library, new


def test_a_new_task_is_learned_from_one_demonstration():
    """Held-out nats per step: nearer to the truth's than to those of the library, and those from scratch."""
    spec, library, truth = planted()
    first, _ = plant(truth, 1, 60, seed=5)
    held_out, _ = plant(truth, 40, 30, seed=2)
    spec = with_overrides(spec, {"training.tune_fraction": 0})
    size = Dimensions.of(first)
    drawn = with_overrides(spec, {"training.library": {"run": "known", "ridge": 3}})
    prior = Prior(library, 3.0, 20.0)
    adapted = train_model(drawn, size.like(library, "known"), first, library=prior).hierarchy
    scratch = train_model(in_units_of(spec, first), size, first).hierarchy
    models = {"truth": truth, "library": library, "adapted": adapted, "scratch": scratch}
    value = {name: per_step(one, tabulated(one, held_out)[1]) for name, one in models.items()}
    assert value["adapted"] > value["truth"] - 0.5
    assert value["adapted"] > max(value["library"], value["scratch"]) + 0.5


def test_a_ridge_of_0_leaves_the_weights_alone():
    """They begin by `starts`; encoder, scaling and the prior of σ are the library's."""
    spec, library, truth = planted()
    demos, _ = plant(truth, 4, 30, seed=1)
    known = {"run": "known", "ridge": 0, "spread": 5}
    spec = with_overrides(spec, {"training.library": known, "training.epochs": 20})
    trainer = Trainer(spec, Dimensions.of(demos), demos, demos, library=Prior(library, 0.0, 5.0))
    trainer.check_engines()
    trainer.run()
    assert [restart["start"] for restart in trainer.summary["restarts"]["each"]] == ["vq"]
    assert trainer.hierarchy.encoder.state_dict().keys() == library.encoder.state_dict().keys()
    for name, value in library.encoder.state_dict().items():
        assert torch.equal(trainer.hierarchy.encoder.state_dict()[name], value)


def test_perceptrons_end_where_likelihood_and_prior_balance():
    """A longer search raises their sum no more; without the prior L-BFGS ends far from there."""
    training = {"optimizer": {"name": "em"}, "epochs": 400}
    spec = small_spec((), {"network": "mlp", "hidden": [4]}, training=training)
    changes = {"training.tune_fraction": 0, "control.std": LEARNED, "training.patience": None}
    spec = with_overrides(spec, changes)
    demos, _ = plant(planted()[1], 6, 20, seed=1)
    size = Dimensions.of(demos)
    library = train_model(spec, size, demos).hierarchy
    others, _ = plant(planted()[2], 2, 20, seed=3)
    drawn = with_overrides(spec, {"training.library": {"run": "known", "ridge": 10}})
    prior = Prior(library, 10.0, 20.0)
    model = train_model(drawn, size.like(library, "known"), others, library=prior).hierarchy
    _, batch = tabulated(model, others)
    assert per_step(model, batch) > per_step(library, batch) + 0.05

    def left(weights):
        """What 200 more steps add to the sum from these weights, nats."""
        model.load_state_dict(weights)
        search = torch.optim.LBFGS(model.parameters(), max_iter=200, line_search_fn="strong_wolfe")

        def loss():
            search.zero_grad()
            value = -score(model.tabulate(batch), batch) - prior.log_density(model)
            value.backward()
            return value

        return float(search.step(loss).detach()) - float(loss().detach())

    ended = copy.deepcopy(model.state_dict())
    alone = train_model(spec, size.like(library, "known"), others).hierarchy
    assert left(ended) < 0.01
    assert left(alone.state_dict()) > 1


def test_the_engine_check_covers_the_prior(monkeypatch):
    spec, library, truth = planted()
    demos, _ = plant(truth, 2, 10, seed=1)
    spec = with_overrides(spec, {"training.library": {"run": "known", "ridge": 3}})
    size = Dimensions.of(demos).like(library, "known")
    trainer = Trainer(spec, size, demos, demos, library=Prior(library, 3.0, 20.0))
    trainer.check_engines()
    assert trainer.check.value < 1e-6
    right = Prior.log_density
    monkeypatch.setattr(Prior, "log_density", lambda self, model: 1.01 * right(self, model))
    with pytest.raises(TrainingError, match="the engines disagree"):
        trainer.check_engines()
