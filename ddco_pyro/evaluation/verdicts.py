"""The verdict on a run: whether its options are worth it, in nats per step and in success."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.data.division import FEW
from ddco_pyro.drawing.words import (
    capital,
    duration,
    interval,
    listed,
    mean_and_interval,
    more_successes,
    number,
    of_episodes,
    rate,
    signed,
    verb,
    with_error,
)
from ddco_pyro.evaluation.effort import rising
from ddco_pyro.metrics import Below, Counts, Difference, Metrics, PerStep, Rollouts, Seeds, SuccessWorth, Worth
from ddco_pyro.names import FLAT, MIXTURE, method
from ddco_pyro.statistics import mean_interval, t_quantile, wider_interval

SMALLEST = 0.01
"""The smallest useful difference in nats per step: each step's control is exp(0.01) times as probable, 1 % more."""

FAR = 2.0
"""Nats per step that no sound model loses from training to held-out demonstrations: a control is e² = 7 times less
probable there."""


def verdict(metrics: Metrics) -> str:
    """The verdict on a run: differences on held-out demonstrations, and the models that have not converged."""
    names = (method(name) for name, training in metrics.trainings.items() if not training.converged)
    return f"{caution(metrics)} {_explained(metrics)}{rising(names)}".lstrip()


def caution(metrics: Metrics) -> str:
    """What comes first in a verdict: the models that fell apart, a model below flat, and what to do; else empty.

    The same for several runs is :func:`cautions`.
    """
    flats = {name: metrics.comparison[name].difference for name in FLAT if name in metrics.comparison}
    ours = capital(method(metrics.model))
    lowest = min(flats, key=lambda name: flats[name].nats_per_step, default=None)
    below = {} if lowest is None else {ours: (method(lowest), flats[lowest])}
    values = {capital(method(name)): one.log_likelihood_per_step for name, one in metrics.methods.items()}
    said = cautions(values, below, len(metrics.valid))
    number_of = metrics.demonstrations.train
    said = " ".join(
        [said, *(_below(ours, method(name), one) for name, one in metrics.below.items() if one.told)]
    ).lstrip()
    if said and metrics.demonstrations.left_out and number_of < FEW:
        said += (
            f" {number_of} demonstrations are too few here: each held-out one leaves {number_of - 1} to train with. "
            f"Record at least {FEW}, and until then take two options and the fewest observations."
        )
    return said


def _below(ours: str, mixture: str, below: Below) -> str:
    """A sentence on a hierarchy that is less likely in training than a mixture that it contains."""
    return (
        f"In training {ours.lower()} {verb(ours, 'are', 'is')} less likely than the {mixture} that they contain, by "
        f"{number(max(below.objective, below.nats))} nats per step. Add ways to begin (training.starts)."
    )


def cautions(values: Mapping[str, PerStep], flats: Mapping[str, tuple[str, Difference]], held_out: int) -> str:
    """Sentences on the models that fell apart, and on those below flat, with what to do; empty where all are sound.

    A model fell apart that loses more than :data:`FAR` from training to held-out demonstrations. It is below flat where
    the 95 % interval of their difference says so, or by more than that.

    :param values: of each model.
    :param flats: the difference of a model to a flat one, with that one's name.
    """
    said = [
        f"{name} fell apart on held-out demonstrations: {number(per_step.valid)} nats per step there, "
        f"{number(per_step.train)} in training."
        for name, per_step in values.items()
        if apart(per_step)
    ]
    if said:
        said.append(
            "Such a fit follows its training demonstrations too closely, and comparisons with it say nothing. Take "
            "fewer options or observations, smaller networks, larger ridges (training.optimizer.ridge), or more "
            "demonstrations."
        )
    for name, (flat, difference) in flats.items():
        if _direction(difference, held_out) < 0 or difference.nats_per_step < -FAR:
            by = f"{number(-difference.nats_per_step)} ± {number(difference.standard_error)}"
            said.append(
                f"{name} {verb(name, 'are', 'is')} below {flat} by {by} nats per step on held-out demonstrations. "
                f"Take {flat}, or compare numbers of options and their networks by cross-validation (ddco-pyro select)."
            )
    return " ".join(said)


def apart(per_step: PerStep) -> bool:
    """Whether a model with this log-likelihood fell apart."""
    return per_step.valid is not None and per_step.train - per_step.valid > FAR


def sound(metrics: Metrics) -> bool:
    """Whether differences between the hierarchy and the mixture mean something: neither fell apart."""
    both = (one for name, one in metrics.methods.items() if name in (metrics.model, MIXTURE))
    return not any(apart(one.log_likelihood_per_step) for one in both)


def headline(metrics: Metrics) -> str:
    """The verdict in a line: over training seeds where there are several, else of this fit; first :func:`caution`."""
    held_out, seeds = len(metrics.valid), metrics.seeds
    if not sound(metrics):
        return caution(metrics)
    if seeds and "memory" in seeds.worth:
        said = _verdict(*_range(seeds.worth["memory"], seeds.standard_error["memory"], held_out), brief(metrics))
        said = said.removeprefix("So ").replace("It is", "it is")
        return f"Over {len(seeds.training_seeds)} training seeds {said}"
    said = decided(metrics.worth, held_out, brief(metrics)) if metrics.worth else _explained(metrics)
    return f"{caution(metrics)} {said}".lstrip()


def leads(metrics: Metrics) -> dict[str, str]:
    """Names and values: the leads over baselines in nats per step, over training seeds first, then of this fit."""
    said, seeds, ours = {}, metrics.seeds, method(metrics.model)
    if seeds and (parts := _parts(seeds.worth, ours)):
        said[f"Nats per step, {len(seeds.training_seeds)} seeds"] = ", ".join(parts)
    if metrics.comparison:
        each = (f"{ours} − {method(name)} {with_error(one.difference)}" for name, one in metrics.comparison.items())
        said["Nats per step, held out"] = ", ".join(each)
    return said


def division(counts: Counts) -> str:
    """The numbers of demonstrations that train, tune, and are held out."""
    held_out = "each held out from a fit without it" if counts.left_out else f"{counts.valid} held out"
    return f"{counts.train} for training, {counts.tune} for tuning, {held_out}"


def _explained(metrics: Metrics) -> str:
    ours, held_out, per_step = method(metrics.model), len(metrics.valid), metrics.log_likelihood_per_step
    name = capital(ours)
    if not held_out:
        fitted, value = verb(name, "were", "was"), number(per_step.train)
        return f"{name} {fitted} fitted to all demonstrations ({value} nats per step); none was held out."
    if not metrics.comparison:
        give, value = verb(name, "give", "gives"), number(per_step.valid)
        return f"{name} {give} held-out demonstrations {value} nats per step; no baseline was trained to compare with."
    differences = {method(other): compared.difference for other, compared in metrics.comparison.items()}
    said = [explains(name, differences, held_out)]
    if metrics.demonstrations.left_out:
        said.append("Every demonstration trains the model; each is held out from a fit without it.")
    if metrics.worth:
        said.append(worth_of(metrics))
    if metrics.seeds:
        said.append(over_seeds(metrics.seeds, ours, held_out, sound(metrics), brief(metrics)))
    return " ".join(said)


def explains(name: str, differences: Mapping[str, Difference], held_out: int) -> str:
    """One sentence on the lead of a model over others on held-out demonstrations.

    Its ± is over these demonstrations, for one fit of each model; fits from other seeds vary, too.

    :param differences: the paired difference by the other model's name.
    """
    clauses = [_clause(other, difference, held_out) for other, difference in differences.items()]
    text = f"{name} {verb(name, 'explain', 'explains')} held-out demonstrations {listed(clauses)}"
    if held_out == 1:
        return f"{text} (1 held-out demonstration, one fit of each model)."
    return f"{text} (± is one standard error over {held_out} held-out demonstrations, for one fit of each model)."


def brief(metrics: Metrics) -> str:
    """The median segment in words where the options of every level are too short for skills; else empty."""
    rate = metrics.control_frequency
    short = bool(metrics.segments) and all(one.brief(rate) for one in metrics.segments)
    return duration(rate, metrics.segments[0].median) if short else ""


def decided(found: Worth, held_out: int, brief: str = "") -> str:
    """The verdict of one fit on options that last, by the direction of their lead.

    :param brief: as of :func:`brief`.
    """
    direction = _direction(found.memory, held_out)
    if brief and direction > 0:
        return (
            f"In this fit very short options explain held-out controls better: they switch every {brief}, and are no "
            "skills."
        )
    return DECIDED[direction]


DECIDED = {
    1: "In this fit options that last explain held-out controls better; one fit of each model is no verdict.",
    0: "This fit does not show that options that last are worth anything.",
    -1: "In this fit options that last explain held-out controls worse than the same policies without memory.",
}
"""The verdict of one fit on options that last, by the direction of their lead."""


def worth_of(metrics: Metrics) -> str:
    """:func:`worth` of a run; empty without a mixture."""
    ours, held_out, rate = method(metrics.model), len(metrics.valid), metrics.control_frequency
    return worth(metrics.worth, ours, held_out, sound(metrics), rate, brief(metrics)) if metrics.worth else ""


def worth(
    found: Worth, ours: str, held_out: int, sound: bool = True, frequency: float | None = None, brief: str = ""
) -> str:
    """The worth of several policies and of options that last, in one fit of each model.

    :param ours: what the hierarchy is called.
    :param sound: whether neither model fell apart; otherwise nothing is concluded.
    :param brief: as of :func:`brief`.
    """
    total = signed(found.total.nats_per_step) if found.total else ""
    parts = _divided(found, ours, f"{total} nats per step", "Held-out nats per step", with_error)
    if not sound:
        return parts
    said = decided(found, held_out, brief)
    rows = found.steps_in_a_row
    if rows and all(row.options <= row.mixture for row in rows):
        own, mixture = (duration(frequency, steps) for steps in (rows[0].options, rows[0].mixture))
        said += f" Options stay active no longer ({own}) than the mixture keeps to one policy ({mixture})."
    return f"{parts} {said}"


def success_worth(rollouts: Rollouts, ours: str) -> str:
    """The same worth in rollouts, in this fit and over its training seeds; empty without a mixture.

    The verdict is by :func:`wider_interval`, with the error over episodes.

    :param ours: what the hierarchy is called.
    """
    found = rollouts.worth
    if found is None:
        return ""
    pair, total = found.memory, more_successes(found.total) if found.total else ""
    successes = f"uccesses in {pair.trials} episodes"
    text = _divided(found, ours, f"{total} s{successes}", f"S{successes}", of_episodes)
    if rollouts.seeds is None:
        return f"{text} One fit of each model is no verdict."
    seeds = rollouts.seeds
    discordant, lead = pair.only_ours + pair.only_theirs, pair.only_ours - pair.only_theirs
    error = math.sqrt(discordant - lead**2 / pair.trials) / pair.trials
    low, high = wider_interval(seeds.worth["memory"], error, pair.trials)
    decided = "options that last help" if low > 0 else "options that last harm" if high < 0 else "inconclusive"
    parts = listed(_parts(seeds.worth, ours, 100, 0))
    return f"{text} Over {len(seeds.training_seeds)} training seeds: {parts} points of success. In rollouts: {decided}."


def _divided(found: Worth | SuccessWorth, ours: str, total: str, memory_alone: str, said: Callable[[Any], str]) -> str:
    """The parts of the advantage over a flat policy; the part of memory alone where there is none."""
    lasting = f"{said(found.memory)} from options that last ({ours} − mixture)"
    if found.flat is None:
        return f"{memory_alone}: {lasting}."
    flat = method(found.flat)
    experts = f"{said(found.experts)} come from several policies (mixture − {flat})"
    return f"Of {total} over {flat}, {experts} and {lasting}."


def _parts(worth: Mapping[str, Sequence[float]], ours: str, scale: float = 1, digits: int = 2) -> list[str]:
    """The parts of the worth over training seeds, each with its 95 % t interval."""
    names = {"memory": f"{ours} − mixture", "experts": "mixture − flat"}
    return [f"{names[part]} {mean_and_interval(worth[part], scale, digits)}" for part in worth if part in names]


def over_seeds(found: Seeds, ours: str, held_out: int, sound: bool = True, brief: str = "") -> str:
    """The parts of the worth over training seeds, and the verdict, which is about options that last.

    :param ours: what the hierarchy is called.
    :param held_out: number of held-out demonstrations.
    :param sound: as of :func:`worth`.
    :param brief: as of :func:`brief`.
    """
    parts = _parts(found.worth, ours)
    said = f": {listed(parts)} nats per step" if parts else ""
    text = f"Over {len(found.training_seeds)} training seeds, with the same demonstrations held out{said}."
    if "memory" not in found.worth or not sound:
        return text
    memory = found.worth["memory"]
    low, high = _range(memory, found.standard_error["memory"], held_out)
    wider = f" Over held-out demonstrations it is {interval((low, high))}." if high > mean_interval(memory)[1] else ""
    return f"{text}{wider} {_verdict(low, high, brief)}"


def _range(memory: Sequence[float], errors: Sequence[float | None], held_out: int) -> tuple[float, float]:
    """The interval of the worth of options that last over seeds or, where wider, over held-out demonstrations.

    :param errors: standard errors over held-out demonstrations; None where there is one.
    """
    known = [error for error in errors if error is not None]
    return wider_interval(memory, float(np.mean(known)) if known else 0.0, held_out)


def _verdict(low: float, high: float, brief: str) -> str:
    """The verdict on options that last by the interval of their worth and :data:`SMALLEST`."""
    if low > -SMALLEST and high < SMALLEST:
        return f"So options that last make no difference here: less than {SMALLEST} nats per step."
    if low > 0 and brief:
        return (
            f"So very short options explain these demonstrations better: they switch every {brief}, and are no skills."
        )
    if low > 0:
        return "So options that last are worth it on these demonstrations."
    if high < 0:
        return "So options that last explain these demonstrations worse than the same policies without memory."
    return "It is inconclusive whether options that last are worth anything here."


def _direction(difference: Difference, held_out: int) -> int:
    """1 or -1 where the 95 % interval of a difference leaves out 0, else 0."""
    mean, error = difference.nats_per_step, difference.standard_error
    if error is None or abs(mean) <= error * t_quantile(held_out - 1):
        return 0
    return 1 if mean > 0 else -1


def _clause(other: str, difference: Difference, held_out: int) -> str:
    mean, error = difference.nats_per_step, difference.standard_error
    direction = "better" if mean > 0 else "worse"
    if error is None:
        return f"{number(abs(mean))} nats per step {direction} than {other} (error unknown)"
    if not _direction(difference, held_out):
        return f"with no clear difference from {other} ({with_error(difference)} nats per step)"
    return f"{number(abs(mean))} ± {number(error)} nats per step {direction} than {other}"


def success(metrics: Metrics) -> str:
    """Success in rollouts in one sentence; empty where there are none."""
    rates = metrics.rollouts.success_rates if metrics.rollouts else {}
    if metrics.rollouts is None or metrics.model not in rates:
        return ""
    ours = method(metrics.model)
    text = f"In rollouts {ours} {verb(ours, 'succeed', 'succeeds')} in {rate(rates.pop(metrics.model), 'episodes')}"
    others = [f"{method(name)} in {rate(summary)}" for name, summary in rates.items()]
    said = f"{text}{'; ' if others else ''}{listed(others) if others else ''}."
    return f"{said} {success_worth(metrics.rollouts, ours)}".rstrip()
