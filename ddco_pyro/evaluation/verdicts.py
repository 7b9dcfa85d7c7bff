"""What a run shows, in sentences, which stand in one table; and what its training took, in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

import numpy as np

from ddco_pyro.data.demonstrations import FEW
from ddco_pyro.drawing.words import (
    capital,
    duration,
    interval,
    listed,
    number,
    of_episodes,
    percent,
    rate,
    signed,
    verb,
    with_error,
)
from ddco_pyro.metrics import METRICS, Against, Candidate, Difference, Marginal, Metrics, Segments, Training
from ddco_pyro.names import FLAT, HIERARCHY, MIXTURE, method
from ddco_pyro.statistics import paired, t_quantile, wider_interval

SMALLEST = 0.01
"""Smallest useful difference in nats per step: a step's control is exp(0.01) times as probable, 1 % more."""

LOST = 1.0
"""Nats per step and control dimension, from training to held-out demonstrations, from which on a model may
have fallen apart: a control is e = 2.7 times less probable there."""

FEWEST = 3
"""Fewest held-out demonstrations of which an interval is told."""

Direction = Literal["better", "worse", "same", "unclear", "brief", "few"]

OVER = {"one": "In this fit", "several": "Over {seeds} training seeds"}
"""How sentences on a test begin, by the number of training seeds."""

SENTENCES: Mapping[tuple[str, Direction], str] = {
    # options that last against the mixture
    ("controls", "better"): "{over} options that last predict held-out controls better than the mixture "
    "does: {lead}.",
    ("controls", "worse"): "{over} options that last predict held-out controls worse than the mixture "
    "does: {lead}.",
    ("controls", "same"): "{over} options that last predict held-out controls as well as the mixture "
    "does: {lead}.",
    ("controls", "unclear"): "{over} it is inconclusive whether options that last predict held-out controls "
    "better than the mixture does: {lead}.",
    ("controls", "brief"): "{over} very short options predict held-out controls better than the mixture "
    "does: {lead}. {brief}, and they are no skills.",
    ("controls", "few"): "Too few demonstrations ({held_out}) are held out to compare options that last with "
    "the mixture: {lead}.",
    ("success", "better"): "{over} options succeed more often than the mixture: {lead}.",
    ("success", "worse"): "{over} options succeed less often than the mixture: {lead}.",
    ("success", "unclear"): "{over} it is inconclusive whether options succeed more often than the mixture: "
    "{lead}.",
    ("success", "few"): "Success was not measured.",
    # a model against another one
    ("model", "better"): "{by} nats per step better than {other}",
    ("model", "worse"): "{by} nats per step worse than {other}",
    ("model", "unclear"): "with no clear difference from {other} ({lead} nats per step)",
    # options against labels and against equal parts of each demonstration
    ("labels", "better"): "Options agree better with labels “{labels}” than equal parts of each "
    "demonstration do: NMI {ours} against {equal}, accuracy {accuracy} against {equal_accuracy}, {part}.",
    ("labels", "worse"): "Equal parts of each demonstration agree better with labels “{labels}” than options "
    "do: NMI {equal} against {ours}, accuracy {equal_accuracy} against {accuracy}, {part}.",
    # doubts
    ("held out", "worse"): "{name} fell apart on held-out demonstrations: {valid} nats per step there, "
    "{train} in training. That is {loss} less for each of {controls} controls.",
    ("marginal", "worse"): "{name} {predict} held-out controls worse than the mean and the spread of each "
    "control do: {valid} against {marginal} nats per step.",
    ("flat", "worse"): "{name} {are} below {other} by {by} nats per step on held-out demonstrations.",
    ("contained", "worse"): "In training {name} {are} less likely than the {other} that they contain, by "
    "{by} nats per step.",
}
"""Sentences by what was measured and in which direction; :data:`OVER` says over how many training seeds.
{lead} is always options minus the mixture."""

ADVICE: Mapping[str, str] = {
    "held out": "Such a fit follows its training demonstrations too closely, and comparisons with it say "
    "nothing. Take fewer options or observations, smaller networks, larger ridges "
    "(training.optimizer.ridge), or more demonstrations.",
    "baseline": "Comparisons with this baseline say nothing. Give it a smaller network or larger ridges (its "
    "policy and optimizer in compare_with).",
    "marginal": "The observations do not say what the control is, or training ended too early.",
    "flat": "Take {other}, or compare numbers of options and their networks by cross-validation (ddco-pyro "
    "select).",
    "contained": "Add ways to begin (training.starts).",
    "few": "{count} demonstrations are too few here: each held-out one leaves {rest} to train with. Record "
    "at least {least}, and until then take two options and the fewest observations.",
}
"""What to do about a doubt."""


@dataclass(frozen=True)
class Models:
    """Models that predict the same held-out demonstrations.

    :param held_out: log p(ξ) of each demonstration by a model's name, nats, [N].
    :param train: log-likelihood of the training demonstrations, nats per step.
    :param steps: of each held-out demonstration, [N].
    :param kinds: the kind of each model, such as ``flat``; a baseline of a run has its kind as name.
    :param marginal: of the control without observations; None where unknown.
    """

    held_out: Mapping[str, np.ndarray]
    train: Mapping[str, float]
    steps: np.ndarray
    kinds: Mapping[str, str]
    marginal: Marginal | None = None

    @classmethod
    def of(cls, metrics: Metrics) -> Models:
        """The model of a run and its baselines."""
        rows = [row for row in metrics.demonstrations_by_likelihood if row.part == "valid"]
        steps = np.array([row.steps for row in rows], float)
        names = list(metrics.methods)
        rated = [row.log_likelihood_per_step for row in rows]
        held_out = {name: np.array([own[name] for own in rated]) * steps for name in names}
        train = {name: one.log_likelihood_per_step.train for name, one in metrics.methods.items()}
        return cls(held_out, train, steps, {name: name for name in names}, metrics.marginal)

    @property
    def controls(self) -> int:
        """Control dimensions that vary; 1 where unknown."""
        return self.marginal.controls if self.marginal else 1

    def per_step(self, name: str) -> float:
        """Held-out log-likelihood, nats per step."""
        return float(self.held_out[name].sum() / self.steps.sum())

    def lead(self, name: str, other: str) -> Difference:
        """The paired difference of two models."""
        return paired(self.held_out[name], self.held_out[other], self.steps)

    def loss(self, name: str) -> float:
        """Nats per step and control dimension that a model loses from training to held-out demonstrations."""
        return (self.train[name] - self.per_step(name)) / self.controls

    def below_marginal(self, name: str) -> bool:
        """Whether a density without observations predicts the held-out controls better."""
        best = None if self.marginal is None else self.marginal.valid
        return best is not None and self.counts(best - self.per_step(name))

    def counts(self, nats: float) -> bool:
        """Whether a difference in nats per step is a doubt: over :data:`SMALLEST` per control dimension."""
        return nats > SMALLEST * self.controls

    def apart(self, name: str) -> bool:
        """Whether a model fell apart on held-out demonstrations.

        It loses more than :data:`LOST` there, and is below the density without observations, or below every
        other model by a 95 % interval. The likeliest of several models never fell apart.
        """
        others = [other for other in self.held_out if other != name]
        best = bool(others) and name == max(self.held_out, key=self.per_step)
        if best or not len(self.steps) or self.loss(name) <= LOST:
            return False
        behind = (self.direction(self.lead(name, other)) == "worse" for other in others)
        return self.below_marginal(name) or (bool(others) and all(behind))

    def direction(self, lead: Difference) -> Direction:
        """The direction of a difference over held-out demonstrations, by its 95 % interval."""
        held_out = len(self.steps)
        if held_out < FEWEST or lead.standard_error is None:
            return "few"
        half = lead.standard_error * t_quantile(held_out - 1)
        return _direction(lead.nats_per_step - half, lead.nats_per_step + half, SMALLEST)

    def sound(self) -> bool:
        """Whether differences between options and the mixture mean something: neither fell apart."""
        return not any(self.apart(name) for name, kind in self.kinds.items() if kind in (HIERARCHY, MIXTURE))

    def doubts(self, name: str) -> Iterator[tuple[str, str]]:
        """What is doubtful about a model, and what to do."""
        called = capital(method(name)) if self.kinds[name] == name else name
        if self.apart(name):
            values = {"valid": number(self.per_step(name)), "train": number(self.train[name])}
            values |= {"loss": number(self.loss(name)), "controls": str(self.controls)}
            advice = "held out" if self.kinds[name] in (HIERARCHY, MIXTURE) else "baseline"
            yield said("held out", "worse", name=called, **values), ADVICE[advice]
        elif len(self.steps) and self.below_marginal(name) and self.marginal:
            values = {"valid": number(self.per_step(name)), "marginal": number(self.marginal.valid)}
            predict = verb(called, "predict", "predicts")
            text = said("marginal", "worse", name=called, predict=predict, **values)
            yield text, ADVICE["marginal"]
        known = self.kinds.items() if self.kinds[name] == HIERARCHY else ()
        flats = [other for other, kind in known if kind in FLAT]
        if flats and len(self.steps):
            flat = max(flats, key=self.per_step)
            lead, other = self.lead(name, flat), method(flat) if self.kinds[flat] == flat else flat
            if self.direction(lead) == "worse":
                by = f"{number(-lead.nats_per_step)} ± {number(lead.standard_error)}"
                are = verb(called, "are", "is")
                text = said("flat", "worse", name=called, are=are, other=other, by=by)
                yield text, ADVICE["flat"].format(other=other)

    def explains(self, name: str, leads: Mapping[str, Difference]) -> str:
        """One sentence on the lead of a model over others on held-out demonstrations.

        Its ± is over these demonstrations, for one fit of each model; fits from other seeds vary, too.

        :param leads: the paired difference by the other model's name.
        """
        clauses, held_out = [], len(self.steps)
        for other, lead in leads.items():
            way = self.direction(lead)
            error = f" ± {number(lead.standard_error)}" if way != "few" else ""
            by = number(abs(lead.nats_per_step)) + error
            sign: Direction = "better" if lead.nats_per_step > 0 else "worse"
            known: Direction = "unclear" if way in ("unclear", "same") else sign
            clauses.append(said("model", known, by=by, other=other, lead=with_error(lead)))
        text = f"{name} {verb(name, 'explain', 'explains')} held-out demonstrations {listed(clauses)}"
        if held_out < FEWEST:
            are = "demonstration is" if held_out == 1 else "demonstrations are"
            held = f"{held_out} held-out {are}"
            return f"{text} ({held} too few for an error; one fit of each model)."
        about = f"{held_out} held-out demonstrations, for one fit of each model"
        return f"{text} (± is one standard error over {about})."

    def lasting(self, memory: Difference, brief: str = "") -> str:
        """The test of one fit: options that last against the mixture.

        :param memory: options minus the mixture.
        :param brief: a sentence where the options are too short for skills; else empty.
        """
        way = self.direction(memory)
        known = with_error(memory) if way != "few" else signed(memory.nats_per_step)
        text = _lasting(way, f"{known} nats per step", len(self.steps), brief)
        return f"{text} One fit of each model is no verdict; repeat it with --seeds 5."


def said(measure: str, way: Direction, **values: str) -> str:
    """A sentence of :data:`SENTENCES`."""
    over = OVER["several" if "seeds" in values else "one"].format(**values)
    return SENTENCES[measure, way].format(over=over, **values)


def _direction(low: float, high: float, smallest: float = 0.0) -> Direction:
    if -smallest < low and high < smallest:
        return "same"
    return "better" if low > 0 else "worse" if high < 0 else "unclear"


# --- what is doubtful ---------------------------------------------------------------------------------------


def doubts(metrics: Metrics) -> list[tuple[str, str]]:
    """What is doubtful about the model of a run, and what to do; its baselines' faults are :func:`faults`."""
    ours, models = method(metrics.model), Models.of(metrics)
    found = list(models.doubts(metrics.model))
    for name, one in metrics.below.items():
        if models.counts(gap := max(one.objective, one.nats)):
            are, by = verb(ours, "are", "is"), number(gap)
            text = said("contained", "worse", name=ours, are=are, other=method(name), by=by)
            found.append((text, ADVICE["contained"]))
    count = metrics.demonstrations.train
    if found and metrics.demonstrations.left_out and count < FEW:
        text, advice = found[-1]
        found[-1] = text, f"{advice} {ADVICE['few'].format(count=count, rest=count - 1, least=FEW)}"
    return found


def faults(metrics: Metrics) -> list[tuple[str, str]]:
    """What is doubtful about the baselines of a run, and what to do."""
    models = Models.of(metrics)
    return [found for name in metrics.comparison for found in models.doubts(name)]


# --- the test against the mixture ---------------------------------------------------------------------------


def verdict(metrics: Metrics) -> str:
    """Everything that a run shows of its models, in sentences: doubts first, those about baselines last."""
    names = (method(name) for name, training in metrics.trainings.items() if not training.converged)
    first, last = ([" ".join(pair) for pair in pairs] for pairs in (doubts(metrics), faults(metrics)))
    text = " ".join([*first, explained(metrics), tested(metrics), *last])
    return f"{text}{rising(names)}".replace("  ", " ").strip()


def explained(metrics: Metrics) -> str:
    """How the model explains held-out demonstrations, beside its baselines where there are any."""
    ours, held_out, per_step = method(metrics.model), len(metrics.valid), metrics.log_likelihood_per_step
    name = capital(ours)
    if not held_out:
        fitted, value = verb(name, "were", "was"), number(per_step.train)
        return f"{name} {fitted} fitted to all demonstrations ({value} nats per step); none was held out."
    if not metrics.comparison:
        give, value = verb(name, "give", "gives"), number(per_step.valid)
        known = f"{name} {give} held-out demonstrations {value} nats per step"
        return f"{known}; no baseline was trained to compare with."
    leads = {method(other): one.difference for other, one in metrics.comparison.items()}
    text = Models.of(metrics).explains(name, leads)
    left_out = "Every demonstration trains the model; each is held out from a fit without it."
    return f"{text} {left_out}" if metrics.demonstrations.left_out else text


def tested(metrics: Metrics) -> str:
    """The test of options that last against the mixture, over training seeds where there are several.

    Empty without a mixture, or where either of them fell apart.
    """
    found, seeds, models = metrics.worth, metrics.seeds, Models.of(metrics)
    over = seeds.worth.get("memory") if seeds else None
    if not models.sound() or not (found or over):
        return ""
    brief = all(own.brief for own in metrics.segments)
    short = twitches(metrics.segments, metrics.control_frequency) if brief else ""
    if seeds and over:
        held_out = len(metrics.valid)
        errors = [error for error in seeds.standard_error["memory"] if error is not None]
        error = float(np.mean(errors)) if errors else 0.0
        way, lead = _over_seeds("log_likelihood", over, error, held_out, SMALLEST)
        text = _lasting(way, lead, held_out, short, len(seeds.training_seeds))
    else:
        assert found
        text = models.lasting(found.memory, short)
    return f"{text} {success(metrics)}".strip()


def _over_seeds(
    name: str, values: Sequence[float], error: float, trials: int, smallest: float = 0.0
) -> tuple[Direction, str]:
    """The direction of a difference over training seeds, and its mean with the wider interval, in words.

    :param name: of :data:`~ddco_pyro.metrics.METRICS`.
    :param error: over so many trials, as in :func:`~ddco_pyro.statistics.wider_interval`.
    """
    metric, few = METRICS[name], trials < FEWEST
    low, high = wider_interval(values, error, trials)
    mean = signed(metric.scale * float(np.mean(values)), metric.digits)
    within = "" if few else f" [{interval((low, high), metric.scale, metric.digits)}]"
    return "few" if few else _direction(low, high, smallest), f"{mean}{within} {metric.unit}"


def _lasting(way: Direction, lead: str, held_out: int, brief: str, seeds: int = 1) -> str:
    known: Direction = "brief" if way == "better" and brief else way
    several = {"seeds": str(seeds)} if seeds > 1 else {}
    return said("controls", known, lead=lead, held_out=str(held_out), brief=brief.rstrip("."), **several)


def twitches(segments: Sequence[Segments], frequency: float | None) -> str:
    """How often options of the lowest level switch, in a sentence; the share of twitches if they often do.

    Empty without options.
    """
    if not segments:
        return ""
    own, least = segments[0], "0.5 s" if frequency else "5 steps or a fiftieth of their demonstration"
    each = number(own.number / own.demonstrations, 1)
    text = f"A demonstration has {each} segments of {duration(frequency, own.median)} (the median)"
    if own.often:
        text += f"; {percent(own.twitches / own.number)} of all are twitches, shorter than {least}"
    return f"{text}."


# --- success ------------------------------------------------------------------------------------------------


def success(metrics: Metrics) -> str:
    """Success in rollouts, and the test of options against the mixture by it."""
    rates = metrics.rollouts.success_rates if metrics.rollouts else {}
    if metrics.rollouts is None or metrics.model not in rates:
        return said("success", "few")
    ours = method(metrics.model)
    often = rate(rates.pop(metrics.model), "episodes")
    text = f"In rollouts {ours} {verb(ours, 'succeed', 'succeeds')} in {often}"
    beside = {MIXTURE: rates[MIXTURE]} if MIXTURE in rates else rates
    others = [f"{method(name)} in {rate(summary)}" for name, summary in beside.items()]
    told = f"{text}{'; ' if others else ''}{listed(others) if others else ''}."
    found, seeds = metrics.rollouts.worth, metrics.rollouts.seeds
    if found is None:
        return told
    return f"{told} {_succeeds(found.memory, () if seeds is None else seeds.worth['memory'])}"


def _succeeds(pair: Against, memory: Sequence[float]) -> str:
    """The test by success: of one fit by McNemar's test, or over training seeds, with the episodes' error."""
    lead = pair.only_ours - pair.only_theirs
    if not memory:
        way: Direction = "unclear" if pair.p_value >= 0.05 else "better" if lead > 0 else "worse"
        return said("success", way, lead=f"{of_episodes(pair)} of {pair.trials} episodes")
    error = math.sqrt(pair.only_ours + pair.only_theirs - lead**2 / pair.trials) / pair.trials
    way, points = _over_seeds("success", memory, error, pair.trials)
    return said("success", way, seeds=str(len(memory)), lead=points)


# --- what training took -------------------------------------------------------------------------------------


def effort(training: Training) -> str:
    """The steps of training for tables, with EM or L-BFGS named, marked where training had not converged."""
    name, open_end = _over_all(training), "" if training.converged else ", not converged"
    return f"{training.spent.gradient_steps}{f' ({name})' if name else ''}{open_end}"


def _over_all(training: Training) -> str:
    """The name of an optimiser whose steps are over all demonstrations, and its ridge where it was raised."""
    ridge = "" if training.raised_ridge is None else f", ridge {training.raised_ridge:g}"
    return f"EM{ridge}" if training.by_em else "L-BFGS" if training.by_lbfgs else ""


def recogniser(training: Training) -> str:
    """How much a recogniser's evidence counts; empty without one."""
    own = training.recogniser
    if own is None:
        return ""
    evidence = f"the recogniser {own.weight:g} times (ridge {own.ridge:g})"
    return f"the controls count {own.power:g} times, {evidence}"


def contributions(training: Training) -> dict[str, tuple[float, float]]:
    """What labels, recogniser and policies add: accuracy and edit score of left-out labelled demonstrations.

    Means over ridges, by which the first row was chosen; empty without cross-validation.
    """
    own, pairs = training.recogniser, dict[tuple[float, float], list[Candidate]]()
    for one in () if own is None else own.tried:
        pairs.setdefault((one.power, one.weight), []).append(one)
    if own is None or not pairs:
        return {}
    rows = {
        "labels, recogniser and policies, as chosen": (own.power, own.weight),
        "recogniser with transitions": min(pairs),
        "labels alone": next(pair for pair in pairs if not pair[1]),
    }
    return {
        name: (fmean(one.accuracy for one in pairs[pair]), fmean(one.edit for one in pairs[pair]))
        for name, pair in rows.items()
    }


def spent(training: Training) -> str:
    """Epochs and gradient steps, the budget, and the effort of restarts."""
    took, allowed, beside = training.spent, training.budget, restarts(training)
    of = "" if allowed.epochs is None else f" of at most {allowed.epochs} ({allowed.gradient_steps})"
    steps = _over_all(training) or "gradient"
    return f"{took.epochs} epochs ({took.gradient_steps} {steps} steps){of}{'; ' * bool(beside)}{beside}"


def restarts(training: Training) -> str:
    """Which of several restarts was kept: their starts and objectives, the ones stopped early or diverged,
    their effort, and how their segments agree with those that were kept; empty for a single restart.
    """
    told = training.restarts
    if len(told.each) == 1:
        return ""
    each = enumerate(told.each)
    stopped = {number: one.stopped for number, one in each if one.stopped is not None}
    early = ", ".join(f"{number} after {epochs}" for number, epochs in stopped.items()) or "none"
    ended = ", ".join(str(number) for number, restart in enumerate(told.each) if restart.diverged)
    early += f"; diverged: {ended}" if ended else ""
    every = ", ".join(
        f"{n} from {one.start}{'' if one.objective is None else f': {number(one.objective)}'}"
        for n, one in enumerate(told.each)
    )
    alike = ", ".join(f"{number(one.nmi)} of {n}" for n, one in enumerate(told.each) if one.nmi is not None)
    others = f". NMI of its segments of the training demonstrations with those of the others: {alike}"
    return (
        f"restart {told.best} of {len(told.each)} was kept. Objectives in nats per step: {every}. Stopped "
        f"early, with their epochs of the last stage: {early}. Together they took {told.spent.epochs} epochs "
        f"({told.spent.gradient_steps} gradient steps){others if alike else ''}"
    )


RAISE = "Raise training.epochs: all compared models have this budget, whatever their number of stages."


def unconverged(trainings: Mapping[str, Training]) -> list[tuple[str, str]]:
    """Every model whose budget ended a stage before it converged, in words with numbers, and the remedy."""
    told = []
    for name, training in trainings.items():
        who, stages = method(name), []
        for stage in training.stages:
            nats = number(stage.rising)
            up = f" (tuning log-likelihood up by {nats} nats per step over the last {stage.over})"
            if not stage.converged:
                stages.append(f"stage {stage.stage} after {stage.epochs} epochs{up if stage.epochs else ''}")
        has = f"{capital(who)} {verb(who, 'have', 'has')}"
        first = f"Earlier stages of {who} had" if training.converged else has
        if stages:
            told.append((f"{first} not converged: the budget ended {listed(stages)}.", RAISE))
    return told


def rising(names: Iterable[str]) -> str:
    """A sentence, after a space, on models that have not converged; empty where there are none."""
    rising = list(names)
    return f" Not converged: {listed(rising)}; more epochs may change this result." if rising else ""
