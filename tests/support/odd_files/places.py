"""Files whose names, or names in which, a shell or a spreadsheet would execute: they are files like others."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations
from odd_files import Row


def _named(name: str, folder: Path) -> Path:
    demonstrations(6).write(folder / name)
    return folder / name


def _formulas(folder: Path) -> Path:
    names = ["=1+1", "+1", "-1", "@SUM(A1)", "'quoted", "plain"]
    made = zip(demonstrations(6), names, strict=True)
    Demonstrations(tuple(replace(demo, name=name) for demo, name in made)).write(folder / "formulas.hdf5")
    return folder / "formulas.hdf5"


ROWS = {
    "a name with a quote and a command": Row(partial(_named, "it's $(odd); `x`.hdf5"), None),
    "a name that begins with a formula": Row(partial(_named, "=cmd.hdf5"), None),
    "demonstrations that are called like formulas": Row(_formulas, None),
}
