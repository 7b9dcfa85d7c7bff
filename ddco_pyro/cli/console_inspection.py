"""What ``ddco-pyro inspect`` shows."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ddco_pyro.data.checks import LARGEST
from ddco_pyro.data.hdf5 import printable
from ddco_pyro.data.inspection import Field, Inspection

WIDTH = 160
"""Columns where there is no terminal: names in a file that is read by a program are not to be cut."""


def show(facts: Inspection) -> None:
    """Print what was found in a file, as a few lines and a table."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    lines = [f"{facts.path}: {facts.format}, {_lengths(facts)}", f"control frequency: {_frequency(facts)}"]
    lines += [f"mask/{name}: {len(names)} demonstrations" for name, names in facts.masks.items()]
    lines += [f"names another file as a part of it: {path}" for path in facts.external]
    for line in lines:
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    table = Table("", "a step", "type", "range", "notes", show_edge=False)
    for field in facts.fields.values():
        table.add_row(*map(_plain, (field.place, str(list(field.shape)), field.dtype, _range(field), _notes(field))))
    console.print(table)
    for line in (*facts.notes, *(f"problem: {problem}" for problem in facts.problems)):
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)


def _plain(text: str) -> str:
    return escape(printable(text))


def _lengths(facts: Inspection) -> str:
    steps = np.array(list(facts.lengths.values()) or [0])
    text = f"{len(facts.lengths)} demonstrations"
    return f"{text} of {steps.min()} to {steps.max()} steps (median {np.median(steps):g}, {steps.sum()} in all)"


def _frequency(facts: Inspection) -> str:
    return f"{facts.frequency:g} Hz" if facts.frequency else "not in the file"


def _range(field: Field) -> str:
    low, high = field.minimum[np.isfinite(field.minimum)], field.maximum[np.isfinite(field.maximum)]
    if not len(low) or not len(high):
        return "-"
    return f"{float(low.min()) + 0.0:.4g} to {float(high.max()) + 0.0:.4g}"  # + 0.0: no minus zero


def _notes(field: Field) -> str:
    notes = ["video" if field.video else "image"] if field.image else []
    if field.nan or field.infinite:
        notes.append(f"{field.nan} NaN, {field.infinite} infinite")
    if field.huge:
        notes.append(f"{field.huge} beyond ±{LARGEST:g}")
    constant, rounding = field.constant, field.rounding
    if constant + rounding and len(constant + rounding) == len(field.minimum):
        notes.append("constant but for rounding" if rounding else "constant")
    elif constant + rounding and not field.image:
        listed = {"constant": constant, "constant but for rounding": rounding}
        notes += [f"{what}: {', '.join(map(str, dimensions))}" for what, dimensions in listed.items() if dimensions]
    elif field.still and not field.video:
        notes.append("one value per demonstration")
    return "; ".join(notes)
