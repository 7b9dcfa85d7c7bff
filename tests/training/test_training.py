"""Training: stages, resuming bit for bit, refusing what is not finite, and planted hierarchies recovered."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import (
    CONTROL,
    TRAINING,
    in_units_of,
    make_spec,
    make_trainer,
    make_truth,
    per_step,
    plant,
    recovered,
)
from random_demonstrations import numbered, of_states

from ddco_pyro.inference import log_likelihood
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.loop import StageTraining, train
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.stages import RISING, plan, stage_end

QUICK = {"control": {"std": 1.0}, "optimizer": {"lr": 0.1}}
"""Every stage soon stops."""


@pytest.mark.parametrize(
    ("training", "depth", "names"),
    [
        ({}, 2, ["vq-1", "level-1", "vq-2", "level-2", "meta-policy", "joint"]),
        ({"starts": ["equal_parts"], "layerwise": False}, 2, ["parts-1", "parts-2", "joint"]),
        ({"starts": ["random"]}, 2, ["level-1", "level-2", "meta-policy", "joint"]),
        ({"layerwise": "segments"}, 3, ["vq-1", "level-1", "segments", "upper", "joint"]),
        ({"starts": ["windows"]}, 1, ["vq-1", "level-1", "meta-policy", "joint"]),
        ({"starts": ["mixture"], "layerwise": "segments"}, 3, ["vq-1", "vq-2", "vq-3", "mixture", "joint"]),
        ({"layerwise": False, "starts": ["random"]}, 3, ["joint"]),
        ({}, 0, ["policy"]),
    ],
)
def test_stages_go_from_the_lowest_level_up(training, depth, names):
    assert [stage.name for stage in plan(make_spec(**training), depth)] == names


def lines(**training):
    """Ten demonstrations along a line, cut into three equal parts, and how they are fitted."""
    noise = np.random.default_rng(0).normal(0, 0.02, (10, 12, 2))
    line = np.linspace(-1, 1, 12)[:, None] * [1.0, 0.0] + noise
    demos = numbered(({"state": one}, one) for one in line)
    own = {"starts": ["equal_parts"], "layerwise": False, "optimizer": {"lr": 0.1}}
    own |= {"epochs": 800, "patience": None}
    return make_trainer(make_spec((3,), **own, **training), demos, None).data


def test_a_meta_policy_that_nothing_trains_before_all_are_begins_with_its_options():
    """Parts say which option a demonstration begins with and which one follows: before the last stage the
    meta-policy knows it, and options last. Of when it would act itself parts say nothing.
    """
    material, restart = lines(), Restart(Progress(0))
    train(material, restart, until=0)
    model = material.hierarchy(0)
    model.load_state_dict(restart.states["model"])
    with torch.no_grad():
        tables = model.tabulate(material.train)
    selects, ends = tables.selection[0].exp().mean(0)[:, 0, 1:], tables.termination[0].exp().mean(0)[..., 1]
    for option, (first, last) in enumerate(((0, 3), (4, 7), (8, 11))):
        assert selects[first, option] > 0.8
        assert ends[first + 1 : last + 1, option].max() < 0.2
    acts = with_overrides(material.spec, {"hierarchy.meta_policy.emits": ["options", "control"]})
    assert [stage.discovering for stage in plan(acts, 1)] == [1, None]


def test_learning_rates_fall_along_half_a_cosine(tmp_path, monkeypatch):
    """The rate of every gradient step against torch's own cosine schedule, stage by stage."""
    used = []

    class Adam(torch.optim.Adam):
        def step(self, closure=None):
            used.append(self.param_groups[0]["lr"])
            return super().step(closure)

    monkeypatch.setattr(torch.optim, "Adam", Adam)
    optimizer = {"lr": 0.01, "schedule": "cosine"}
    spec = make_spec(epochs=40, patience=None, optimizer=optimizer)
    trainer = make_trainer(spec, of_states([8] * 10), tmp_path)
    trainer.run()
    parameter, expected = torch.nn.Parameter(torch.zeros(1)), []
    for epochs in epochs_of(trainer).values():
        reference = torch.optim.SGD([parameter], lr=0.01)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(reference, epochs)
        for _ in range(epochs):
            expected.append(schedule.get_last_lr()[0])
            reference.step()
            schedule.step()
    np.testing.assert_allclose(used, expected, rtol=1e-9)


def epochs_of(trainer, restart=0):
    """The number of epochs of each stage that made some."""
    return Counter(row["stage"] for row in trainer.history if row["restart"] == restart)


def out_of_patience(tune, patience):
    """Whether the last epochs were no better than those before; where there are no others, than the start."""
    return len(tune) == patience or max(tune[-patience:]) <= max(tune[:-patience])


def test_stages_share_the_budget_and_what_one_leaves_goes_to_the_later_ones(tmp_path):
    """What each may take is worked out here from what the ones before it have taken."""
    spec = make_spec((2, 2), epochs=62, patience=3)
    trainer = make_trainer(spec, of_states([8] * 10), tmp_path)
    trainer.run()
    left, taken = 62, epochs_of(trainer)
    for number, stage in enumerate(plan(spec, 2)):
        cap = left // (6 - number)
        tune = [row["tune"] for row in trainer.history if row["stage"] == stage.name]
        assert taken[stage.name] == cap or out_of_patience(tune, 3)
        assert taken[stage.name] <= cap
        assert trainer.summary["stages"][number]["cap"] == cap
        left -= taken[stage.name]
    assert min(taken.values()) < 10  # one has stopped early
    assert max(taken.values()) > 62 / 6  # and another has taken more than an even share
    assert trainer.summary["spent"]["epochs"] == 62 - left


@pytest.mark.parametrize(("name", "apart"), [("adamw", True), ("adam", False)])
def test_weight_decay_of_adamw_is_apart_from_the_gradient(name, apart, tmp_path):
    """In the first step it takes as much more of every weight as it is larger; Adam would lose a penalty."""
    settings = {"control": {"std": 1.0}, "starts": ["random"], "layerwise": False, "epochs": 1}
    after = []
    for decay in (0.0, 1.0, 2.0):
        spec = make_spec((2,), optimizer={"name": name, "lr": 0.01, "weight_decay": decay}, **settings)
        after.append(make_trainer(spec, of_states([8] * 10), tmp_path / str(decay)).run().state_dict())
    none, once, twice = (torch.cat([value.flatten() for value in one.values()]) for one in after)
    assert (none != once).sum() > 10
    assert torch.allclose(twice - none, 2 * (once - none), atol=1e-7) == apart


def test_the_running_mean_of_the_weights_is_evaluated_and_kept(tmp_path, monkeypatch):
    """By its closed form, from the weights after each gradient step of the stage."""
    decay, steps, shown = 0.7, [], []

    def step(self, *arguments, old=StageTraining.step):
        value = old(self, *arguments)
        steps.append({name: value.detach().clone() for name, value in self.model.named_parameters()})
        return value

    def tune(self, model, old=Objective.tune):
        shown.append({name: value.detach().clone() for name, value in model.named_parameters()})
        return float(len(shown))  # every epoch is the best so far

    monkeypatch.setattr(StageTraining, "step", step)
    monkeypatch.setattr(Objective, "tune", tune)
    spec = make_spec((), average=decay, epochs=3, batch_size=4)
    final = make_trainer(spec, of_states([8] * 10), tmp_path).run()
    assert (len(steps), len(shown)) == (3 * 2, 1 + 3)
    for epoch, seen in enumerate(shown[1:], start=1):
        taken = steps[: 2 * epoch]
        last = len(taken) - 1
        for name, value in seen.items():
            mean = decay**last * taken[0][name] + sum(
                (1 - decay) * decay ** (last - place) * step[name]
                for place, step in enumerate(taken)
                if place
            )
            torch.testing.assert_close(value, mean)
    assert all(torch.equal(value, shown[-1][name]) for name, value in final.named_parameters())
    assert any(not torch.equal(value, steps[-1][name]) for name, value in final.named_parameters())


def slowly(name, rows, **training):
    return pytest.param(name, training, rows, marks=pytest.mark.slow)


RESUMED = {
    "adam": ("adam", {"epochs": 12}, 2 * 6 * 2),
    "momentum": slowly("momentum", 2 * 6 * 3, epochs=18),
    "stages that stop early": slowly("adam", None, epochs=30, patience=1),
    "levels from segments": slowly("adam", 2 * 5 * 2, epochs=10, layerwise="segments"),
    "mean weights": slowly("adam", 2 * 6 * 2, epochs=12, average=0.9),
    "starts that differ": ("adam", {"epochs": 12, "starts": ["equal_parts", "mixture"]}, 12 + 12),
}


@pytest.mark.parametrize(("optimizer", "training", "rows"), RESUMED.values(), ids=RESUMED)
def test_resuming_gives_the_same_bits(tmp_path, optimizer, training, rows):
    own = {"starts": ["vq", "vq"]} | training
    spec = make_spec((2, 2), optimizer={"name": optimizer, "lr": 0.01}, **own)
    demos = of_states([8] * 10)
    whole = make_trainer(spec, demos, tmp_path / "whole")
    expected = whole.run().state_dict()
    assert rows in (None, len(whole.history))
    rows = len(whole.history)
    for stop in range(1, rows, max(4, rows // 3)):
        folder = tmp_path / f"stop-{stop}"
        seen = []

        def interrupt(row, seen=seen, stop=stop):
            seen.append(row)
            if len(seen) == stop + 1:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            make_trainer(spec, demos, folder, interrupt).run()
        resumed = make_trainer(spec, demos, folder)
        found = resumed.run().state_dict()
        assert resumed.history == whole.history
        assert resumed.summary == whole.summary
        assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_both_engines_train_to_the_same_model(tmp_path):
    demos = of_states([5] * 6)
    states = []
    for engine in ("fused", "enumerate"):
        spec = with_overrides(make_spec((2,), epochs=8, control={"std": 1.0}), {"inference": engine})
        states.append(make_trainer(spec, demos, tmp_path / engine).run().state_dict())
    for name, value in states[0].items():
        torch.testing.assert_close(states[1][name], value, rtol=1e-3, atol=1e-5)


# --- convergence --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tune", "patience", "rising", "over"),
    [
        ([0.0, 1.0, 2.0, 4.0], 2, 3.0, 2),  # 1 before the last two, 4 with them
        ([0.0, 5.0, 2.0, 4.0], 2, 0.0, 2),  # patience is exhausted
        ([3.0, 1.0, 2.0], 5, 0.0, 2),  # it was best before it began
        ([7.0], 5, 0.0, 0),  # no epochs at all
        ([0.0, *range(30)], None, 20.0, 20),
    ],
)
def test_how_much_a_stage_still_rose(tune, patience, rising, over):
    end = stage_end("joint", 10, tune, patience)
    assert (end["epochs"], end["rising"], end["over"]) == (len(tune) - 1, rising, over)
    assert end["converged"] == (rising == 0.0 and len(tune) > 1)


def test_what_is_called_converged_is_at_the_optimum(tmp_path):
    """A linear policy with a fixed σ is least squares: its optimum is known without any training."""
    random = np.random.default_rng(0)
    weights, states = random.normal(size=(3, 2)), random.normal(size=(10, 50, 3))
    demos = numbered(({"state": state}, state @ weights + random.normal(size=(50, 2))) for state in states)
    train, tune = demos.split(0.2, 0)
    states = [
        np.concatenate([np.column_stack([d.observations["state"], np.ones(50)]) for d in p])
        for p in (train, tune)
    ]
    actions = [np.concatenate([d.actions for d in p]) for p in (train, tune)]
    slopes = np.linalg.lstsq(states[0], actions[0], rcond=None)[0]
    std = 0.5 * actions[0].std(0)
    error = actions[1] - states[1] @ slopes
    optimum = (-0.5 * (error / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)).sum(1).mean()
    below = {}
    for epochs in (15, 400):
        spec = make_spec((), control={"std": 0.5}, epochs=epochs, patience=None, batch_size=8)
        trainer = make_trainer(spec, demos, tmp_path / str(epochs))
        trainer.run()
        below[trainer.summary["converged"]] = optimum - trainer.restarts[0].progress.best
    assert below[True] < RISING
    assert below[False] > 10 * RISING


# --- planted hierarchies ------------------------------------------------------------------------------------


EM = {"optimizer": {"name": "em"}, "epochs": 300}


def test_a_planted_hierarchy_is_recovered_from_the_likeliest_of_several_starts(tmp_path):
    spec = make_spec((4,), control=CONTROL, starts=["random", "random", "equal_parts", "vq_controls"], **EM)
    truth = make_truth(spec)
    demos, _ = plant(truth, 80, 40, seed=1)
    trainer = make_trainer(in_units_of(spec, demos), demos, tmp_path)
    values = recovered(trainer.run(), truth, *plant(truth, 40, 40, seed=2))
    assert values["found"] > values["truth"] - 0.02 * abs(values["truth"])
    assert values["found nmi"][0] > values["truth nmi"][0] - 0.05
    segments = trainer.restarts[0].states["best"], trainer.restarts[1].states["best"]
    assert any(not torch.equal(segments[0][name], segments[1][name]) for name in segments[0])
    told = trainer.summary["restarts"]
    others = [number != told["best"] for number in range(4)]
    assert [each["nmi"] is not None for each in told["each"]] == others


@pytest.mark.parametrize(
    "optimizer",
    [{"name": "em"}, pytest.param({"name": "adam", "lr": 0.03}, marks=pytest.mark.slow)],
    ids=["em", "adam"],
)
@pytest.mark.parametrize("counts", [(3,), (3, 2)])
def test_a_hierarchy_begins_from_the_mixtures_fit_with_psi_one_half(tmp_path, counts, optimizer):
    """The stage before the last maximises the likelihood of the spec whose options always end."""
    spec = make_spec(counts, control=CONTROL, starts=["mixture"], optimizer=optimizer, epochs=240)
    demos, _ = plant(make_truth(spec), 30, 20, seed=1)
    spec = in_units_of(spec, demos)
    data = make_trainer(spec, demos, tmp_path).data
    restart = train(data, Restart(Progress(0)), until=0)
    begun = restart.paused.model.state_dict() if optimizer["name"] == "em" else restart.states["model"]
    model = data.hierarchy(0, begun)
    always = {f"hierarchy.levels.{n}.termination": "always" for n in range(len(counts))}
    mixture = replace(data, spec=with_overrides(spec, always)).hierarchy(0)
    mixture.load_state_dict({name: begun[name] for name in mixture.state_dict()})
    half = [torch.allclose(ends, torch.tensor(0.5)) for ends in psi(model, data.train)]
    assert half == [True] * len(counts)
    without = [per_step(mixture, batch) for batch in (data.train, data.tune)]
    tuned = [row["tune"] for row in restart.progress.history if row["stage"] == "mixture"]
    # EM before the last stage keeps what converged
    kept = tuned[-1] if optimizer["name"] == "em" else max(tuned)
    assert kept == pytest.approx(without[1], abs=1e-5)
    restart = train(data, restart)
    assert restart.progress.ended[-1]["stage"] == "joint"
    assert restart.progress.best > without[1]
    found = data.hierarchy(0, restart.states["best"])
    assert per_step(found, data.train) > without[0]
    assert not all(torch.allclose(ends, torch.tensor(0.5)) for ends in psi(found, data.train))


def psi(model, batch):
    """Of each level."""
    with torch.no_grad():
        return [level[..., 1].exp() for level in model.tabulate(batch).termination]


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(4,), (4, 2)])
def test_a_planted_hierarchy_is_recovered(tmp_path, counts):
    """Held-out log-likelihood within 2 % of the truth's own, and segments that agree with true options."""
    spec = make_spec(
        counts, control=CONTROL, **(TRAINING if len(counts) > 1 else TRAINING | {"starts": ["vq_controls"]})
    )
    truth = make_truth(spec)
    demos, _ = plant(truth, 80 if len(counts) > 1 else 40, 40, seed=1)
    values = recovered(
        make_trainer(in_units_of(spec, demos), demos, tmp_path).run(), truth, *plant(truth, 40, 40, seed=2)
    )
    assert values["found"] > values["truth"] - 0.02 * abs(values["truth"]), values
    assert values["found nmi"][0] > 0.95, values


# --- what of the tuning demonstrations decides --------------------------------------------------------------


@pytest.mark.parametrize("number", [25, 30])
def test_the_median_is_over_demonstrations_and_per_step_of_each(number):
    """Of five, and of six."""
    spec = make_spec((2,), tune_by="median")
    material = make_trainer(spec, of_states(range(9, 9 + number)), None).data
    model, batch = material.hierarchy(0), material.tune
    assert len(batch) == number // 5
    with torch.no_grad():
        values = (log_likelihood(model.tabulate(batch), batch.lengths) / batch.lengths).numpy()
    assert Objective(material, Progress(0), plan(spec, 1)[-1]).tune(model) == pytest.approx(np.median(values))
    assert abs(np.median(values) - float(values @ batch.lengths.numpy() / batch.steps)) > 1e-3
