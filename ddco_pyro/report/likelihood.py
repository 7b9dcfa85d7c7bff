"""Log-likelihood in the report: of each method, of each demonstration, of each control dimension."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ddco_pyro.drawing.figures import Interval, Panel, interval_plot, save
from ddco_pyro.drawing.page import Block, Cell, Section, Table, Text, Warned, footnote, note
from ddco_pyro.drawing.words import (
    NAT,
    about,
    capital,
    duration,
    listed,
    number,
    of_episodes,
    over_seeds,
    with_error,
)
from ddco_pyro.evaluation.verdicts import effort, explained, faults, tested, unconverged, verdict
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Compared, Metrics
from ddco_pyro.names import method
from ddco_pyro.segmenting.page import anchor

SHOWN = 20
"""Rows of the list of demonstrations that are not folded."""


def section(fit: Fit) -> Section:
    """Log-likelihood of the model and its baselines."""
    metrics = fit.metrics
    valid = {method(name): number(one.log_likelihood_per_step.valid) for name, one in metrics.methods.items()}
    alt = "; ".join(f"{name}: {value} nats per step held out" for name, value in valid.items())
    caption = "Log-likelihood of the model. Filled circle: held out; open circle: training."
    per_step = [one.log_likelihood_per_step for one in metrics.methods.values()]
    values = [Interval(np.nan if one.valid is None else one.valid, hollow=one.train) for one in per_step]
    panels = [Panel("Each method", "log-likelihood (nats per step)", values)]
    if metrics.comparison:
        differences: list[Interval | None] = [None]
        for name, other in metrics.comparison.items():
            theirs = fit.baselines[name].held_out
            each = [(one.log_likelihood - theirs[one.name]) / one.steps for one in metrics.valid]
            differences.append(Interval.of(other.difference, each))
        title = f"{method(metrics.model)} minus each baseline"
        panels.append(Panel(title, "nats per step above that method, held out", differences, line=0))
        caption = (
            "Left: log-likelihood of each method; filled circle: held out, open circle: training. Right: the "
            "model’s minus each baseline’s on the same held-out demonstrations; circle: mean with one "
            "standard error, dots: single demonstrations."
        )
    units = (
        "Continuous control dimensions have log-densities in the control’s units; switches and bounds have "
        "log-probabilities. Another unit adds the same constant to every method. So differences in nats can "
        "be compared; percentages cannot."
    )
    figure = interval_plot(list(map(method, metrics.methods)), panels, alt)
    blocks: list[Block] = [
        Text(verdict(metrics)),
        Text(f"Nats per step; higher is better. {about(metrics.methods)} {stds(fit)}"),
        table(metrics),
        save(figure, fit.run_folder / "figures" / "likelihood.svg", caption),
        note(units),
    ]
    return Section("likelihood", "Held-out log-likelihood", blocks, folded=True)


def stds(fit: Fit) -> str:
    """A sentence on the σ of each model; empty where σ is fixed or all have it in one way."""
    ways: dict[str, list[str]] = {}
    for name, spec in {fit.name: fit.spec, **{name: one.spec for name, one in fit.baselines.items()}}.items():
        of_option = "one σ for each option" if spec.hierarchy else "one σ"
        kinds = spec.control.learned_stds.values()
        each = (
            "a σ that depends on the state" if std.per_state else of_option if std.per_option else "one σ"
            for std in kinds
        )
        ways.setdefault(" or ".join(dict.fromkeys(each)), []).append(method(name))
    each_way = (f"{listed(own)} {'has' if len(own) == 1 else 'have'} {way}" for way, own in ways.items())
    return f"{capital('; '.join(each_way))}." if len(ways) > 1 else ""


def table(metrics: Metrics, digits: int = 2, title: str | None = None) -> Table:
    """Log-likelihood of each method, the paired difference, parameters and gradient steps."""
    rows = []
    for name, one in metrics.methods.items():
        values, size = one.log_likelihood_per_step, str(one.parameters)
        difference = with_error(one.difference, digits) if isinstance(one, Compared) else ""
        each = number(values.valid, digits), number(values.train, digits), difference
        rows.append([method(name), *each, size, effort(one.training)])
    ours = f"{method(metrics.model)} minus it, held out"
    return Table(["Method", "Held out", "Training", ours, "Parameters", "Gradient steps"], rows, title=title)


def demonstrations(metrics: Metrics, anchors: Collection[str]) -> Section:
    """Log-likelihood of every demonstration, the least likely first.

    :param anchors: the timelines on the page.
    """
    entries = metrics.demonstrations_by_likelihood
    methods = list(entries[0].log_likelihood_per_step)
    rows = []
    for entry in entries:
        place, held_out = anchor(entry.name), entry.part == "valid"
        name = Cell(entry.name, link=f"#{place}" if place in anchors else "")
        mark = Cell("held out" if held_out else "", mark=held_out)
        length = duration(metrics.control_frequency, entry.steps)
        rows.append([name, mark, length, *(number(entry.log_likelihood_per_step[m]) for m in methods)])
    text = (
        "Log-likelihood of each demonstration, nats per step. The least likely under "
        f"{method(metrics.model)} comes first: it is unlike the others, or the model fits it poorly."
    )
    found = Table(["Demonstration", "", "Length", *map(method, methods)], rows, {0, 1})
    links = " A name leads to the demonstration’s segments." if anchors else ""
    blocks = [Text(text + links), *found.folded(SHOWN, "demonstrations")]
    return Section("demonstrations", "Every demonstration", blocks, folded=True)


def dimensions(fit: Fit) -> Section:
    """Contributions of each control dimension, and of choosing options, to each method's log-likelihood."""
    metrics = fit.metrics
    methods = {metrics.model: metrics} | {name: other.metrics for name, other in fit.baselines.items()}
    parts = {name: own.log_likelihood_by_dimension for name, own in methods.items()}
    held_out = metrics.log_likelihood_by_dimension.valid is not None
    values = {name: found.valid or found.train for name, found in parts.items()}
    rows = []
    for dimension in metrics.control_dimensions:
        each = [number(value.by_dimension[dimension.number]) for value in values.values()]
        kind = str(metrics.measure.get(str(dimension.number), [""])[0])
        rows.append([str(dimension.number), *each, kind, dimension.note])
    totals = [sum(filter(None, value.by_dimension)) + value.options for value in values.values()]
    rows += [["options", *(number(value.options) for value in values.values()), "", ""]]
    rows += [["sum", *map(number, totals), "", ""]]
    head = ["Control dimension", *map(method, values), "Modelled as", "In the demonstrations"]
    explained = (
        "The log-density of each dimension under the active options, averaged over their posterior. "
        "“options”: the cost of choosing and ending options, which is minus the divergence of that posterior "
        "from the model before it sees the controls. The sum is the log-likelihood. The density of a "
        "gaussian dimension that often takes one exact value grows without bound as σ shrinks; a large "
        "number there is no sign of a better model. Clipped and binary dimensions have probabilities at such "
        "values."
    )
    shown = "held-out" if held_out else "training"
    text = f"Nats per step on {shown} demonstrations."
    blocks: list[Block] = [Text(text), Table(head, rows, {0, len(head) - 2, len(head) - 1}), note(explained)]
    return Section("dimensions", "Log-likelihood by control dimension", blocks, folded=True)


# --- the test against the mixture ---------------------------------------------------------------------------


EXPLAINED = (
    f"A nat is the unit of log-likelihood: {NAT}. A mixture has the options’ policies and the gate that "
    "chooses among them, and chooses anew at every step. Mixture − flat: what several policies, and their "
    "parameters, add to one. Options − mixture: what options that last add. This fit: ± one standard error "
    "over held-out demonstrations, p by McNemar’s exact test. Training seeds: mean with its 95 % interval."
)


def test(metrics: Metrics) -> Section | None:
    """Options against the mixture, or a model against its baselines: a sentence and a table; else None."""
    if not metrics.comparison:
        return None
    found, blocks = parts(metrics), list[Block]()
    blocks.append(Text(tested(metrics) if found and tested(metrics) else explained(metrics)))
    blocks.append(found or table(metrics))
    others = {name: one.training for name, one in metrics.comparison.items()}
    blocks += [Warned(*sign) for sign in (*faults(metrics), *unconverged(others))]
    held_out = "used neither in training nor in tuning, which decides when to stop"
    if metrics.demonstrations.left_out:
        held_out = "each demonstration by the fit that was trained and tuned without it"
    title = "Options against the mixture" if found else "The model against its baselines"
    return Section("test", title, [*blocks, footnote(f"Held out: {held_out}. {EXPLAINED}")])


def parts(metrics: Metrics) -> Table | None:
    """What several policies and what lasting adds, in log-likelihood and success; None without a mixture."""
    found, seeds, rollouts = metrics.worth, metrics.seeds, metrics.rollouts
    if not found:
        return None
    ours, flat = method(metrics.model), method(found.flat or "flat")
    parts = {
        "experts": f"Several policies: mixture − {flat}",
        "memory": f"Options that last: {ours} − mixture",
        "total": f"Together: {ours} − {flat}",
    }
    columns = {"Nats per step, this fit": {part: with_error(getattr(found, part)) for part in parts}}
    if seeds:
        each = {part: over_seeds("log_likelihood", values) for part, values in seeds.worth.items()}
        columns[f"Nats per step, {len(seeds.training_seeds)} training seeds"] = each
    if rollouts and rollouts.worth:
        column = f"Successes of {rollouts.episodes} episodes, this fit"
        columns[column] = {part: of_episodes(getattr(rollouts.worth, part)) for part in parts}
    if rollouts and rollouts.seeds:
        each = {part: over_seeds("success", values) for part, values in rollouts.seeds.worth.items()}
        columns[f"Points of success, {len(rollouts.seeds.training_seeds)} training seeds"] = each
    known = [(part, name) for part, name in parts.items() if getattr(found, part)]
    rows = [[name, *(values.get(part, "–") for values in columns.values())] for part, name in known]
    return Table(["Part", *columns], rows)
