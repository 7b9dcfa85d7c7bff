"""Training in the report: learning curves, what is doubtful, and how the run was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ddco_pyro.data.likeness import reasons_told
from ddco_pyro.drawing.figures import INK, blank, save
from ddco_pyro.drawing.page import Code, Columns, Facts, Folded, Section, note
from ddco_pyro.drawing.words import number, rate
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.options import degeneracies
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Counts, Rate, read_table, refit
from ddco_pyro.names import method
from ddco_pyro.spec import dump_spec

COLUMNS = 4
TUNE = "#c2410c"

STAGES = {
    "vq": "“From clusters” trains each option of a level on a cluster of steps, so that options differ from the "
    "beginning. Its values can be compared within the panel only.",
    "parts": "“From equal parts” trains each option of a level on one of equally long parts of every demonstration. "
    "Its values can be compared within the panel only.",
    "mixture": "“All together without memory” trains all policies while every option ends after every step.",
    "level": "“Alone” trains a level’s options while all are equally likely.",
    "meta": "“Meta-policy alone” then trains the policy that selects the options.",
    "joint": "“All together” trains all networks.",
}
"""Explanations of stages of training."""


def _stage_name(name: str) -> str:
    """A stage of training in words: ``vq-1`` is ``level 1 from clusters``."""
    kind, _, level = name.partition("-")
    whole = {"meta-policy": "meta-policy alone", "joint": "all together", "mixture": "all together without memory"}
    whole |= {"segments": "levels above the lowest from segments", "upper": "levels above the lowest together"}
    how = {"vq": "from clusters", "parts": "from equal parts", "level": "alone"}.get(kind)
    return f"level {level} {how}" if how else whole.get(name, name)


@dataclass(frozen=True)
class Curves:
    """One stage of one model: for each restart an array of (epoch, train, tune) [E, 3], nats per step."""

    model: str
    stage: str
    restarts: Sequence[np.ndarray]

    @property
    def title(self) -> str:
        """Model and stage in words."""
        return f"{method(self.model)}: {_stage_name(self.stage)}"


def learning(fit: Fit) -> Section | None:
    """Learning curves of the model and its baselines; None where there is no history."""
    fits = {fit.name: fit, **fit.baselines}
    paths = {name: one.run_folder / "history.csv" for name, one in fits.items()}
    curves = read_curves({name: path for name, path in paths.items() if path.exists()})
    if not curves:
        return None
    caption = (
        "Log-likelihood per step over epochs. Each stage of training has a panel with a scale of its own, and each "
        "restart a pair of lines. A steep start may be cut off."
    )
    alt = "Learning curves of the stages " + ", ".join(curve.title for curve in curves)
    names = list(dict.fromkeys(curve.stage for curve in curves))
    kinds = dict.fromkeys(name.partition("-")[0] for name in names)
    explained = [STAGES[kind] for kind in kinds if kind in STAGES]
    explained.append(f"In history.csv and on the console the stages are {', '.join(names)}.")
    picture = save(draw_curves(curves), fit.run_folder / "figures" / "learning.png", alt, caption)
    return Section("learning", "Learning curves", [picture, note(" ".join(explained))], folded=True)


def read_curves(histories: Mapping[str, Path]) -> list[Curves]:
    """The stages in ``history.csv`` of each model, in the order of training."""
    curves = []
    for model, path in histories.items():
        rows = read_table(path, _epoch, refit(path.parent, "it and metrics.json"))
        for stage in dict.fromkeys(stage for stage, _, _ in rows):
            own = [(restart, values) for name, restart, values in rows if name == stage]
            numbers = dict.fromkeys(restart for restart, _ in own)
            restarts = [np.array([values for restart, values in own if restart == number]) for number in numbers]
            curves.append(Curves(model, stage, restarts))
    return curves


def _epoch(row: Mapping[str, str]) -> tuple[str, int, list[float]]:
    """The stage, restart and numbers of an epoch."""
    return row["stage"], int(row["restart"]), [float(row[key]) for key in ("epoch", "train", "tune")]


def draw_curves(curves: Sequence[Curves]) -> Figure:
    """A panel for each stage, a pair of lines for each restart."""
    columns = min(COLUMNS, len(curves))
    rows = -(-len(curves) // columns)
    figure = blank(0.4 + 2.1 * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes, stage in zip(panels.flat, curves, strict=False):
        _panel(axes, stage)
    for axes in panels.flat[len(curves) :]:
        axes.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel("nats per step")
    lines = [Line2D([], [], color=INK), Line2D([], [], color=TUNE, linestyle=(0, (4, 1.5)))]
    figure.legend(lines, ["training demonstrations", "tuning demonstrations"], loc="outside lower center", ncols=2)
    return figure


def _panel(axes: Axes, stage: Curves) -> None:
    alpha = 1.0 if len(stage.restarts) == 1 else 0.6
    for curve in stage.restarts:
        axes.plot(curve[:, 0], curve[:, 1], color=INK, linewidth=1.1, alpha=alpha)
        axes.plot(curve[:, 0], curve[:, 2], color=TUNE, linewidth=1.1, alpha=alpha, linestyle=(0, (4, 1.5)))
    limits = _limits(np.concatenate([curve[:, 1:] for curve in stage.restarts]))
    axes.set(title=stage.title, xlabel="epoch", ylim=limits)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Limits that cut off a steep rise of the first epochs, which would flatten the rest."""
    low, bottom, top = float(values.min()), float(np.percentile(values, 10)), float(values.max())
    if top - low > 3 * (top - bottom) > 0:
        low = top - 3 * (top - bottom)
    margin = 0.05 * (top - low) or 1.0
    return low - margin, top + margin


# --- doubts -----------------------------------------------------------------------------------------------------------


def doubts(fit: Fit) -> list[tuple[str, str]]:
    """What is doubtful about a model, and what to do: its demonstrations, training, likelihood, and options."""
    metrics = fit.metrics
    unlike = reasons_told(fit.usual.unlike if fit.usual else {}, len(metrics.demonstrations_by_likelihood))
    found = [*((f"{line}.", "Repair or exclude such ones (demonstrations.exclude).") for line in unlike)]
    found += [*verdicts.unconverged({metrics.model: metrics.training}), *verdicts.doubts(metrics)]
    return [*found, *(degeneracies(metrics, fit.spec, fit.names) if fit.spec.hierarchy else ())]


SOUND = (
    "Training converged, and the model predicts held-out controls better than the mean and the spread of each control "
    "do. Every option is used (at least 1 % of all steps) and none dominates (more than 90 %). No two options act "
    "alike (differ by less than 0.1 nats per step). No option ends at once again and again (lasts less than 1.5 steps, "
    "with three selections or more in a demonstration). No option takes some demonstrations whole (at least 90 % of "
    "their steps, or two thirds of no more than half of the demonstrations). Options do not switch all the time (six "
    "segments or more in a demonstration, most of them below 0.5 s, or 5 steps or a fiftieth of their demonstration "
    "where the rate is unknown). No caller emits the control itself most of the time."
)
"""What was looked at where nothing is doubtful."""


# --- particulars ------------------------------------------------------------------------------------------------------


def held_out(counts: Counts) -> str:
    """``10 held out``: the demonstrations that no model of the run was trained on."""
    return "each held out from a fit without it" if counts.left_out else f"{counts.valid} held out"


def particulars(fit: Fit) -> Section:
    """Demonstrations, parameters, effort, seconds, engine check, versions and the spec."""
    seconds = {name: number(value, 1) for name, value in fit.metrics.seconds.items()}
    check = {name: f"{value:.1e}" for name, value in dict(fit.metrics.engine_check).items()}
    differences = "Largest relative difference of the two inference engines."
    counts, supervisor = fit.metrics.demonstrations, fit.metrics.demonstrations.supervisor.get("success")
    model = {"Parameters": str(fit.metrics.parameters), "Training": verdicts.spent(fit.metrics.training)}
    model["Demonstrations"] = f"{counts.train} for training, {counts.tune} for tuning, {held_out(counts)}"
    if isinstance(supervisor, Rate):
        model["Supervisor’s own success"] = f"{rate(supervisor, 'demonstrations')}, 95 % interval"
    facts = [
        Facts(seconds, "Seconds"),
        Facts(check, "Engine check", differences),
        Facts(fit.metrics.versions, "Versions"),
    ]
    spec = Folded("The whole spec, with its defaults", [Code(dump_spec(fit.spec))])
    return Section("particulars", "How this run was made", [Facts(model), Columns(facts), spec], folded=True)
