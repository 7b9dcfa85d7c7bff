"""What ``ddco-pyro inspect`` shows."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ddco_pyro.data.hdf5 import printable
from ddco_pyro.data.inspection import Field, Inspection
from ddco_pyro.data.values import LARGEST

WIDTH = 160
"""Columns where there is no terminal: names in a file that is read by a program are not to be cut."""


def show(found: Inspection) -> None:
    """Print what was found in a file, as a few lines and a table."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    lines = [f"{found.path}: {found.format}, {_lengths(found)}", f"control frequency: {_frequency(found)}"]
    lines += [f"mask/{name}: {len(names)} demonstrations" for name, names in found.masks.items()]
    for line in lines:
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    table = Table("", "a step", "type", "range", "notes", show_edge=False)
    for one in found.fields.values():
        table.add_row(*map(_plain, (one.place, str(list(one.shape)), one.dtype, _range(one), _notes(one))))
    console.print(table)
    for line in (*found.notes, *(f"problem: {problem}" for problem in found.problems)):
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)


def _plain(text: str) -> str:
    return escape(printable(text))


def _lengths(found: Inspection) -> str:
    steps = np.array(list(found.lengths.values()) or [0])
    text = f"{len(found.lengths)} demonstrations"
    return f"{text} of {steps.min()} to {steps.max()} steps (median {np.median(steps):g}, {steps.sum()} in all)"


def _frequency(found: Inspection) -> str:
    return f"{found.frequency:g} Hz" if found.frequency else "not in the file"


def _range(one: Field) -> str:
    low, high = one.minimum[np.isfinite(one.minimum)], one.maximum[np.isfinite(one.maximum)]
    if not len(low) or not len(high):
        return "-"
    return f"{float(low.min()) + 0.0:.4g} to {float(high.max()) + 0.0:.4g}"  # + 0.0: no minus zero


def _notes(one: Field) -> str:
    notes = ["video" if one.video else "image"] if one.image else []
    if one.nan or one.infinite:
        notes.append(f"{one.nan} NaN, {one.infinite} infinite")
    if one.huge:
        notes.append(f"{one.huge} beyond ±{LARGEST:g}")
    constant = one.constant
    if constant and len(constant) == len(one.minimum):
        notes.append("constant")
    elif constant and not one.image:
        notes.append(f"constant: {', '.join(map(str, constant))}")
    elif one.still and not one.video:
        notes.append("one value per demonstration")
    return "; ".join(notes)
