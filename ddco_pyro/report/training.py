"""Training in the report: learning curves, what is doubtful, and how the run was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ddco_pyro.data.likeness import reasons_told
from ddco_pyro.drawing.figures import WIDTH, curves
from ddco_pyro.drawing.page import Card, Columns, Drawing, Facts, Section, Text, note
from ddco_pyro.drawing.words import number, rate
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.options import degeneracies
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Rate, read_table, refit
from ddco_pyro.names import method
from ddco_pyro.spec import dump_spec

COLUMNS = 4
LOOKS = ({"stroke": "var(--ink)"}, {"stroke": "#c2410c", "stroke_dasharray": "4 1.5"})
"""Of training and of tuning demonstrations."""

STAGES = {
    "vq": "“From clusters” trains each option of a level on a cluster of steps, so that options differ from "
    "the beginning. Its values can be compared within the panel only.",
    "parts": "“From equal parts” trains each option of a level on one of equally long parts of every "
    "demonstration. Its values can be compared within the panel only.",
    "mixture": "“All together without memory” trains all policies while every option ends after every step.",
    "level": "“Alone” trains a level’s options while all are equally likely.",
    "meta": "“Meta-policy alone” then trains the policy that selects the options.",
    "joint": "“All together” trains all networks.",
}
"""Explanations of stages of training."""


def _stage_name(name: str) -> str:
    """A stage of training in words: ``vq-1`` is ``level 1 from clusters``."""
    kind, _, level = name.partition("-")
    whole = {
        "meta-policy": "meta-policy alone",
        "joint": "all together",
        "mixture": "all together without memory",
        "segments": "levels above the lowest from segments",
        "upper": "levels above the lowest together",
    }
    how = {"vq": "from clusters", "parts": "from equal parts", "level": "alone"}.get(kind)
    return f"level {level} {how}" if how else whole.get(name, name)


def learning(fit: Fit) -> Section | None:
    """Learning curves of the model and its baselines; None where there is no history."""
    stages: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
    for name, one in {fit.name: fit, **fit.baselines}.items():
        path = one.run_folder / "history.csv"
        rows = read_table(path, _epoch, refit(path.parent, "it and metrics.json")) if path.exists() else []
        for stage, restart, values in rows:
            stages.setdefault((name, stage), {}).setdefault(restart, []).append(values)
    if not stages:
        return None
    panels = {
        f"{method(name)}: {_stage_name(stage)}": _cut([np.array(epochs) for epochs in restarts.values()])
        for (name, stage), restarts in stages.items()
    }
    caption = (
        "Log-likelihood per step over epochs of training (solid) and tuning demonstrations (dashed). Each "
        "stage of training has a panel with a scale of its own, and each restart a pair of lines. A steep "
        "start is cut off."
    )
    names = dict.fromkeys(stage for _, stage in stages)
    kinds = dict.fromkeys(name.partition("-")[0] for name in names)
    explained = [STAGES[kind] for kind in kinds if kind in STAGES]
    explained.append(f"In history.csv and on the console the stages are {', '.join(names)}.")
    drawing = Drawing(curves(panels, LOOKS, COLUMNS, WIDTH / COLUMNS), caption)
    return Section("learning", "Learning curves", [drawing, note(" ".join(explained))], folded=True)


def _epoch(row: Mapping[str, str]) -> tuple[str, str, tuple[float, float]]:
    """The stage, the restart, and the log-likelihoods of an epoch."""
    return row["stage"], row["restart"], (float(row["train"]), float(row["tune"]))


def _cut(restarts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Both lines of each restart [E, 2], above a steep rise at first, which would flatten the rest."""
    every = np.concatenate(restarts)
    bottom, top = np.percentile(every, 10), every.max()
    least = top - 3 * (top - bottom) if top > bottom else every.min()
    return [values for epochs in restarts for values in np.maximum(epochs, least).T]


# --- doubts -------------------------------------------------------------------------------------------------


def doubts(fit: Fit) -> list[tuple[str, str]]:
    """What is doubtful about a model, and what to do: its demonstrations, training, likelihood, options."""
    metrics = fit.metrics
    unlike = reasons_told(fit.usual.unlike if fit.usual else {}, len(metrics.demonstrations_by_likelihood))
    found = [*((f"{line}.", "Repair or exclude such ones (demonstrations.exclude).") for line in unlike)]
    found += [*verdicts.unconverged({metrics.model: metrics.training}), *verdicts.doubts(metrics)]
    return [*found, *(degeneracies(metrics, fit.spec, fit.names) if fit.spec.hierarchy else ())]


# --- particulars --------------------------------------------------------------------------------------------


def particulars(fit: Fit) -> Section:
    """Demonstrations, parameters, effort, seconds, engine check, versions and the spec."""
    seconds = {name: number(value, 1) for name, value in fit.metrics.seconds.items()}
    check = {name: f"{value:.1e}" for name, value in dict(fit.metrics.engine_check).items()}
    differences = "Largest relative difference of the two inference engines."
    counts, supervisor = fit.metrics.demonstrations, fit.metrics.demonstrations.supervisor.get("success")
    model = {"Parameters": str(fit.metrics.parameters), "Training": verdicts.spent(fit.metrics.training)}
    held_out = "each held out from a fit without it" if counts.left_out else f"{counts.valid} held out"
    model["Demonstrations"] = f"{counts.train} for training, {counts.tune} for tuning, {held_out}"
    if isinstance(supervisor, Rate):
        model["Supervisor’s own success"] = f"{rate(supervisor, 'demonstrations')}, 95 % interval"
    facts = [
        Facts(seconds, "Seconds"),
        Facts(check, "Engine check", differences),
        Facts(fit.metrics.versions, "Versions"),
    ]
    spec = Card("The whole spec, with its defaults", [Text(dump_spec(fit.spec), "code")], folded=True)
    return Section("particulars", "How this run was made", [Facts(model), Columns(facts), spec], folded=True)
