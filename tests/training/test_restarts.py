"""Restarts: every way to begin is tried, the likeliest in training is kept, none is below its mixture."""

import numpy as np
import pytest
import torch
import user_networks
from killing import Interrupting
from planted import make_spec, make_trainer, small_spec
from random_demonstrations import numbered, of_states
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.drawing import words
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.verdicts import verdict
from ddco_pyro.events import RestartDiverged, RestartStopped
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.metrics import Training
from ddco_pyro.training import loop as training
from ddco_pyro.training import restarts as restarting
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.objective import TrainingError

QUICK = {"layerwise": False, "epochs": 14, "patience": 5, "optimizer": {"lr": 0.05}}
"""Some restarts of it end by patience, others by their budget."""
EVERY = ["vq", "vq_controls", "windows", "equal_parts", "mixture", "random"]


@pytest.fixture(scope="module")
def demos():
    return of_states([6] * 10)


@pytest.fixture(scope="module")
def spec():
    return make_spec((2,), starts=["random"] * 5, control={"std": 1.0}, **QUICK)


@pytest.fixture(scope="module", autouse=True)
def early():
    """Restarts are compared after three epochs of gradient steps, and stopped where a little behind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(restarting, "BY_GRADIENT", 3)
        patch.setattr(restarting, "BEHIND", 0.01)
        yield


@pytest.fixture(scope="module")
def undisturbed(spec, demos, tmp_path_factory, early):
    """The trainer, its model, and what was told, in one process without interruption."""
    return trained(spec, demos, tmp_path_factory.mktemp("undisturbed"))


def trained(spec, demos, folder):
    told = []
    trainer = make_trainer(spec, demos, folder, told.append)
    return trainer, trainer.run().state_dict(), told, checkpoints(folder)


def checkpoints(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def assert_same(trainer, model, folder, undisturbed):
    expected, state, _, files = undisturbed
    assert (trainer.history, trainer.summary) == (expected.history, expected.summary)
    assert all(torch.equal(model[name], value) for name, value in state.items())
    assert checkpoints(folder) == files


# --- processes, and going on --------------------------------------------------------------------------------


@pytest.mark.slow
def test_two_processes_give_the_same_bits_where_one_had_begun(
    undisturbed, spec, demos, tmp_path, monkeypatch
):
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    interrupted(make_trainer(spec, demos, tmp_path, Interrupting(5 * 3 + 2)))
    trainer = make_trainer(spec, demos, tmp_path, jobs=2)
    assert_same(trainer, trainer.run().state_dict(), tmp_path, undisturbed)


def interrupted(trainer):
    with pytest.raises(KeyboardInterrupt):
        trainer.run()


def test_em_that_is_interrupted_begins_its_restart_again_and_gives_the_same_bits(demos, tmp_path):
    training = {"starts": ["vq", "mixture"], "optimizer": {"name": "em"}, "epochs": 20}
    spec = make_spec((2,), control={"std": 1.0}, **training)
    whole = trained(spec, demos, tmp_path / "whole")
    for epochs in (3, 30):
        folder = tmp_path / str(epochs)
        interrupted(make_trainer(spec, demos, folder, Interrupting(epochs)))
        again = make_trainer(spec, demos, folder)
        assert_same(again, again.run().state_dict(), folder, whole)


# --- which is kept ------------------------------------------------------------------------------------------


class Scripted:
    """Restarts whose objectives were written down: after the first epochs, and at the end; −∞ diverged."""

    def __init__(self, sounded, ends):
        self.sounded, self.ends = sounded, ends

    def __call__(self, data, restart, until, checkpoint=None, on_event=None):
        now = restart.progress
        now.stage, now.epoch = 1, until or 20
        now.sounded = self.sounded[now.restart] if until else now.sounded
        now.done = until is None
        if now.done:
            now.objective, now.best, now.ended = self.ends[now.restart], 0.0, [ENDED]
            now.diverged = "why" if now.objective == -np.inf else None
        restart.states = {} if now.diverged else {"best": data.hierarchy(now.restart).state_dict()}
        return restart


ENDED = {"stage": "joint", "epochs": 20, "cap": None, "rising": 0.0, "over": 1, "converged": True}


@pytest.mark.parametrize("seed", range(4))
def test_those_far_behind_are_stopped_and_the_likeliest_is_kept(demos, tmp_path, monkeypatch, seed):
    random = np.random.default_rng(seed)
    number, margin = int(random.integers(2, 7)), float(random.choice([0.0, 0.02]))
    sounded, ends = random.normal(0, 0.02, (2, number)).round(3)
    monkeypatch.setattr(restarting, "train", Scripted(sounded.tolist(), ends.tolist()))
    told = []
    starts = random.choice(["vq", "vq_controls", "random"], number).tolist()
    trainer = make_trainer(make_spec((2,), starts=starts, margin=margin), demos, tmp_path, told.append)
    model = trainer.run().state_dict()
    size = demos.control_size
    behind = {n for n in range(number) if sounded[n] < sounded.max() - 0.01 * size}
    assert {event.restart for event in told if isinstance(event, RestartStopped)} == behind
    left = [n for n in range(number) if n not in behind]
    expected = max(left, key=lambda n: (ends[n], -n))
    if 0 in left and ends[expected] - ends[0] <= margin:
        expected = 0
    restarts = trainer.summary["restarts"]
    assert restarts["best"] == expected
    assert [each["start"] for each in restarts["each"]] == starts
    objectives = [None if n in behind else ends[n] for n in range(number)]
    assert [each["objective"] for each in restarts["each"]] == objectives
    kept = trainer.data.hierarchy(expected).state_dict()
    assert all(torch.equal(model[name], value) for name, value in kept.items())


def test_the_objective_has_the_ridges_log_prior(demos, tmp_path):
    """Σ log p − ½ ρ Σ w² of gate and termination, and of the mean in units of 1/σ² with its normaliser."""
    ridge = {"policy": 2.0, "gate": 3.0}
    optimizer = {"name": "em", "ridge": ridge}
    spec = make_spec((2,), starts=["vq"], control={"std": 1.0}, optimizer=optimizer, epochs=30)
    trainer = make_trainer(spec, demos, tmp_path)
    model, batch = trainer.run(), trainer.data.train
    (level,) = model.option_levels()
    gates = [("gate", level.termination), ("gate", model.meta_policy.network)]
    networks = [("policy", level.policy.network), *gates]
    lasts = [(name, network.layers[-1]) for name, network in networks]
    squares = [(name, float(last.weight.detach().double().square().sum())) for name, last in lasts]
    biases = 1e-6 * sum(float(last.bias.detach().double().square().sum()) for _, last in lasts)
    value = float(log_likelihood(model.tabulate(batch), batch.lengths).detach().sum())
    value -= 0.5 * (sum(ridge[name] * square for name, square in squares) + biases)
    assert trainer.objective == pytest.approx(value / batch.steps, abs=1e-5)


def test_what_is_told_of_restarts_adds_up(undisturbed):
    trainer, _, told, _ = undisturbed
    restarts = trainer.summary["restarts"]
    epochs = [sum(row["restart"] == number for row in trainer.history) for number in range(5)]
    assert [each["epochs"] for each in restarts["each"]] == epochs
    assert restarts["spent"] == {"epochs": sum(epochs), "gradient_steps": sum(epochs)}  # a single minibatch
    assert trainer.summary["spent"]["epochs"] == epochs[restarts["best"]]
    stopped = {event.restart: event.epochs for event in told if isinstance(event, RestartStopped)}
    assert stopped
    assert {n: each["stopped"] for n, each in enumerate(restarts["each"]) if each["stopped"]} == stopped


def test_segments_of_restarts_are_compared_with_the_best(demos, tmp_path):
    starts = ["random", "equal_parts", "mixture", "random"]
    spec = make_spec((2,), control={"std": 1.0}, starts=starts, **QUICK)
    trainer = make_trainer(spec, demos, tmp_path)
    trainer.run()
    stages = [list(dict.fromkeys(row["stage"] for row in one.progress.history)) for one in trainer.restarts]
    assert stages == [["joint"], ["parts-1", "joint"], ["vq-1", "mixture", "joint"], ["joint"]]
    each = trainer.summary["restarts"]["each"]
    said = verdicts.restarts(Training.model_validate(trainer.summary))
    going = [(n, one) for n, one in enumerate(each) if one["objective"] is not None]
    assert going
    assert all(f"{n} from {starts[n]}: {words.number(one['objective'])}" in said for n, one in going)
    best, batch = trainer.summary["restarts"]["best"], trainer.data.train
    for number, one in enumerate(each):
        models = [trainer.data.hierarchy(n, trainer.restarts[n].states["best"]) for n in (best, number)]
        with torch.no_grad():
            ours, theirs = (segment(model.tabulate(batch), batch.lengths)[0].flatten() for model in models)
        nmi = normalized_mutual_info_score(ours, theirs)
        assert nmi == pytest.approx(1.0 if number == best else one["nmi"])
        assert number == best or f"{words.number(nmi)} of {number}" in said


# --- restarts that diverge ----------------------------------------------------------------------------------


def diverging(passes, **training):
    """Restarts of which those with a positive weight at first have that many passes before they give NaN."""
    policy = {"network": "user_networks:Diverging", "options": {"passes": passes}}
    own = {"starts": ["random"] * 6, "epochs": 12, "patience": None, "tune_fraction": 0.2, **training}
    return small_spec((), policy, control={"std": 1.0}, training=own)


@pytest.mark.parametrize("passes", [1, 4])
def test_a_restart_that_diverges_ends_there_and_is_not_the_best(demos, tmp_path, passes):
    trainer, model, told, _ = trained(diverging(passes), demos, tmp_path)
    ended = [number for number, each in enumerate(trainer.summary["restarts"]["each"]) if each["diverged"]]
    models = (trainer.data.hierarchy(number) for number in range(6))
    starts = [model.meta_policy.network.module.weight[0, 0] > 0 for model in models]
    rows = [sum(row["restart"] == number for row in trainer.history) for number in range(6)]
    assert ended
    assert all(starts[number] and rows[number] == passes for number in ended)
    best = trainer.summary["restarts"]["best"]
    assert best not in ended
    assert all(value.isfinite().all() for value in model.values())
    reasons = {event.restart: event.why for event in told if isinstance(event, RestartDiverged)}
    assert sorted(reasons) == ended
    assert all(f"epoch {passes + 1}: the log-likelihood of demo_" in why for why in reasons.values())
    told = verdicts.restarts(Training.model_validate(trainer.summary))
    assert f"; diverged: {', '.join(map(str, ended))}" in told
    made = training.train(trainer.data, Restart(Progress(best)))
    assert all(torch.equal(model[name], value) for name, value in made.states["best"].items())


def test_where_those_that_are_left_diverge_the_stopped_ones_go_on(demos, tmp_path, monkeypatch):
    monkeypatch.setattr(restarting, "train", Scripted([0.0, -1.0, -2.0], [-np.inf, -1.0, -2.0]))
    trainer = make_trainer(diverging(1, starts=["random"] * 3), demos, tmp_path)
    trainer.run()
    assert trainer.best == 1
    assert not trainer.stopped


@pytest.mark.parametrize("restarts", [1, 3])
def test_where_all_diverge_the_trajectory_is_named(demos, tmp_path, monkeypatch, restarts):
    monkeypatch.setattr(user_networks.Diverging, "forward", _nan_in_training)
    for _ in range(2):  # also where all that is kept is read again
        with pytest.raises(
            TrainingError, match=r"^stage policy, epoch 1: the log-likelihood of demo_\d+.* is not finite"
        ):
            make_trainer(diverging(0, starts=["random"] * restarts), demos, tmp_path).run()


def _nan_in_training(network, inputs):
    found = (inputs.vector @ network.weight).unflatten(-1, network.size)
    return found * torch.nan if network.training else found


# --- the mixture that a hierarchy contains ------------------------------------------------------------------


def memoryless(seed, number=12, steps=30):
    """Controls of one of three laws, drawn at each step by where the state is: a mixture is the truth."""
    random = np.random.default_rng(seed)
    weights = 2.0 * random.normal(size=(3, 2, 1))

    def demonstration():
        state = random.normal(size=(steps, 2))
        law = np.argmax(state @ random.normal(size=(2, 3)) + random.gumbel(size=(steps, 3)), axis=1)
        controls = np.einsum("tf,tfa->ta", state, weights[law]) + 0.05 * random.normal(size=(steps, 1))
        return {"state": state}, controls

    return numbered(demonstration() for _ in range(number))


def contains(starts, **training):
    own = {"optimizer": {"name": "em"}, "epochs": 200, "starts": starts, "tune_fraction": 0, **training}
    return small_spec(
        (3,), {"network": "linear"}, control={"std": {"learn": True, "per_option": True}}, training=own,
        compare_with=["mixture"], demonstrations={"path": "in memory", "valid_fraction": 0.2},
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(2))
def test_a_hierarchy_is_no_less_likely_in_training_than_its_mixture(seed, monkeypatch):
    """Where its own start is worse, training goes on from the mixture; else the bound is broken, and told."""
    demos, spec = memoryless(seed), contains(["equal_parts"])
    with monkeypatch.context() as patch:
        patch.setattr(restarting.Trainer, "contain", lambda self, mixture, objective: self.hierarchy)
        before = ddco_pyro.fit(spec, demos).metrics
    after = ddco_pyro.fit(spec, demos).metrics
    broken, held = before.below["mixture"], after.below["mixture"]
    assert held.objective <= restarting.ROUNDING
    assert held.objective == pytest.approx(
        after.comparison["mixture"].training.objective - after.training.objective, abs=1e-9
    )
    counts = max(broken.objective, broken.nats) > 0.01 * before.marginal.controls
    assert ("less likely than the mixture that they contain" in verdict(before)) == counts
    restarts = after.training.restarts
    went_on = [one.start for one in restarts.each[1:]]
    assert (went_on == []) == (broken.objective <= restarting.ROUNDING)
    assert set(went_on) <= {restarting.BESIDE}
