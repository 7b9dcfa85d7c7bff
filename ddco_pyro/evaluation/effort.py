"""What training took, and the stages that the budget ended too early, in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import fmean

from ddco_pyro.drawing.words import capital, listed, number, verb
from ddco_pyro.metrics import Candidate, Stage, Training
from ddco_pyro.names import method


def effort(training: Training) -> str:
    """The steps of training for tables, with EM or L-BFGS named, marked where training had not converged."""
    name = _over_all(training)
    return f"{training.spent.gradient_steps}{f' ({name})' * bool(name)}{', not converged' * (not training.converged)}"


def _over_all(training: Training) -> str:
    """The name of an optimiser whose steps are over all demonstrations, and its ridge where that was raised."""
    ridge = "" if training.raised_ridge is None else f", ridge {training.raised_ridge:g}"
    return f"EM{ridge}" if training.by_em else "L-BFGS" if training.by_lbfgs else ""


def recogniser(training: Training) -> str:
    """How much a recogniser's evidence counts; empty without one."""
    own = training.recogniser
    if own is None:
        return ""
    return f"the controls count {own.power:g} times, the recogniser {own.weight:g} times (ridge {own.ridge:g})"


def contributions(training: Training) -> dict[str, tuple[float, float]]:
    """What labels, recogniser and policies contribute: accuracy and edit score of left-out labelled demonstrations.

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
    """Which of several restarts was kept: their starts and objectives, the ones stopped early or diverged, their
    effort, and how their segments agree with those that were kept; empty for a single restart.
    """
    told = training.restarts
    if len(told.each) == 1:
        return ""
    stopped = {number: restart.stopped for number, restart in enumerate(told.each) if restart.stopped is not None}
    early = ", ".join(f"{number} after {epochs}" for number, epochs in stopped.items()) or "none"
    ended = ", ".join(str(number) for number, restart in enumerate(told.each) if restart.diverged)
    early += f"; diverged: {ended}" if ended else ""
    every = ", ".join(
        f"{n} from {one.start}{'' if one.objective is None else f': {number(one.objective)}'}"
        for n, one in enumerate(told.each)
    )
    alike = ", ".join(f"{number(one.nmi)} of {n}" for n, one in enumerate(told.each) if one.nmi is not None)
    return (
        f"restart {told.best} of {len(told.each)} was kept. Objectives in nats per step: {every}. Stopped early, with "
        f"their epochs of the last stage: {early}. Together they took {told.spent.epochs} epochs "
        f"({told.spent.gradient_steps} gradient steps)"
        + (f". NMI of its segments of the training demonstrations with those of the others: {alike}" if alike else "")
    )


RAISE = "Raise training.epochs: all compared models have this budget, whatever their number of stages."


def unconverged(trainings: Mapping[str, Training]) -> list[tuple[str, str]]:
    """Every model whose budget ended a stage before it converged, in words with the numbers, and the remedy."""
    verdicts = []
    for name, training in trainings.items():
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


def rising(names: Iterable[str]) -> str:
    """A sentence, after a space, on models that have not converged; empty where there are none."""
    rising = list(names)
    return f" Not converged: {listed(rising)}; more epochs may change this result." if rising else ""
