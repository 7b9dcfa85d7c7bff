"""Odd and hostile files, a table in each module: how each is made, and what the commands say of it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One odd file.

    :param make: writes it, and what belongs to it, into an empty folder; the path that a command is given.
    :param says: a regular expression that the refusal matches; None where the commands accept the file.
    """

    make: Callable[[Path], Path]
    says: str | None


def rows() -> dict[str, Row]:
    """The rows of all modules; a name is ``module: row``."""
    modules = sorted(module.name for module in pkgutil.iter_modules(__path__))
    tables = {name: importlib.import_module(f"{__name__}.{name}").ROWS for name in modules}
    return {f"{module}: {name}": row for module, table in tables.items() for name, row in table.items()}
