"""Restarts: the same bits in any number of processes and after an interruption, and which of them are stopped."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import user_networks
from planted import make_spec, make_trainer, small_spec
from random_demonstrations import of_states
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.drawing import words
from ddco_pyro.evaluation import effort
from ddco_pyro.events import EpochEnded, RestartDiverged, RestartStopped
from ddco_pyro.inference import segment
from ddco_pyro.metrics import Training
from ddco_pyro.spec import with_overrides
from ddco_pyro.training import loop as training
from ddco_pyro.training import restarts as restarting
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.objective import TrainingError

QUICK = {"initialize": "random", "layerwise": False, "epochs": 14, "patience": 5, "optimizer": {"lr": 0.05}}
"""Some restarts of it end by patience, others by their budget."""


@pytest.fixture(scope="module")
def demos():
    return of_states([6] * 10)


@pytest.fixture(scope="module")
def spec():
    return make_spec((2,), restarts=5, halving=3, control={"std": 1.0}, **QUICK)


@pytest.fixture(scope="module")
def undisturbed(spec, demos, tmp_path_factory):
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


class Interrupting:
    """Ctrl-C at so many epochs."""

    def __init__(self, epochs):
        self.left, self.stopped = epochs, []

    def __call__(self, event):
        self.stopped += [event] if isinstance(event, RestartStopped) else []
        self.left -= isinstance(event, EpochEnded)
        if self.left == 0:
            raise KeyboardInterrupt


# --- processes --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("here", [0.0, 0.02])
def test_two_processes_give_the_same_bits_also_where_one_had_begun(
    undisturbed, spec, demos, tmp_path, monkeypatch, here
):
    """Interrupted in the middle of the second rung; continued by two processes, at once or after a moment here."""
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(restarting, "SHORT", here)
    with pytest.raises(KeyboardInterrupt):
        make_trainer(spec, demos, tmp_path, Interrupting(5 * 3 + 2)).run()
    kept = [Restart.read(path).progress for path in sorted(tmp_path.iterdir())]
    assert len({progress.epoch for progress in kept}) > 1
    told = []
    trainer = make_trainer(spec, demos, tmp_path, told.append, jobs=2)
    assert_same(trainer, trainer.run().state_dict(), tmp_path, undisturbed)
    missing = len(trainer.history) - sum(len(progress.history) for progress in kept)
    assert len([event for event in told if isinstance(event, EpochEnded)]) == missing > 0


# --- going on ---------------------------------------------------------------------------------------------------------


def test_an_interruption_changes_nothing(undisturbed, demos, tmp_path, monkeypatch):
    """In the first rung, at its end, in the middle of later ones, again and again until it is done."""
    stopped, interruptions = interrupted_again_and_again(4, undisturbed, demos, tmp_path, monkeypatch)
    assert stopped == [event for event in undisturbed[2] if isinstance(event, RestartStopped)]  # each once
    assert interruptions >= len(undisturbed[0].history) // 4


def interrupted_again_and_again(epochs, undisturbed, demos, folder, monkeypatch):
    """After so many epochs, until it is done and gives the same bits; which restarts were said to be stopped, and how
    often it was interrupted.
    """
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    stopped = []
    for interruptions in range(100):
        told = Interrupting(epochs)
        trainer = make_trainer(undisturbed[0].spec, demos, folder, told)
        try:
            assert_same(trainer, trainer.run().state_dict(), folder, undisturbed)
            return stopped + told.stopped, interruptions
        except KeyboardInterrupt:
            stopped += told.stopped
    pytest.fail("it makes no progress")


# --- who goes on ------------------------------------------------------------------------------------------------------


def allowed(curves, first):
    """The epochs that each restart may make, by the rule in words: a restart takes part in a rung when fewer than half
    of those of the rung before, rounded up, were better there.
    """
    limits = [0] * len(curves)
    going, rung = set(range(len(curves))), first
    while len(going) > 1:
        for number in going:
            limits[number] = rung
        places = -(-len(going) // 2)
        tops = {number: max(curves[number][: rung + 1]) for number in going}
        going = {
            number
            for number in going
            if sum(tops[rival] > tops[number] or (tops[rival] == tops[number] and rival < number) for rival in going)
            < places
        }
        rung *= 2
    limits[going.pop()] = 10**9
    return limits


class Scripted:
    """Restarts whose tuning values were written down before; each curve begins with that from before training."""

    def __init__(self, curves):
        self.curves = curves

    def __call__(self, data, restart, until, seconds=None, checkpoint=None, on_event=None):
        progress = restart.progress
        curve = self.curves[progress.restart]
        progress.start = curve[0]
        while progress.epoch < len(curve) - 1 and (until is None or progress.epoch < until):
            progress.epoch += 1
            progress.history.append({"restart": progress.restart, "tune": curve[progress.epoch]})
        progress.best = max(curve[: progress.epoch + 1])
        progress.done = progress.epoch == len(curve) - 1
        if progress.done:
            progress.ended = [{"stage": "joint", "epochs": 1, "cap": 1, "rising": 0.0, "over": 1}]
        restart.states = {"best": data.hierarchy(progress.restart).state_dict()}
        return restart


@pytest.mark.parametrize("seed", range(8))
def test_the_worse_half_is_stopped_at_each_rung(demos, tmp_path, monkeypatch, seed):
    random = np.random.default_rng(seed)
    number, first = int(random.integers(1, 10)), int(random.integers(1, 4))
    curves = [random.integers(0, 30, random.integers(2, 30)).astype(float).tolist() for _ in range(number)]  # with ties
    monkeypatch.setattr(restarting, "train", Scripted(curves))
    told = []
    trainer = make_trainer(make_spec(restarts=number, halving=first), demos, tmp_path, told.append)
    model = trainer.run().state_dict()
    limits = allowed(curves, first)
    made = [min(limit, len(curve) - 1) for limit, curve in zip(limits, curves, strict=True)]
    assert [each["epochs"] for each in trainer.summary["restarts"]["each"]] == made
    assert {event.restart: event.epochs for event in told} == {
        n: made[n] for n in range(number) if made[n] < len(curves[n]) - 1
    }
    tops = [max(curve[: count + 1]) for curve, count in zip(curves, made, strict=True)]
    best = trainer.summary["restarts"]["best"]
    assert tops[best] == max(tops)
    expected = trainer.data.hierarchy(best).state_dict()
    assert all(torch.equal(model[name], value) for name, value in expected.items())


def test_without_halving_all_are_trained_and_the_best_is_kept(demos, tmp_path, undisturbed, spec):
    """Each as a training of its own would be, which knows nothing of restarts."""
    told = []
    trainer = make_trainer(with_overrides(spec, {"training.halving": None}), demos, tmp_path, told.append)
    model = trainer.run().state_dict()
    assert not any(isinstance(event, RestartStopped) for event in told)
    alone = []
    for number in range(5):
        restart = training.train(trainer.data, Restart(Progress(number)))
        assert restart.progress.done
        alone.append(restart)
    rows = [row for restart in alone for row in restart.progress.history]
    assert trainer.history == rows
    winner = max(alone, key=lambda restart: restart.progress.best)
    assert all(torch.equal(model[name], value) for name, value in winner.states["best"].items())
    shorter = undisturbed[0].history
    assert all(row in rows for row in shorter)  # halving stops restarts, and changes nothing else
    assert len(shorter) < len(rows)


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


# --- restarts that diverge --------------------------------------------------------------------------------------------


def diverging(passes, **training):
    """Restarts of which those that begin with a positive weight have that many passes before they give NaN."""
    policy = {"network": "user_networks:Diverging", "options": {"passes": passes}}
    own = {"restarts": 6, "halving": 3, "epochs": 12, "patience": None, "tune_fraction": 0.2, **training}
    return small_spec((), policy, control={"std": 1.0, "scale": "none"}, training=own)


def diverged(trainer):
    return [number for number, each in enumerate(trainer.summary["restarts"]["each"]) if each.get("diverged")]


@pytest.fixture(scope="module", params=[(1, 3), (4, 3), (10, 2)])
def with_diverging(request, demos, tmp_path_factory):
    """As ``undisturbed``; restarts diverge in the first rung, after it, or when all others have been stopped."""
    passes, halving = request.param
    return trained(diverging(passes, halving=halving), demos, tmp_path_factory.mktemp("diverging"))


def test_a_restart_that_diverges_ends_there_and_is_not_the_best(with_diverging):
    trainer, model, told, _ = with_diverging
    ended = diverged(trainer)
    starts = [trainer.data.hierarchy(number).meta_policy.network.module.weight[0, 0] > 0 for number in range(6)]
    passes = int(trainer.spec.baseline.policy.options["passes"])
    rows = [sum(row["restart"] == number for row in trainer.history) for number in range(6)]
    assert ended
    assert all(starts[number] and rows[number] == passes for number in ended)
    best = trainer.summary["restarts"]["best"]
    assert best not in ended
    assert all(value.isfinite().all() for value in model.values())
    reasons = {event.restart: event.why for event in told if isinstance(event, RestartDiverged)}
    assert sorted(reasons) == ended
    assert all(f"epoch {passes + 1}: the log-likelihood of demo_" in why for why in reasons.values())
    assert f"; diverged: {', '.join(map(str, ended))}" in effort.restarts(Training.model_validate(trainer.summary))
    made = training.train(trainer.data, Restart(Progress(best)))
    if passes == 1:  # those that diverge in the first rung are worse than all others there
        assert ended == [number for number in range(6) if starts[number]]
    if passes == 10:  # the last one that was left: another goes on, which had been stopped
        assert best in {event.restart for event in told if isinstance(event, RestartStopped)}
        each = trainer.summary["restarts"]["each"][best]
        assert (each["epochs"], each["stopped"]) == (12, None)
    assert all(torch.equal(model[name], value) for name, value in made.states["best"].items())


def test_an_interruption_changes_nothing_where_restarts_diverge(with_diverging, demos, tmp_path, monkeypatch):
    _, interruptions = interrupted_again_and_again(7, with_diverging, demos, tmp_path, monkeypatch)
    assert interruptions > 3


@pytest.mark.slow
def test_two_processes_give_the_same_bits_where_restarts_diverge(with_diverging, demos, tmp_path, monkeypatch):
    monkeypatch.setattr(restarting, "SHORT", 0.0)
    trainer = make_trainer(with_diverging[0].spec, demos, tmp_path, jobs=2)
    assert_same(trainer, trainer.run().state_dict(), tmp_path, with_diverging)


@pytest.mark.parametrize("restarts", [1, 3])
def test_where_all_diverge_the_trajectory_is_named(demos, tmp_path, monkeypatch, restarts):
    monkeypatch.setattr(user_networks.Diverging, "forward", lambda self, inputs: _nan_in_training(self, inputs))
    for _ in range(2):  # also where all that is kept is read again
        with pytest.raises(
            TrainingError, match=r"^stage policy, epoch 1: the log-likelihood of demo_\d+.* is not finite"
        ):
            make_trainer(diverging(0, restarts=restarts), demos, tmp_path).run()


def _nan_in_training(network, inputs):
    found = (inputs.vector @ network.weight).unflatten(-1, network.size)
    return found * torch.nan if network.training else found


def test_each_restart_begins_from_the_next_kind(demos, tmp_path):
    kinds = ["random", "cuts", "mixture"]
    spec = make_spec((2,), restarts=4, control={"std": 1.0}, **{**QUICK, "initialize": kinds})
    trainer = make_trainer(spec, demos, tmp_path)
    trainer.run()
    stages = [list(dict.fromkeys(row["stage"] for row in one.progress.history)) for one in trainer.restarts]
    assert stages == [["joint"], ["cuts-1", "joint"], ["vq-1", "mixture", "joint"], ["joint"]]
    each = trainer.summary["restarts"]["each"]
    assert [one["initialize"] for one in each] == [*kinds, "random"]
    said = effort.restarts(Training.model_validate(trainer.summary))
    assert "(0 from random, 1 from cuts, 2 from mixture, 3 from random; stopped early" in said
    best, batch = trainer.summary["restarts"]["best"], trainer.data.train
    for number, one in enumerate(each):
        models = [trainer.data.hierarchy(n, trainer.restarts[n].states["best"]) for n in (best, number)]
        with torch.no_grad():
            ours, theirs = (segment(model.tabulate(batch), batch.lengths)[0].flatten() for model in models)
        nmi = normalized_mutual_info_score(ours, theirs)
        assert nmi == pytest.approx(1.0 if number == best else one["nmi"])
        assert number == best or f"{words.number(nmi)} of {number}" in said
