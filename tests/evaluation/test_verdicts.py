"""What is said of a run: by hand-made likelihoods, beside what they mean."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_metrics import compared, made_metrics, scored
from planted import small_spec
from random_demonstrations import numbered
from scipy import stats

import ddco_pyro
from ddco_pyro.cli import console
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.options import degeneracies
from ddco_pyro.spec import TrainingSpec

TEN = np.linspace(-0.1, 0.1, 10)


def around(mean, spread=1.0):
    """Ten values with this mean."""
    return (mean + spread * TEN).tolist()


def console_says(metrics, capsys):
    """What the console prints of the likelihoods of a run."""
    spec = SimpleNamespace(hierarchy=None, control=SimpleNamespace(learned_stds={}))
    console.log_likelihoods(SimpleNamespace(name="ddco", spec=spec, baselines={}, metrics=metrics))
    console.seeds(metrics)
    return " ".join(capsys.readouterr().out.split())


# --- fits that fell apart -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("train", "valid", "marginal", "controls", "who"),
    [
        # far below a density without observations
        ({"ddco": 16.5, "flat": 15.9}, {"ddco": -9.7, "flat": 15.4}, -6.0, 8, "Options"),
        ({"ddco": -17.0, "flat": -3.0}, {"ddco": -409.0, "flat": -3.3}, -6.0, 2, "Options"),
        ({"ddco": 6.0}, {"ddco": -16.0}, -4.0, 2, "Options"),  # nothing stands beside it
        # above it, and below every other model by an interval
        ({"ddco": 9.0, "flat": 5.0}, {"ddco": 1.0, "flat": 4.0}, 0.0, 4, "Options"),
        # the likeliest of all, whatever it loses from training to held-out demonstrations
        ({"per_timestep": 24.0, "ddco": 9.0}, {"per_timestep": 12.0, "ddco": 8.0}, 0.0, 7, None),
        # all lose the same, 0.15 for each of 26 controls
        ({"ddco": 30.0, "flat": 28.0}, {"ddco": 26.0, "flat": 24.0}, -20.0, 26, None),
        ({"ddco": 30.0, "flat": 28.0}, {"ddco": 24.0, "flat": 24.1}, -20.0, 26, None),
        # a baseline's fault is no fault of the model
        ({"ddco": 2.0, "flat": 9.0}, {"ddco": 1.0, "flat": 0.5}, -2.0, 2, None),
    ],
)
def test_a_fit_that_fell_apart_is_doubtful(train, valid, marginal, controls, who, capsys):
    metrics = scored(train, {name: around(value) for name, value in valid.items()}, marginal, controls)
    doubts = [text for text, _ in verdicts.doubts(metrics)]
    assert [text.split(" fell apart")[0] for text in doubts if "fell apart" in text] == ([who] if who else [])
    said = verdicts.verdict(metrics)
    assert said.startswith(f"{who} fell apart") == bool(who)
    if who:
        ours = (train["ddco"] - valid["ddco"]) / controls
        assert f"That is {ours:.2f} less for each of {controls} controls." in said
        assert "Take fewer options" in said
    assert ("Flat fell apart" in console_says(metrics, capsys)) == ("Flat fell apart" in said)


def test_a_baseline_that_fell_apart_comes_last_with_advice_for_itself(capsys):
    """The model is sound, and is compared with it nowhere first."""
    metrics = scored({"ddco": 2.0, "flat": 9.0}, {"ddco": around(1.0), "flat": around(0.5)}, -2.0, 2)
    assert verdicts.doubts(metrics) == []
    ((text, advice),) = verdicts.faults(metrics)
    says = "Flat fell apart on held-out demonstrations: 0.50 nats per step there, 9.00 in training."
    assert text.startswith(says)
    assert "this baseline" in advice
    said = verdicts.verdict(metrics)
    assert said.index("Options explain") < said.index("Flat fell apart")
    assert text in console_says(metrics, capsys)


def test_a_model_below_simpler_ones_is_doubtful():
    """It loses nothing on held-out demonstrations, yet a mean and spread, or a flat one, predict better."""
    text = verdicts.verdict(scored({"ddco": -3.0}, {"ddco": around(-3.0)}, -1.0, 2))
    says = "Options predict held-out controls worse than the mean and the spread of each control do: "
    assert text.startswith(says)
    held_out = {"ddco": around(1), "flat": around(1.4, 2)}
    text = verdicts.verdict(scored({"ddco": 1.1, "flat": 1.5}, held_out, -2.0, 2))
    error = np.std(TEN, ddof=1) / np.sqrt(10)
    says = f"Options are below flat by 0.40 ± {error:.2f} nats per step on held-out demonstrations. T"
    assert text.startswith(says)


@pytest.mark.parametrize(("nats", "controls", "told"), [(0.02, 7, False), (0.02, 1, True), (0.08, 7, True)])
def test_a_mixture_that_leads_in_training_by_what_nobody_acts_on_is_no_doubt(nats, controls, told):
    """A control has to be 1 % more probable under the mixture."""
    below = {"mixture": {"objective": nats, "nats": 0.0}}
    metrics = scored({"ddco": 1.0}, {"ddco": around(1.0)}, -2.0, controls, below=below)
    said = "In training options are less likely than the mixture that they contain, by "
    said += f"{nats:.2f} nats per step."
    assert [text for text, _ in verdicts.doubts(metrics)] == [said] * told


@pytest.mark.parametrize(("left_out", "train", "few"), [(True, 4, True), (True, 8, False), (False, 4, False)])
def test_few_demonstrations_that_are_each_left_out_are_said_to_be_few(left_out, train, few):
    """Where the fits without one of them fell apart; a sound fit needs no more."""
    counts = {"train": train, "tune": 0, "valid": train, "left_out": left_out}
    apart, sound = (
        verdicts.verdict(scored({"ddco": 6.0}, {"ddco": around(value)}, -4.0, 2, demonstrations=counts))
        for value in (-16.0, 5.5)
    )
    said = f" {train} demonstrations are too few here: each held-out one leaves {train - 1} to train with."
    assert (said in apart) == few
    assert "too few" not in sound


@pytest.mark.parametrize("kind", ["auto", "gaussian"])
def test_the_density_without_observations_has_the_means_and_spreads_of_training(kind):
    """A Gaussian control and a switch, beside scipy's densities with the moments of what trains."""
    random = np.random.default_rng(0)
    rows = []
    for _ in range(12):
        seen = {"seen": random.normal(size=(30, 2))}
        rows.append((seen, np.stack([random.normal(3, 2, 30), random.random(30) < 0.3], 1) * 1.0))
    spec = small_spec(
        (),
        demonstrations={"path": "unused.hdf5", "valid_fraction": 0.25},
        observations=["seen"],
        control={"kind": kind, "std": 0.1},
        training={"epochs": 2, "tune_fraction": 0, "optimizer": {"name": "em"}},
    )
    demos = numbered(rows)
    metrics = ddco_pyro.fit(spec, demos).metrics
    held_out = {row.name for row in metrics.valid}
    train, valid = (
        np.concatenate([demo.actions for demo in demos if (demo.name in held_out) == part])
        for part in (False, True)
    )
    values = stats.norm.logpdf(valid, train.mean(0), train.std(0))
    if kind == "auto":
        values[:, 1] = stats.bernoulli.logpmf(valid[:, 1], train[:, 1].mean())
    assert metrics.marginal.valid == pytest.approx(values.sum(1).mean(), abs=1e-3)
    assert metrics.marginal.controls == 2


# --- the test against the mixture ---------------------------------------------------------------------------


def memory(mean, error, held_out=10, **more):
    """A run with a mixture beside it."""
    lead = {"nats_per_step": mean, "standard_error": error}
    worth, comparison = {"memory": lead}, {"mixture": compared(mean, error)}
    return made_metrics(held_out, worth=worth, comparison=comparison, **more)


SEEDS = {"training_seeds": [0, 1, 2], "held_out": {"ddco": [1.0, 1.1, 1.2]}}


def over_three(values, errors):
    return SEEDS | {"worth": {"memory": values}, "standard_error": {"memory": errors}}


LASTING = {
    "better": "options that last predict held-out controls better than the mixture does: ",
    "worse": "options that last predict held-out controls worse than the mixture does: ",
    "same": "options that last predict held-out controls as well as the mixture does: ",
    "unclear": "it is inconclusive whether options that last predict held-out controls better than the "
    "mixture does: ",
}


@pytest.mark.parametrize(
    ("mean", "error", "way", "lead"),
    [
        (0.5, 0.1, "better", "+0.50 ± 0.10"),
        (0.1, 0.1, "unclear", "+0.10 ± 0.10"),
        (-0.5, 0.1, "worse", "−0.50 ± 0.10"),
        (0.001, 0.001, "same", "0.00"),
    ],
)
def test_one_fit_says_what_was_measured(mean, error, way, lead, capsys):
    metrics = memory(mean, error)
    for text in (verdicts.tested(metrics), verdicts.verdict(metrics), console_says(metrics, capsys)):
        assert f"In this fit {LASTING[way]}{lead}" in text
        assert "Success was not measured." in text


@pytest.mark.parametrize("held_out", [1, 2])
@pytest.mark.parametrize("seeds", [None, over_three([0.5, 0.51, 0.52], [0.01] * 3)])
def test_one_or_two_held_out_demonstrations_say_nothing_of_significance(held_out, seeds):
    error = None if held_out == 1 else 0.001
    text = verdicts.verdict(memory(0.5, error, held_out, seeds=seeds))
    held = f"({held_out}) are held out to compare options that last with the mixture"
    assert f"Too few demonstrations {held}" in text
    assert not {"±", "["} & {*text}
    words = ("predict held-out controls better", "no clear difference", "significant")
    assert not any(word in text for word in words)


@pytest.mark.parametrize(
    ("values", "way"),
    [
        ([0.3, 0.4, 0.35], "better"),
        ([0.3, 0.4, -0.35], "unclear"),
        ([-0.3, -0.4, -0.35], "worse"),
        ([0.001, 0.0011, 0.0012], "same"),
    ],
)
def test_the_verdict_is_over_training_seeds(values, way, capsys):
    metrics = memory(values[0], 0.0, seeds=over_three(values, [0.0, None, 0.0]))
    for text in (verdicts.verdict(metrics), console_says(metrics, capsys)):
        assert f"Over 3 training seeds {LASTING[way]}" in text


@pytest.mark.parametrize(
    ("error", "said"), [(0.016, "it is inconclusive whether"), (0.006, "predict held-out controls b")]
)
def test_where_seeds_give_the_same_fit_held_out_demonstrations_decide(error, said):
    """EM reaches one optimum from any seed; an interval without width is no evidence."""
    text = verdicts.tested(memory(0.019, error, seeds=over_three([0.019, 0.0191, 0.0192], [error] * 3)))
    assert said in text
    low, high = stats.t.interval(0.95, 9, 0.0191, error)  # ten held-out demonstrations
    assert f"[{low:.2f} to {high:.2f}]".replace("-", "−") in text


@pytest.mark.parametrize("brief", [True, False])
def test_very_short_options_are_not_said_to_last(brief, capsys):
    """On the page and the console, in one fit and over training seeds, with the share of twitches."""
    segments = [{"median": 3.0, "number": 90, "demonstrations": 3, "twitches": 61 if brief else 20}]
    found = {"segments": segments, "control_frequency": 10.0}
    for seeds in (None, over_three([0.5, 0.51, 0.52], [0.01] * 3)):
        metrics = memory(0.5, 0.01, **found, seeds=seeds)
        for said in (verdicts.verdict(metrics), console_says(metrics, capsys)):
            assert ("very short options predict held-out controls better" in said) == brief
            assert ("68 % of all are twitches, shorter than 0.5 s, and they are no skills." in said) == brief
            assert ("options that last predict" in said) != brief


MORE = "options succeed more often than the mixture:"
LESS = "options succeed less often than the mixture:"
UNKNOWN = "it is inconclusive whether options succeed more often than"


@pytest.mark.parametrize(
    ("only", "others", "seeds", "said"),
    [
        (9, 1, None, f"In this fit {MORE} +8 (p = 0.021) of 50 episodes."),
        (1, 9, None, f"In this fit {LESS} −8 (p = 0.021) of 50 episodes."),
        (5, 4, None, f"In this fit {UNKNOWN} the mixture: +1 (p ="),
        (20, 0, [0.4, 0.41, 0.42], f"Over 3 training seeds {MORE} +41 ["),
        (5, 4, [0.02, 0.1, -0.1], f"Over 3 training seeds {UNKNOWN}"),
    ],
)
def test_success_is_told_where_it_was_measured(only, others, seeds, said):
    rates = {name: {"successes": n, "trials": 50, "rate": n / 50, "interval": [0, 1]} for name, n in
             (("ddco", 40), ("mixture", 40 - only + others))}  # fmt: skip
    pair = {"only_ours": only, "only_theirs": others, "trials": 50}
    pair["p_value"] = stats.binomtest(only, only + others).pvalue
    rollouts = {"seed": 0, "episodes": 50, "worth": {"memory": pair}}
    rollouts["methods"] = {name: {"measures": {"success": rate}} for name, rate in rates.items()}
    if seeds:
        rollouts["seeds"] = {"training_seeds": [0, 1, 2], "success": {}, "worth": {"memory": seeds}}
    text = verdicts.verdict(memory(0.5, 0.1, rollouts=rollouts))
    assert "In rollouts options succeed in 40 of 50 episodes" in text
    assert said in text
    assert "not measured" not in text


ALONE = "0.10 nats per step better than flat (1 held-out demonstration is too few for an error; one"


@pytest.mark.parametrize(
    ("mean", "error", "held_out", "said"),
    [
        (0.42, 0.05, 10, "0.42 ± 0.05 nats per step better than flat"),
        (-0.42, 0.05, 10, "0.42 ± 0.05 nats per step worse than flat"),
        (0.1, 0.05, 10, "with no clear difference from flat (+0.10 ± 0.05 nats per step)"),
        (0.1, 0.04, 100, "0.10 ± 0.04 nats per step better than flat"),
        (0.1, 0.04, 3, "with no clear difference from flat"),
        (0.1, None, 1, ALONE),
    ],
)
def test_a_lead_has_its_error(mean, error, held_out, said):
    assert said in verdicts.verdict(made_metrics(held_out, comparison={"flat": compared(mean, error)}))


# --- labels -------------------------------------------------------------------------------------------------


def test_equal_parts_that_agree_better_are_a_sign():
    measures = dict.fromkeys(("ari", "boundary_f1_1", "boundary_f1_3", "boundary_f1_5"), 0.1)
    matched = dict.fromkeys(("accuracy", "iou", "f1_10", "f1_25", "f1_50", "edit"), 0.1)
    measures |= {"matched_globally": matched, "matched_per_demonstration": matched}
    level = SimpleNamespace(name="skill", lasts=True)
    spec = SimpleNamespace(hierarchy=SimpleNamespace(levels=[level]), training=TrainingSpec())

    def signs(**nmi):
        own = {part: [measures | {"nmi": value}] for part, value in nmi.items()}
        confusion = {"labels": [], "options": [], "steps": [], "matched": []}
        found = made_metrics(agreement={"labels": ["phase"], "confusion": [confusion], **own})
        return [said for said, _ in degeneracies(found, spec, {"skill": []})]

    (said,) = signs(train=0.9, equal_train=0.2, valid=0.41, equal_valid=0.52)
    says = "Equal parts of each demonstration agree better with labels “phase” than options do: NMI 0"
    assert said.startswith(says)
    assert said.endswith("held out.")
    (said,) = signs(train=0.41, equal_train=0.52)
    assert said.endswith("in training.")
    assert signs(train=0.1, equal_train=0.2, valid=0.6, equal_valid=0.52) == signs(train=0.1) == []
