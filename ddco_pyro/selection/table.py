"""The result of a selection as a table in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ddco_pyro.drawing.words import number, signed
from ddco_pyro.selection.choice import Choice, Row

HEAD = ("Candidate", "Parameters", "Held-out nats/step", "Minus the best", "Gradient steps", "Folds", "")


def markdown(choice: Choice, data: Mapping[str, Any]) -> str:
    """Table, rule, failed folds and notes."""
    lines = [
        f"{data['folds']}-fold cross-validation over {data['demonstrations']} demonstrations, the same folds for every "
        "candidate; ± is one standard error over the folds; gradient steps are the mean of a fold.",
        "",
        f"| {' | '.join(HEAD)} |",
        "|---|--:|--:|--:|--:|--:|---|",
        *(f"| {' | '.join(cells(row, choice))} |" for row in choice.rows),
        "",
        data["rule"] + ".",
    ]
    if data["stop_early"]:
        lines += ["", data["stop_early"] + "."]
    for failure in data["failed"]:
        lines += ["", f"**Failed:** {failure['name']}, fold {failure['fold']}: {failure['reason']}"]
    for note in choice.notes:
        lines += ["", f"**Note:** {note}."]
    return "\n".join(lines) + "\n"


def cells(row: Row, choice: Choice) -> list[str]:
    """A candidate's row."""
    mean = "–" if row.mean is None else f"{number(row.mean, 3)} ± {number(row.error, 3)}"
    difference = "–"
    if row.difference is not None and row is not choice.best:
        difference = f"{signed(row.difference[0], 3)} ± {number(row.difference[1], 3)}"
    marks = [name for name, marked in (("best", choice.best), ("chosen", choice.chosen)) if marked is row]
    marks += [] if row.status == "scored" else [row.status]
    marks += [f"not converged in {len(row.unconverged)}"] if row.unconverged else []
    took = [number(row.gradient_steps, 0), str(len(row.folds))]
    return [row.candidate.name, str(row.candidate.parameters), mean, difference, *took, ", ".join(marks)]
