"""Expectation-maximisation: closed forms, stationary points of the penalised likelihood, rising steps."""

import numpy as np
import pytest
import torch
import yaml
from linear import (
    ACTIONS,
    CLIPPED,
    CONSTANT,
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
from planted import LINEAR, make_spec, make_trainer, small_spec
from random_demonstrations import demonstrations, numbered
from scipy import optimize, stats
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.data.controls import ControlPart
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.evaluation import verdicts
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.emissions import KINDS
from ddco_pyro.model.outputs import bounded
from ddco_pyro.spec import RidgeSpec, parse_spec, with_overrides
from ddco_pyro.training.em import Expectation
from ddco_pyro.training.initialization import Moments, cross_validated, left_out_likelihood
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.optimizers import is_linear
from ddco_pyro.training.restarts import Trainer


def expectation(model, ridge, batch, trained=EVERYTHING, discovering=None):
    made = Expectation(model, trained, score, ridge, discovering)
    values = []
    for _ in range(400):
        made.step(batch)
        values.append(made.value)
        if len(values) > 5 and values[-1] - values[-3] < 1e-9 * abs(values[-1]):
            break
    return made, values


def penalised(model, batch, ridge, discovering=None):
    """log p(ξ) and the log-prior of the ridges, by the formulas, differentiable in the model's parameters."""
    value = log_likelihood(model(batch.inputs, discovering).tables(batch.actions), batch.lengths).sum()
    for name, parameter in model.named_parameters():
        if not name.endswith("weight") or (discovering and name.startswith("meta_policy")):
            continue
        if "termination" in name:
            value = value - 0.5 * ridge.gate * parameter.square().sum()
            continue
        caller = model.get_submodule(name.split(".network.")[0])
        logits, std, power = caller.sizes[0], caller.std, float(model.power)
        value = value - 0.5 * ridge.gate * parameter[..., :logits].square().sum()
        at, place = logits, 0
        for part in model.scaling.parts if std is not None else ():
            if part.exact or not part.continuous:
                last = at + (1 if part.exact else KINDS[part.kind].size(part))
                value = value - power * 0.5 * ridge.policy * parameter[..., at:last].square().sum()
                at = last
            for _ in part.dims if part.continuous else ():
                if place in std.of_state:
                    value = value - power * 0.5 * ridge.policy * parameter[..., at].square().sum()
                else:
                    sigma = std().expand(parameter.shape[0], -1)[:, place]
                    square = parameter[..., at].square().sum(1)
                    value = value - power * (0.5 * ridge.policy * square / sigma.square()).sum()
                    if place in (*std.own, *std.shared):
                        value = value - power * parameter.shape[1] * sigma.log().sum()
                at, place = at + 1, place + 1
        if std is not None and std.of_state:
            value = value - power * 0.5 * ridge.policy * parameter[..., -len(std.of_state) :].square().sum()
    return value


CASES = {
    "flat": ((), None, {}),
    "options, sigma given": ((3,), None, {}),
    "sigma of all options": ((3,), None, {"std": LEARNED}),
    "sigma of each option": ((2,), None, {"std": {**LEARNED, "per_option": True}}),
    "sigma of the state": ((2,), None, {"std": {**LEARNED, "per_state": True}}),
    "discrete actions": ((2,), ACTIONS, {"std": LEARNED}),
    "a hurdle": ((2,), HURDLE, {"std": {**LEARNED, "per_option": True}}),
    "heavy tails": ((2,), STUDENT, {"std": {**LEARNED, "per_option": True}, "kind": "student"}),
    "two levels": ((3, 2), CLIPPED, {"std": LEARNED}),
    "hybrid, two levels": ((2, 2), None, {"std": LEARNED, "emits": ("options", "control")}),
    "mixture": ((3,), None, {"std": {**LEARNED, "per_option": True}, "memoryless": (1,)}),
    "a power": ((3,), CLIPPED, {"std": {**LEARNED, "per_option": True}, "power": 0.3}),
    "a power, two levels": ((2, 2), MIXED, {"std": LEARNED, "power": 0.5}),
    "a hidden Markov model": ((3,), None, {"std": LEARNED, "above": CONSTANT}),
    "one constant control": ((), None, {"std": LEARNED, "lowest": CONSTANT}),
}


@pytest.mark.parametrize("case", CASES)
def test_steps_never_lower_the_penalised_likelihood_and_end_where_its_gradient_is_zero(case):
    """Checked by autograd on the networks in float64, and by the formula of the prior."""
    counts, parts, others = CASES[case]
    model, ridge = linear(counts, parts, **others).double(), RidgeSpec(policy=2.0, gate=1.5)
    batch = batch_for(parts)
    assert is_linear(model)
    made, values = expectation(model, ridge, batch)
    assert np.diff(values).min() > -1e-9 * abs(values[-1])
    assert values[-1] > values[0] + 1
    value = penalised(model, in_double(batch), ridge)
    # a constant has no weights
    learned = [(name, one) for name, one in model.named_parameters() if one.numel()]
    free = [(name, one) for name, one in learned if "raw" not in name or not _at_floor(model, name)]
    gradients = torch.autograd.grad(value, [one for _, one in free])
    for (name, _), gradient in zip(free, gradients, strict=True):
        assert gradient.abs().max() < 2e-2, name
    assert float(value.detach()) == pytest.approx(made.value, abs=0.1)  # of the weights before the last step


def baum_welch(weights, start, ends):
    """Initial and later choices and ends of an HMM, as numpy's forward-backward expects them, with [T, K].

    An option that ends may be selected again: A = diag(1 - ψ) + ψ η^T; η is also that of the first.
    """
    stay, switch = np.diag(1 - ends), np.outer(ends, start)
    selected, ended, active, total = np.zeros_like(start), np.zeros_like(ends), np.zeros_like(ends), 0.0
    for densities in weights:
        scale = densities.max(1, keepdims=True)
        b = np.exp(densities - scale)
        forward, backward = [start * b[0]], [np.ones(len(start))]
        for t in range(1, len(b)):
            forward.append(forward[-1] @ (stay + switch) * b[t])
            backward.insert(0, (stay + switch) @ (b[-t] * backward[0]))
        evidence = forward[-1].sum()
        total += np.log(evidence) + scale.sum()
        selected += forward[0] * backward[0] / evidence
        for t in range(1, len(b)):
            joint = forward[t - 1][:, None] * switch * (b[t] * backward[t]) / evidence
            selected, ended = selected + joint.sum(0), ended + joint.sum(1)
            active += forward[t - 1] * backward[t - 1] / evidence
    return total, selected / selected.sum(), ended / active


def test_constant_gates_and_terminations_are_the_hidden_markov_model_that_baum_welch_fits():
    """Beside policies that read; by numpy: the likelihood, and, at its maximum, Baum-Welch's fixed point."""
    model, batch = linear((3,), above=CONSTANT, std=LEARNED).double(), batch_for(None, 20, 12)
    periods = torch.tensor([5, 3, 2]).repeat(7)[:20, None]
    skills = (torch.arange(12) + torch.arange(20)[:, None]) // periods % 3
    batch = Batch(batch.inputs, batch.actions + skills[..., None], batch.lengths)
    expectation(model, RidgeSpec(gate=7.0), batch)  # ridges are of weights: constants have none
    (policy,), gate = model.option_levels(), model.meta_policy.network.layers[0].bias[0, 0].detach()
    start, ends = (
        gate.softmax(0).numpy(),
        bounded(policy.termination.layers[0].bias[:, 0, 0].detach()).sigmoid().numpy(),
    )
    layer, std = policy.policy.network.layers[0], policy.policy.std().detach().numpy()
    x, actions = batch.inputs.vectors["state"].double(), batch.actions.double().numpy()
    means = (torch.einsum("ntf,kfa->ntka", x, layer.weight.double()) + layer.bias[:, 0]).detach().numpy()
    densities = stats.norm.logpdf(actions[:, :, None], means, std).sum(-1)
    total, selected, ended = baum_welch(
        [own[:length] for own, length in zip(densities, batch.lengths, strict=True)], start, ends
    )
    with torch.no_grad():
        own = log_likelihood(model.tabulate(in_double(batch)), batch.lengths).sum()
    assert float(own) == pytest.approx(total, abs=1e-6)
    np.testing.assert_allclose(start, selected, atol=2e-3)
    np.testing.assert_allclose(ends, ended, atol=2e-3)
    assert ends.min() < 0.7  # options last


@pytest.mark.parametrize("discovering", [1, 2])
def test_levels_are_discovered_under_a_uniform_meta_policy(discovering):
    """All weights of the levels end where the gradient is zero, those that select among options too."""
    model, ridge, batch = linear((2, 2), std=LEARNED).double(), RidgeSpec(), batch_for(None)
    expectation(model, ridge, batch, ("levels.",), discovering)
    levels = tuple(f"levels.{level}." for level in range(discovering))
    there = [(name, one) for name, one in model.named_parameters() if name.startswith(levels)]
    assert len(there) == 5 * discovering - (discovering == 2)  # the second level has no σ
    value = penalised(model, in_double(batch), ridge, discovering)
    gradients = torch.autograd.grad(value, [one for _, one in there])
    for (name, _), gradient in zip(there, gradients, strict=True):
        assert gradient.abs().max() < 2e-2, name


def _at_floor(model, name):
    caller = model.get_submodule(name.rsplit(".std.", 1)[0])
    return bool((caller.std() < caller.std.floor + 2e-4).any())


def rows_of(batch):
    alive = batch.inputs.time < batch.lengths[:, None]
    return batch.inputs.vectors["state"][alive].double().numpy(), batch.actions[alive].double().numpy()


def heavy(freedom, size, random):
    """Demonstrations of three linear skills whose errors have heavy tails, with the skill of each step."""
    gains, demos, skills = random.normal(size=(3, 4, 3)), [], []
    for number in range(size):
        state, skill = random.normal(size=(40, 4)), np.repeat(random.permutation(4) % 3, 10)
        errors = 0.3 * stats.multivariate_t(df=freedom, shape=np.eye(3)).rvs(40, random_state=random)
        actions = np.einsum("tf,tfa->ta", state, gains[skill]) + errors
        demos.append(Demonstration(f"demo_{number}", {"state": state}, actions))
        skills.append(skill)
    return Demonstrations(tuple(demos)), np.concatenate(skills)


def test_options_under_heavy_tails_are_recovered():
    """A Gaussian spends options on outliers."""
    demos, skills = heavy(1.5, 12, np.random.default_rng(0))
    agreement = {}
    for kind in ("gaussian", "student"):
        control = {"kind": kind, "std": {**LEARNED, "per_option": True}}
        spec = make_spec((3,), control=control, starts=["vq_controls"], optimizer={"name": "em"}, epochs=150)
        fit = ddco_pyro.fit(with_overrides(spec, {"demonstrations.valid_fraction": 0.0}), demos)
        batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
        (found,) = segment(fit.hierarchy.tabulate(batch), batch.lengths)
        agreement[kind] = normalized_mutual_info_score(skills, found.flatten())
    assert agreement["student"] > 0.9
    assert agreement["gaussian"] < agreement["student"] - 0.05


def test_a_flat_clipped_policy_is_the_censored_regression_that_scipy_finds():
    """The Tobit model's likelihood is maximised by BFGS from other weights."""
    model, batch = linear((), CLIPPED, std=LEARNED), batch_for(CLIPPED)
    expectation(model, RidgeSpec(policy=0, gate=0), batch)
    x, a = rows_of(batch)
    with_one = np.hstack([x, np.ones((len(x), 1))])
    layer = model.meta_policy.network.layers[0]
    for dim in range(2):
        low, high = CLIPPED[0].low[dim], CLIPPED[0].high[dim]

        def loss(values, dim=dim, low=low, high=high):
            mean, sigma = with_one @ values[:-1], np.exp(values[-1])
            each = stats.norm.logpdf(a[:, dim], mean, sigma)
            each = np.where(a[:, dim] <= np.float32(low), stats.norm.logcdf(low, mean, sigma), each)
            return -np.where(a[:, dim] >= np.float32(high), stats.norm.logsf(high, mean, sigma), each).sum()

        best = optimize.minimize(loss, np.zeros(5)).x
        np.testing.assert_allclose(layer.weight[0, :, dim].detach(), best[:3], atol=2e-4)
        np.testing.assert_allclose(model.meta_policy.std()[dim].detach(), np.exp(best[-1]), rtol=1e-3)


def test_a_flat_switch_is_the_logistic_regression_of_scikit_learn():
    parts = (ControlPart("jaw", (0,), "binary", (0.0,), (1.0,)), ControlPart("b", (1,), "gaussian"))
    model, batch = linear((), parts), batch_for(parts)
    expectation(model, RidgeSpec(policy=2.0), batch)
    x, a = rows_of(batch)
    truth = LogisticRegression(C=0.5, tol=1e-10, max_iter=1000).fit(x, a[:, 0])
    layer = model.meta_policy.network.layers[0]
    np.testing.assert_allclose(layer.weight[0, :, 0].detach(), truth.coef_[0], atol=1e-4)
    np.testing.assert_allclose(layer.bias[0, 0, 0].detach(), truth.intercept_[0], atol=1e-4)


def test_a_dead_option_keeps_finite_weights():
    """No step belongs to the second option: its evidence forbids it."""
    model, batch = linear((2,), std={**LEARNED, "per_option": True}), batch_for(None)

    def score(tables, piece, rows):
        first = torch.ones(piece.inputs.batch, dtype=torch.long)
        return log_likelihood(tables.clamp(1, first), piece.lengths).sum()

    made = Expectation(model, EVERYTHING, score, RidgeSpec())
    for _ in range(20):
        made.step(batch)
    assert all(bool(torch.isfinite(one).all()) for one in model.parameters())


def em_spec(**training):
    return small_spec(
        demonstrations={"path": "unused.hdf5", "valid_fraction": 0.2},
        observations=["pose"],
        control={"std": {**LEARNED, "per_option": True}},
        compare_with=["mixture", {"kind": "flat", "policy": {"network": "mlp", "hidden": [4]}}],
        training={"optimizer": {"name": "em"}, "epochs": 60, **training},
    )


def test_a_fit_by_em_says_so_and_trains_what_is_not_linear_by_gradients():
    fit = ddco_pyro.fit(em_spec(), demonstrations(12))
    trained = fit.metrics.trainings
    by_em = {name: one.by_em for name, one in trained.items()}
    assert by_em == {"ddco": True, "mixture": True, "flat": False}
    assert trained["ddco"].spent.gradient_steps == trained["ddco"].spent.epochs
    by_lbfgs = {name: one.by_lbfgs for name, one in trained.items()}
    assert by_lbfgs == {"ddco": False, "mixture": False, "flat": True}
    assert trained["flat"].spent.gradient_steps == trained["flat"].spent.epochs
    assert "(EM)" in verdicts.effort(trained["ddco"])
    assert "(L-BFGS)" in verdicts.effort(trained["flat"])


def test_a_flat_policy_for_each_time_step_is_least_squares_at_that_step():
    demos = demonstrations(40)
    training = {"optimizer": {"name": "em"}, "tune_fraction": 0.1, "patience": 300, "epochs": 300}
    policy = {"kind": "per_timestep", "policy": {"network": "mlp", "hidden": []}}
    spec = small_spec((), observations=["pose"], control={"std": 1.0}, baseline=policy, training=training)
    trainer = make_trainer(spec, demos, None)
    trainer.run()
    batch, units = trainer.data.train, trainer.data.hierarchy(0).scaling.scale.log().sum()
    assert trainer.summary["by_lbfgs"]
    last = trainer.history[-1]["train"]
    residual = 0.0
    for t in range(int(batch.lengths.max())):
        rows = batch.lengths > t
        x = np.column_stack([batch.inputs.vector[rows, t].double(), np.ones(int(rows.sum()))])
        a = batch.actions[rows, t].double().numpy()
        residual += float(np.square(a - x @ np.linalg.lstsq(x, a, rcond=None)[0]).sum())
    dims = batch.actions.shape[-1]
    truth = -0.5 * residual / batch.steps - 0.5 * dims * np.log(2 * np.pi) - float(units)
    assert last == pytest.approx(truth, abs=1e-6)


MLP = {"network": "mlp", "hidden": [4]}
LEVEL = {"count": 2, "policy": LINEAR}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("em", {}),
        ("em", {"hierarchy": {"levels": [LEVEL | {"termination": CONSTANT}], "meta_policy": CONSTANT}}),
        ("em", {"hierarchy": None, "baseline": {"kind": "flat", "policy": LINEAR}}),
        ("em", {"training.optimizer.ridge.policy": 2}),
        ("em", {"training.optimizer.name": "em", "hierarchy.meta_policy": MLP}),
        ("adam", {"hierarchy": None, "baseline": {"kind": "per_timestep", "policy": LINEAR}}),
        *(("adam", {f"training.{key}": value}) for key, value in (("optimizer.lr", 0.1), ("average", 0.9))),
        ("adam", {"training.optimizer.name": "adam"}),
        *(("adam", {f"hierarchy.{key}": MLP}) for key in ("trunk", "meta_policy")),
        ("adam", {"hierarchy.levels.0.termination": MLP}),
    ],
)
def test_linear_networks_are_trained_by_em_unless_the_spec_asks_for_gradient_steps(name, changes):
    data = {"task": "toy", "observations": ["state"], "hierarchy": {"levels": [LEVEL], "meta_policy": LINEAR}}
    assert parse_spec(data, changes).training.optimizer.name == name


def test_tuning_demonstrations_decide_nothing_before_the_last_stage():
    """One tuning demonstration likes the beginning of a stage better than its end, where few train; segments
    then get lost.
    """
    spec, demos = em_spec(starts=["vq_controls"], epochs=None, patience=3), demonstrations(9)
    train_with, histories = demos.select(demos.names[:6]), []
    for tuned_by in demos.names[6:]:
        trainer = Trainer(spec, Dimensions.of(train_with), train_with, demos.select([tuned_by]))
        trainer.run()
        restart = trainer.restarts[0]
        histories.append([row for row in restart.progress.history if row["stage"] != "joint"])
        assert all(end["rising"] == 0 for end in restart.progress.ended[:-1])  # EM has converged
    without_tuning = [[{**row, "tune": 0} for row in history] for history in histories]
    assert without_tuning[0] == without_tuning[1] == without_tuning[2]


def bimanual(number=20, steps=60, seed=0):
    """Fourteen joint positions of two arms, through six poses that vary by demonstration, as objects do."""
    random = np.random.default_rng(seed)
    poses, rows = 0.5 * random.normal(size=(6, 14)), []
    for _ in range(number):
        own = poses + 0.1 * random.normal(size=poses.shape)
        times = np.r_[0, np.sort(random.choice(np.arange(5, steps - 5), 4, replace=False)), steps - 1]
        path = np.stack([np.interp(np.arange(steps), times, joint) for joint in own.T], axis=1)
        commands, place = path + 0.002 * random.normal(size=path.shape), np.zeros((steps, 14))
        place[0] = path[0]
        for step in range(1, steps):
            place[step] = (place[step - 1] + commands[step - 1]) / 2
        effort = 5 * (commands - place) + 0.05 * random.normal(size=place.shape)
        objects = own[2:4, :6].ravel() + 0.001 * random.normal(size=(steps, 12))
        rows.append(({"place": place, "effort": effort, "objects": objects}, commands))
    return numbered(rows)


def test_ridges_are_raised_where_demonstrations_are_few_for_their_observations(tmp_path):
    """As ``init`` writes it, a fit to two arms is far better held out; with many it is the same.

    By the spec's own ridge the same fit falls apart, and says so.
    """

    def fitted(demos, *overrides):
        path = tmp_path / f"{len(demos)}.hdf5"
        demos.write(path)
        spec = parse_spec(yaml.safe_load(starting_spec(inspect(path), path).text))
        short = {"compare_with": [], "training.epochs": 16, "training.starts": ["vq_controls"]}
        return ddco_pyro.fit(with_overrides(spec, short | dict(overrides))).metrics

    fallen = fitted(bimanual(20), ("training.optimizer.ridge.cross_validated", False))
    held, many = fitted(bimanual(20)), fitted(pick_and_place(30))
    assert fallen.training.raised_ridge is many.training.raised_ridge is None
    assert verdicts.verdict(fallen).startswith("Options fell apart")
    assert held.training.raised_ridge >= 30
    assert f"ridge {held.training.raised_ridge:g}" in verdicts.effort(held.training)
    assert held.log_likelihood_per_step.valid > fallen.log_likelihood_per_step.valid + 50


def test_left_out_controls_are_as_likely_as_by_another_library_s_regressions():
    random = np.random.default_rng(0)
    x, weight = random.normal(size=(90, 4)), random.normal(size=(4, 2))
    a = x @ weight + 0.3 + 0.1 * random.normal(size=(90, 2))
    rows, ridges = torch.tensor(np.c_[x, np.ones(90)]), torch.tensor([0.5, 20.0], dtype=torch.float64)
    known, left_out = (Moments.of(rows[its], torch.tensor(a)[its]) for its in (slice(60), slice(60, None)))
    for found, ridge in zip(left_out_likelihood(known, left_out, ridges), ridges.tolist(), strict=True):
        fitted = Ridge(ridge).fit(x[:60], a[:60])
        squares = ((a[:60] - fitted.predict(x[:60])) ** 2).sum(0) + ridge * (fitted.coef_**2).sum(1)
        normal = stats.norm(fitted.predict(x[60:]), np.sqrt(squares / (60 + 4)))
        truth = normal.logpdf(a[60:]).sum() + 30 * 2 * 0.5 * np.log(2 * np.pi)
        assert float(found) == pytest.approx(truth, rel=1e-6)


@pytest.mark.parametrize(
    ("number", "parts", "ridge"), [(1, None, 2.0), (6, None, 0.0), (6, ACTIONS[:1], 2.0)]
)
def test_a_ridge_stays_where_nothing_can_be_left_out(number, parts, ridge):
    """Of a single demonstration, without a ridge, and where no control is continuous."""
    model, batch = linear((2,), parts), batch_for(parts)
    assert cross_validated(model, batch.select(torch.arange(number)), ridge, 0) == ridge
