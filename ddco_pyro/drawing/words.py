"""Words for numbers, methods and stages, and the verdict on a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.data.sources.recording import UNKNOWN
from ddco_pyro.metrics import (
    Against,
    Counts,
    Difference,
    Metrics,
    PerStep,
    Rate,
    Rollouts,
    Seeds,
    Stage,
    SuccessWorth,
    Training,
    Worth,
)

CONFIDENCE = 0.95
"""Level of intervals; a difference is significant where its interval excludes 0."""

SMALLEST = 0.01
"""The smallest useful difference in nats per step: each step's control is exp(0.01) times as probable, 1 % more."""

FAR = 2.0
"""Nats per step that no sound model loses from training to held-out demonstrations: a control is e² = 7 times less
probable there."""

NAT = "one nat more per step means that the control of a step is e = 2.7 times as probable"

P_VALUE = "p: McNemar’s exact test, two-sided, not corrected for the number of comparisons."

MIXTURE = "mixture"
FLAT = ("flat", "flat_equal")
"""Flat baselines; a hierarchy is compared with the first one that a fit has."""

METHODS = {
    "ddco": "options",
    "flat": "flat",
    "flat_equal": "flat of equal size",
    "per_timestep": "per-timestep",
    "mixture": "mixture",
    "open_loop": "open loop",
}

ABOUT = {
    "ddco": "policies that stay active until they end",
    "flat": "one policy without options",
    "per_timestep": "a policy for each time step",
    "mixture": "the options’ policies with a new choice at every step (no memory)",
}


def about(names: Iterable[str]) -> str:
    """A sentence that explains the methods."""
    return "; ".join(f"{method(name)}: {ABOUT[name]}" for name in names if name in ABOUT) + "."


def stage(name: str) -> str:
    """A stage of training in words: ``vq-1`` is ``level 1 from clusters``."""
    kind, _, level = name.partition("-")
    whole = {"meta-policy": "meta-policy alone", "joint": "all together", "mixture": "all together without memory"}
    whole |= {"segments": "levels above the lowest from segments", "upper": "levels above the lowest together"}
    how = {"vq": "from clusters", "parts": "from equal parts", "cuts": "from random cuts", "level": "alone"}.get(kind)
    return f"level {level} {how}" if how else whole.get(name, name)


def method(name: str) -> str:
    """A method in words: ``flat_equal`` is ``flat of equal size``."""
    return METHODS.get(name, name.replace("_", " "))


def verb(name: str, many: str, one: str) -> str:
    """The form of a verb after the name of a method."""
    return many if name.lower() == METHODS["ddco"] else one


def option_name(option: int, names: Sequence[str] = ()) -> str:
    """The name of a choice: ``control``, the option's name, or ``option h`` where it has none.

    :param names: of each choice, control first, as in ``fit.names[level]``.
    """
    return names[option] if option < len(names) else f"option {option}" if option else "control"


def numbered_name(option: int, names: Sequence[str] = ()) -> str:
    """``grasp (option 2)``, or ``option 2`` where it has no name."""
    name, number = option_name(option, names), option_name(option)
    return name if name == number else f"{name} ({number})"


def name_in_level(option: int, level: str, names: Sequence[str] = ()) -> str:
    """``grasp``, or ``skill 2`` where option 2 of the level ``skill`` has no name."""
    name = option_name(option, names)
    return f"{level} {option}" if option and name == option_name(option) else name


def label_name(label: str, value: int, names: Sequence[str] = (), level: str = "option") -> str:
    """``grasp`` where the file names label 2 of the labels ``phase``, else ``phase 2``; ``unknown`` for −1.

    Labels that are called as a level's options are are ``label 2``.

    :param names: of labels 0, 1, ...
    """
    if value == UNKNOWN:
        return "unknown"
    named = names[value].strip() if 0 <= value < len(names) else ""
    return named or f"{'label' if label in (level, 'option') else label} {value}"


def choice_names(count: int, named: Sequence[str] = ()) -> tuple[str, ...]:
    """The name of each choice of a level with ``count`` options, control first.

    :param named: the names of the options; empty where they have none.
    """
    return option_name(0), *(named or map(option_name, range(1, 1 + count)))


def number(value: float | None, digits: int = 2) -> str:
    """A number with fixed digits after the point and a real minus sign; a dash for None and NaN."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}"
    return (text.lstrip("-") if float(text) == 0 else text).replace("-", "−")


def signed(value: float, digits: int = 2) -> str:
    """A number as :func:`number` gives it, with a plus sign where it is positive."""
    text = number(value, digits)
    return text if text.startswith(("−", "–")) or float(text) == 0 else f"+{text}"


def percent(value: float | None, digits: int = 0) -> str:
    """A share in percent."""
    return "–" if value is None or not math.isfinite(value) else f"{number(100 * value, digits)} %"


def interval(value: Sequence[float] | None, scale: float = 1.0, digits: int = 2) -> str:
    """``low to high``."""
    return "–" if value is None else f"{number(scale * value[0], digits)} to {number(scale * value[1], digits)}"


def duration(frequency: float | None, *steps: float) -> str:
    """``61 steps``, or ``8 to 29 steps``, with seconds where the frequency (Hz) is known."""
    said = " to ".join(f"{round(count, 2):g}" for count in steps) + (" step" if steps[-1] == 1 else " steps")
    return f"{said}, {' to '.join(f'{count / frequency:.3g}' for count in steps)} s" if frequency else said


def p_value(value: float) -> str:
    """A p-value with two significant digits."""
    return "< 0.001" if value < 0.001 else f"{value:.2g}"


def rate(result: Rate, of: str = "") -> str:
    """``41 of 50 (69 to 90 %)``: successes, trials (with a noun ``of``) and the 95 % interval of the rate."""
    text = f"{result.successes} of {result.trials} {of}".rstrip()
    return text if result.interval is None else f"{text} ({interval(result.interval, 100, 0)} %)"


def measure(name: str) -> str:
    """``accuracy_mm`` as ``Accuracy (mm)``."""
    base, _, unit = name.rpartition("_")
    units = {"mm", "cm", "m", "s", "rad", "deg", "steps"}
    text = f"{base} ({unit})" if base and unit in units else name
    return text.replace("_", " ").capitalize() if "(" not in text else capital(text.replace("_", " "))


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


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
    below = {} if lowest is None else {capital(ours): (method(lowest), flats[lowest])}
    values = {capital(method(name)): _of_parts(one.log_likelihood_per_step) for name, one in metrics.methods.items()}
    return cautions(values, below, len(metrics.valid))


def cautions(
    values: Mapping[str, tuple[float, float]], flats: Mapping[str, tuple[str, Difference]], held_out: int
) -> str:
    """Sentences on the models that fell apart, and on those below flat, with what to do; empty where all are sound.

    A model fell apart that loses more than :data:`FAR` from training to held-out demonstrations. It is below flat where
    the 95 % interval of their difference says so, or by more than that.

    :param values: nats per step of each model in training, and held out.
    :param flats: the difference of a model to a flat one, with that one's name.
    """
    said = [
        f"{name} fell apart on held-out demonstrations: {number(held)} nats per step there, "
        f"{number(trained)} in training."
        for name, (trained, held) in values.items()
        if apart(trained, held)
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


def apart(trained: float, held: float) -> bool:
    """Whether a model with these nats per step in training, and held out, fell apart."""
    return trained - held > FAR


def _of_parts(value: PerStep) -> tuple[float, float]:
    """Nats per step in training, and held out; the same number twice where nothing was held out."""
    return value.train, value.train if value.valid is None else value.valid


def sound(metrics: Metrics) -> bool:
    """Whether differences between the hierarchy and the mixture mean something: neither fell apart."""
    both = (one for name, one in metrics.methods.items() if name in (metrics.model, MIXTURE))
    return not any(apart(*_of_parts(one.log_likelihood_per_step)) for one in both)


def headline(metrics: Metrics) -> str:
    """The verdict in a line: over training seeds where there are several, else of this fit; first :func:`caution`."""
    held_out, seeds = len(metrics.valid), metrics.seeds
    if not sound(metrics):
        return caution(metrics)
    if seeds and "memory" in seeds.worth:
        decided = _verdict(*_range(seeds.worth["memory"], seeds.standard_error["memory"], held_out))
        decided = decided.removeprefix("So ").replace("It is", "it is")
        return f"Over {len(seeds.training_seeds)} training seeds {decided}"
    said = DECIDED[_direction(metrics.worth.memory, held_out)] if metrics.worth else _explained(metrics)
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


def rising(names: Iterable[str]) -> str:
    """A sentence, after a space, on models that have not converged; empty where there are none."""
    rising = list(names)
    return f" Not converged: {listed(rising)}; more epochs may change this result." if rising else ""


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
        said.append(worth(metrics.worth, ours, held_out, sound(metrics), metrics.control_frequency))
    if metrics.seeds:
        said.append(over_seeds(metrics.seeds, ours, held_out, sound(metrics)))
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


DECIDED = {
    1: "In this fit options that last explain held-out controls better; one fit of each model is no verdict.",
    0: "This fit does not show that options that last are worth anything.",
    -1: "In this fit options that last explain held-out controls worse than the same policies without memory.",
}
"""The verdict of one fit on options that last, by the direction of their lead."""


def worth(found: Worth, ours: str, held_out: int, sound: bool = True, frequency: float | None = None) -> str:
    """The worth of several policies and of options that last, in one fit of each model.

    :param ours: what the hierarchy is called.
    :param sound: whether neither model fell apart; otherwise nothing is concluded.
    """
    total = signed(found.total.nats_per_step) if found.total else ""
    parts = _divided(found, ours, f"{total} nats per step", "Held-out nats per step", with_error)
    if not sound:
        return parts
    decided = DECIDED[_direction(found.memory, held_out)]
    rows = found.steps_in_a_row
    if rows and all(row.options <= row.mixture for row in rows):
        own, mixture = (duration(frequency, steps) for steps in (rows[0].options, rows[0].mixture))
        decided += f" Options stay active no longer ({own}) than the mixture keeps to one policy ({mixture})."
    return f"{parts} {decided}"


def success_worth(rollouts: Rollouts, ours: str) -> str:
    """The same worth in rollouts, in this fit and over its training seeds; empty without a mixture.

    The verdict is by :func:`_wider`, with the error over episodes.

    :param ours: what the hierarchy is called.
    """
    found = rollouts.worth
    if found is None:
        return ""
    pair, total = found.memory, _more(found.total) if found.total else ""
    successes = f"uccesses in {pair.trials} episodes"
    text = _divided(found, ours, f"{total} s{successes}", f"S{successes}", of_episodes)
    if rollouts.seeds is None:
        return f"{text} One fit of each model is no verdict."
    seeds = rollouts.seeds
    discordant, lead = pair.only_ours + pair.only_theirs, pair.only_ours - pair.only_theirs
    error = math.sqrt(discordant - lead**2 / pair.trials) / pair.trials
    low, high = _wider(seeds.worth["memory"], error, pair.trials)
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


def mean_and_interval(values: Sequence[float], scale: float = 1, digits: int = 2) -> str:
    """``+1.00 [0.50 to 1.50]``: the mean of a few values with its 95 % t interval."""
    return f"{signed(scale * float(np.mean(values)), digits)} [{interval(mean_interval(values), scale, digits)}]"


def _more(pair: Against) -> str:
    return signed(pair.only_ours - pair.only_theirs, 0)


def of_episodes(pair: Against | None) -> str:
    """A difference in successes with McNemar's exact p-value; a dash for None."""
    if pair is None:
        return "–"
    return f"{_more(pair)} (p = {p_value(pair.p_value)})".replace("= <", "<")


def over_seeds(found: Seeds, ours: str, held_out: int, sound: bool = True) -> str:
    """The parts of the worth over training seeds, and the verdict, which is about options that last.

    :param ours: what the hierarchy is called.
    :param held_out: number of held-out demonstrations.
    :param sound: as of :func:`worth`.
    """
    parts = _parts(found.worth, ours)
    said = f": {listed(parts)} nats per step" if parts else ""
    text = f"Over {len(found.training_seeds)} training seeds, with the same demonstrations held out{said}."
    if "memory" not in found.worth or not sound:
        return text
    return f"{text} {_lasting(found.worth['memory'], found.standard_error['memory'], held_out)}"


def _lasting(memory: Sequence[float], errors: Sequence[float | None], held_out: int) -> str:
    """The verdict on options that last, by :func:`_range` and :data:`SMALLEST`."""
    low, high = _range(memory, errors, held_out)
    wider = high > mean_interval(memory)[1]
    said = f"Over held-out demonstrations it is {interval((low, high))}. " if wider else ""
    return said + _verdict(low, high)


def _range(memory: Sequence[float], errors: Sequence[float | None], held_out: int) -> tuple[float, float]:
    """The interval of the worth of options that last, by :func:`_wider`.

    :param errors: standard errors over held-out demonstrations; None where there is one.
    """
    known = [error for error in errors if error is not None]
    return _wider(memory, float(np.mean(known)) if known else 0.0, held_out)


def _wider(values: Sequence[float], error: float, trials: int) -> tuple[float, float]:
    """The wider of two 95 % t intervals of a mean: over training seeds, and over the trials of one fit.

    Seeds that give nearly the same fit have an interval without width, which is no evidence.

    :param values: the value of each seed.
    :param error: standard error over so many held-out demonstrations or episodes, 0 where it is not known.
    """
    mean = float(np.mean(values))
    half = max(mean_interval(values)[1] - mean, error * _t_quantile(max(trials - 1, 1)))
    return mean - half, mean + half


def _verdict(low: float, high: float) -> str:
    if low > -SMALLEST and high < SMALLEST:
        return f"So options that last make no difference here: less than {SMALLEST} nats per step."
    if low > 0:
        return "So options that last are worth it on these demonstrations."
    if high < 0:
        return "So options that last explain these demonstrations worse than the same policies without memory."
    return "It is inconclusive whether options that last are worth anything here."


def mean_interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """The 95 % t interval of the mean of a few values."""
    mean, count = float(np.mean(values)), len(values)
    half = float(np.std(values, ddof=1) * _t_quantile(count - 1) / math.sqrt(count))
    return mean - half, mean + half


def _t_quantile(freedom: int) -> float:
    """Half the width of a :data:`CONFIDENCE` interval in standard errors, for so many degrees of freedom."""
    from scipy.special import stdtrit  # most commands draw no interval

    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2))


def spread(values: Sequence[float]) -> tuple[str, str, str]:
    """Mean, 95 % t interval of the mean, and range of a few values."""
    return number(float(np.mean(values))), interval(mean_interval(values)), interval((min(values), max(values)))


def with_error(difference: Difference | None, digits: int = 2, unknown: str = "–") -> str:
    """A difference in nats per step with its standard error over held-out demonstrations."""
    if difference is None:
        return unknown
    return f"{signed(difference.nats_per_step, digits)} ± {number(difference.standard_error, digits)}"


def _direction(difference: Difference, held_out: int) -> int:
    """1 or -1 where the 95 % interval of a difference leaves out 0, else 0."""
    mean, error = difference.nats_per_step, difference.standard_error
    if error is None or abs(mean) <= error * _t_quantile(held_out - 1):
        return 0
    return 1 if mean > 0 else -1


def effort(training: Training) -> str:
    """The steps of training for tables, with EM or L-BFGS named, marked where training had not converged."""
    name = _over_all(training)
    return f"{training.spent.gradient_steps}{f' ({name})' * bool(name)}{', not converged' * (not training.converged)}"


def _over_all(training: Training) -> str:
    """The name of an optimiser whose steps are over all demonstrations, and its ridge where that was raised."""
    ridge = "" if training.raised_ridge is None else f", ridge {training.raised_ridge:g}"
    return f"EM{ridge}" if training.by_em else "L-BFGS" if training.by_lbfgs else ""


def spent(training: Training) -> str:
    """Epochs and gradient steps, the budget, and the effort of restarts."""
    took, allowed, beside = training.spent, training.budget, restarts(training)
    of = "" if allowed.epochs is None else f" of at most {allowed.epochs} ({allowed.gradient_steps})"
    steps = _over_all(training) or "gradient"
    return f"{took.epochs} epochs ({took.gradient_steps} {steps} steps){of}{'; ' * bool(beside)}{beside}"


def restarts(training: Training) -> str:
    """The best of several restarts, their starts, the ones stopped early or diverged, their effort and how their
    segments agree with the best one's; empty for a single restart.
    """
    told = training.restarts
    if len(told.each) == 1:
        return ""
    stopped = {number: restart.stopped for number, restart in enumerate(told.each) if restart.stopped is not None}
    early = ", ".join(f"{number} after {epochs}" for number, epochs in stopped.items()) or "none"
    ended = ", ".join(str(number) for number, restart in enumerate(told.each) if restart.diverged)
    early += f"; diverged: {ended}" if ended else ""
    starts = [restart.initialize for restart in told.each]
    every = f"0 to {len(starts) - 1}" + (f" from {starts[0]}" if starts[0] else "")
    if len(set(starts)) > 1:
        every = ", ".join(f"{number} from {start}" for number, start in enumerate(starts))
    alike = ", ".join(f"{number(one.nmi)} of {n}" for n, one in enumerate(told.each) if one.nmi is not None)
    return (
        f"restart {told.best} was the best of {len(starts)} ({every}; stopped early, "
        f"with their epochs of the last stage: {early}), which took {told.spent.epochs} epochs "
        f"({told.spent.gradient_steps} gradient steps) together"
        + (f"; NMI of its segments of the training demonstrations with those of the others: {alike}" if alike else "")
    )


RAISE = "Raise training.epochs: all compared models have this budget, whatever their number of stages."


def unconverged(metrics: Metrics) -> list[tuple[str, str]]:
    """Every model whose budget ended a stage before it converged, in words with the numbers, and the remedy."""
    verdicts = []
    for name, training in metrics.trainings.items():
        stages = [_too_short(stage) for stage in training.stages if not stage.converged]
        if stages:
            who = method(name)
            verdict = (
                f"Earlier stages of {who} had" if training.converged else f"{capital(who)} {verb(who, 'have', 'has')}"
            )
            verdicts.append((f"{verdict} not converged: the budget ended {listed(stages)}.", RAISE))
    return verdicts


def _too_short(stage: Stage) -> str:
    text = f"stage {stage.stage} after {stage.epochs} epochs"
    if not stage.epochs:
        return text
    return f"{text} (tuning log-likelihood up by {number(stage.rising)} nats per step over the last {stage.over})"


def _clause(other: str, difference: Difference, held_out: int) -> str:
    mean, error = difference.nats_per_step, difference.standard_error
    direction = "better" if mean > 0 else "worse"
    if error is None:
        return f"{number(abs(mean))} nats per step {direction} than {other} (error unknown)"
    if not _direction(difference, held_out):
        return f"with no clear difference from {other} ({with_error(difference)} nats per step)"
    return f"{number(abs(mean))} ± {number(error)} nats per step {direction} than {other}"


def listed(items: Iterable[str]) -> str:
    """``a, b and c``."""
    items = list(items)
    return items[0] if len(items) == 1 else ", ".join(items[:-1]) + " and " + items[-1]


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
