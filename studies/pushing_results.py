"""What came of a pushing study: every cell as a row of a CSV, the means over seeds as Markdown, and a figure."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from provenance import Record, sentence, text
from pushing_cell import EPISODES, Cell, fit_made_by
from scipy import stats

from ddco_pyro.data.files import whole_file, write_text
from ddco_pyro.errors import Failed

COLOURS = {
    "flat linear": "#9a9a9a",
    "flat MLP": "#3f6fb0",
    "flat MLP, equal parameters": "#79a8d9",
    "DDCO linear": "#d98f3f",
    "DDCO MLP": "#b03f4a",
    "hybrid MLP": "#4f8f4a",
}
Row = dict[str, Any]


def rows_of(cells: Sequence[Cell], folder: Path) -> list[Row]:
    """What is known of the cells that have been rolled out."""
    found = []
    for cell in cells:
        rollout, fit = folder / "rollouts" / f"{cell.name}.json", folder / "fits" / f"{cell.fit}.json"
        if not rollout.exists():
            continue
        row: Row = asdict(cell) | json.loads(fit.read_text())
        row.pop("made_by", None)
        row |= {f"log_likelihood_{part}": value for part, value in row.pop("log_likelihood_per_step").items()}
        row |= _means(json.loads(rollout.read_text()), "")
        limited = folder / "limited" / f"{cell.name}.json"
        row |= _means(json.loads(limited.read_text()) if limited.exists() else {}, "limited_")
        found.append(row)
    return found


def made_by(cells: Sequence[Cell], folder: Path) -> list[Record | None]:
    """What fitted and rolled out the cells that are done; None for what was before that was recorded."""
    rolled = [cell for cell in cells if (folder / "rollouts" / f"{cell.name}.json").exists()]
    paths = [folder / what / f"{cell.name}.json" for cell in rolled for what in ("rollouts", "limited")]
    return [
        *(fit_made_by(cell, folder) for cell in rolled),
        *(json.loads(path.read_text()).get("made_by") for path in paths if path.exists()),
    ]


def _means(found: dict[str, Any], prefix: str) -> Row:
    """Means over the episodes, and what is one number already."""
    row: Row = {f"{prefix}{key}": np.mean(found[key]) if found else None for key in ("goals", "topples", "lost")}
    if not prefix:
        row |= {"success": float(np.mean(np.array(found["goals"]) > 0))}
        row |= {key: found[key] for key in ("dwell", "own_control")}
    return row


def over_seeds(rows: Sequence[Row], measure: str) -> tuple[float, float, int]:
    """Mean over training seeds, half of its 95 % t interval (NaN for a single seed), and the number of seeds."""
    values = [row[measure] for row in rows if row[measure] is not None]
    if len(values) < 2:
        return (float(values[0]) if values else np.nan), np.nan, len(values)
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return float(np.mean(values)), float(half), len(values)


def grouped(rows: Sequence[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by the values of some columns, in the order of their first appearance."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def write(study: str, cells: Sequence[Cell], folder: Path, out: Path, command: str) -> str:
    """NAME.csv, NAME.md and NAME.png of the cells that are done, and NAME.json, which says what made them; the page."""
    rows = rows_of(cells, folder)
    if not rows:
        raise Failed(f"{study}: nothing has been measured yet")
    rows_text = io.StringIO()
    writer = csv.DictWriter(rows_text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(out / f"{study}.csv", rows_text.getvalue())
    describe, draw = STUDIES[study]
    supervisor = _supervisor(out)
    whole = "What commands with other parts of the grid have measured is in the table, too."
    records = made_by(cells, folder)
    head = [f"{sentence(command, records)} {whole}", "", _protocol(supervisor), ""]
    write_text(out / f"{study}.json", text(None, records))
    page = "\n".join([*head, *describe(rows)]) + "\n"
    write_text(out / f"{study}.md", page)
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, rows, supervisor)
    with whole_file(out / f"{study}.png") as temporary:
        figure.savefig(temporary, dpi=120, format="png")
    return page


def _supervisor(out: Path) -> float | None:
    """The level of the supervisor that was recorded, with an exact hand."""
    path = out / "supervisors.json"
    return (
        float(json.loads(path.read_text())["results"]["supervisors"]["scripted"]["goals"]["mean"])
        if path.exists()
        else None
    )


def _protocol(supervisor: float | None) -> str:
    level = "" if supervisor is None else f" The supervisor itself: {supervisor:.1f} goals."
    return (
        f"Every training seed has its own demonstrations; {EPISODES} episodes of 2000 steps for each fit. Means over "
        f"training seeds with 95 % t intervals; the last column is the number of seeds.{level}"
    )


def cell_text(rows: Sequence[Row], measure: str, form: str = "{:.1f}") -> str:
    """A mean and its interval in a few characters."""
    mean, half, seeds = over_seeds(rows, measure)
    if not seeds:
        return "-"
    return form.format(mean) + ("" if np.isnan(half) else f" ± {form.format(half)}")


def table(rows: Sequence[Row], columns: dict[str, tuple[str, str]], *keys: str) -> list[str]:
    """A Markdown table: one line for each group, one column for each measure (title to measure and format)."""
    lines = [f"| {' | '.join([*keys, *columns, 'seeds'])} |", "|" + "---|" * (len(keys) + len(columns) + 1)]
    for group, own in grouped(rows, *keys).items():
        cells = [cell_text(own, *column) for column in columns.values()]
        lines.append(f"| {' | '.join([*map(str, group), *cells, str(len(own))])} |")
    return lines


def curve(axes: Axes, rows: Sequence[Row], across: str, measure: str, method: str) -> None:
    """Mean with its interval against a column."""
    groups = grouped(sorted(rows, key=lambda row: row[across]), across)
    found = [over_seeds(own, measure) for own in groups.values()]
    places = [key[0] for key in groups]
    means, halves = [f[0] for f in found], [f[1] for f in found]
    axes.errorbar(places, means, halves, color=COLOURS[method], label=method, marker="o", ms=4, capsize=2, lw=1.5)


GOALS = {
    "goals": ("goals", "{:.1f}"),
    "goals, 250 steps each at most": ("limited_goals", "{:.1f}"),
    "topples": ("topples", "{:.1f}"),
    "lost": ("lost", "{:.1f}"),
    "held-out nats/step": ("log_likelihood_held_out", "{:.3f}"),
    "steps an option lasts": ("dwell", "{:.0f}"),
    "parameters": ("parameters", "{:.0f}"),
}


def describe_complexity(rows: Sequence[Row]) -> list[str]:
    """The table against the number of demonstrations."""
    lines = [*table(rows, GOALS, "method", "demonstrations"), "", *_sigma(rows), ""]
    for other in ("flat MLP", "flat MLP, equal parameters"):
        lines += _differences(rows, "DDCO MLP", other)
        lines += _with_half(rows, "DDCO MLP", other)
    return lines


def _with_half(rows: Sequence[Row], ours: str, theirs: str) -> list[str]:
    """Goals of one method minus another's with twice the demonstrations, over seeds."""
    found = {(row["method"], row["demonstrations"], row["seed"]): row for row in rows}
    lines = []
    for count in sorted({row["demonstrations"] for row in rows}):
        pairs = [
            (found[ours, count // 2, seed], row)
            for (method, twice, seed), row in found.items()
            if (method, twice) == (theirs, count) and (ours, count // 2, seed) in found and count % 2 == 0
        ]
        if pairs:
            what = f"{ours} with {count // 2} demonstrations minus {theirs} with {count}"
            lines.append(f"- {what}, paired by seed ({len(pairs)}): {_goals(pairs)}.")
    return lines


def _differences(rows: Sequence[Row], ours: str, theirs: str) -> list[str]:
    """Goals and held-out log-likelihood of one method minus another's on the same demonstrations, over seeds."""
    lines = []
    for (count,), own in grouped(rows, "demonstrations").items():
        by_name = [{row["method"]: row for row in pair} for pair in grouped(own, "seed").values()]
        pairs = [(pair[ours], pair[theirs]) for pair in by_name if {ours, theirs} <= set(pair)]
        if pairs:
            likelihood = _difference(pairs, "log_likelihood_held_out", "{:.3f}")
            lines.append(
                f"- {ours} minus {theirs}, {count} demonstrations, paired by seed ({len(pairs)}): {_goals(pairs)}, "
                f"{likelihood} held-out nats/step."
            )
    return lines


def _goals(pairs: Sequence[tuple[Row, Row]]) -> str:
    """The differences in goals, without and (where it was measured) with a limit."""
    limited = _difference(pairs, "limited_goals")
    return f"{_difference(pairs, 'goals')} goals" + (f" ({limited} with the limit)" if limited != "-" else "")


def _difference(pairs: Sequence[tuple[Row, Row]], measure: str, form: str = "{:.1f}") -> str:
    both = [(ours[measure], theirs[measure]) for ours, theirs in pairs]
    return cell_text([{measure: one - other} for one, other in both if None not in (one, other)], measure, form)


def draw_complexity(figure: Figure, rows: Sequence[Row], supervisor: float | None) -> None:
    """Goals, without and (where it was measured) with a limit, and likelihood against the number of demonstrations."""
    measures = {"goals": "goals in 2000 steps", "limited_goals": "goals, 250 steps each at most",
                "log_likelihood_held_out": "held-out nats/step"}  # fmt: skip
    shown = {key: label for key, label in measures.items() if any(row[key] is not None for row in rows)}
    counts = sorted({row["demonstrations"] for row in rows})
    for axes, (measure, label) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        for (method,), own in grouped(rows, "method").items():
            curve(axes, own, "demonstrations", measure, method)
        if supervisor is not None and "goals" in measure:
            axes.axhline(supervisor, color="k", ls=":", lw=1, label="supervisor")
        axes.set(xscale="log", xlabel="demonstrations", ylabel=label)
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=7, loc="outside lower center", ncols=6)


def describe_options(rows: Sequence[Row]) -> list[str]:
    """The table against k, and how the two curves agree."""
    lines = [*table(rows, GOALS, "method", "options"), ""]
    for (method,), own in grouped(rows, "method").items():
        means = {m: [over_seeds(one, m)[0] for one in grouped(own, "options").values()]
                 for m in ("goals", "log_likelihood_held_out")}  # fmt: skip
        found = stats.spearmanr(*means.values())
        lines.append(
            f"- {method}: Spearman's rank correlation over k of mean goals and mean held-out log-likelihood "
            f"{found.statistic:.2f} (p = {found.pvalue:.2g}, {len(means['goals'])} values of k)."
        )
    return [*lines, "", *_sigma(rows)]


def draw_options(figure: Figure, rows: Sequence[Row], supervisor: float | None) -> None:
    """Goals and held-out log-likelihood against k."""
    measures = {"goals": "goals in 2000 steps", "log_likelihood_held_out": "held-out nats/step"}
    for axes, (measure, label) in zip(figure.subplots(1, 2), measures.items(), strict=True):
        for (method,), own in grouped(rows, "method").items():
            curve(axes, own, "options", measure, method)
        axes.set(xlabel="options k", ylabel=label)
    if supervisor is not None:
        figure.axes[0].axhline(supervisor, color="k", ls=":", lw=1, label="supervisor")
    figure.axes[0].legend(fontsize=8)


def describe_augmentation(rows: Sequence[Row]) -> list[str]:
    """The table of success and of the meta-policy's own control."""
    columns = {"success": ("success", "{:.2f}"), "steps under own control": ("own_control", "{:.2f}"), **GOALS}
    success = "Success: at least one goal in the episode."
    return [success, "", *table(rows, columns, "method", "options"), "", *_sigma(rows)]


def draw_augmentation(figure: Figure, rows: Sequence[Row], supervisor: float | None) -> None:
    """Success, goals and the fraction of steps under the meta-policy's own control against k."""
    del supervisor
    measures = {"success": "success rate", "goals": "goals in 2000 steps", "own_control": "steps under own control"}
    for axes, (measure, label) in zip(figure.subplots(1, 3), measures.items(), strict=True):
        for (method,), own in grouped(rows, "method").items():
            curve(axes, own, "options", measure, method)
        axes.set(xlabel="options k", ylabel=label)
    figure.axes[0].legend(fontsize=8)


def _sigma(rows: Sequence[Row]) -> list[str]:
    values = sorted({row["std"] for row in rows})
    return [f"Log-likelihoods are at σ = {', '.join(map(str, values))} of the controls' own spread, for every method."]


def describe_variants(rows: Sequence[Row]) -> list[str]:
    """The table of what was changed, for every method alike."""
    head = "Likelihoods are comparable only between methods of the same variant: its demonstrations or σ are its own."
    return [head, "", *table(rows, GOALS, "variant", "demonstrations", "method"), "", *_sigma(rows)]


def draw_variants(figure: Figure, rows: Sequence[Row], supervisor: float | None) -> None:
    """Goals of every method, one group of bars for each variant; a panel for each number of demonstrations."""
    del supervisor
    panels = grouped(rows, "demonstrations")
    for axes, ((count,), own) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        names = [variant for (variant,) in grouped(own, "variant")]
        methods = grouped(own, "method")
        height = 0.8 / len(methods)
        for place, ((method,), ours) in enumerate(methods.items()):
            found = {variant: over_seeds(one, "goals") for (variant,), one in grouped(ours, "variant").items()}
            at = [names.index(variant) + place * height for variant in found]
            means, halves = [f[0] for f in found.values()], [f[1] for f in found.values()]
            axes.barh(at, means, height, xerr=halves, color=COLOURS[method], label=method, error_kw={"lw": 1})
        axes.set_yticks(np.arange(len(names)) + 0.4 - height / 2, names, fontsize=8)
        axes.invert_yaxis()
        axes.set(xlabel="goals in 2000 steps", title=f"{count} demonstrations", xlim=(0, 35))
    figure.axes[0].legend(fontsize=7)


Describe = Callable[[Sequence[Row]], list[str]]
Draw = Callable[[Figure, Sequence[Row], float | None], None]
STUDIES: dict[str, tuple[Describe, Draw]] = {
    "sample_complexity": (describe_complexity, draw_complexity),
    "number_of_options": (describe_options, draw_options),
    "augmentation": (describe_augmentation, draw_augmentation),
    "variants": (describe_variants, draw_variants),
}
