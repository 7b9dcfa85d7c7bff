"""Odd and hostile files, a table in each module: how each is made, and what the commands say of it."""

import hashlib
import importlib
import pkgutil
import stat
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


def snapshot(folder: Path, aside: Path | None = None) -> dict[str, tuple[object, ...]]:
    """All that there is below a folder, ``aside`` aside: kinds, times, where links lead, and contents."""
    found = {}
    for path in folder.rglob("*"):
        if aside not in (path, *path.parents):
            about = path.lstat()
            leads = path.readlink() if path.is_symlink() else None
            content = hashlib.sha256(path.read_bytes()).digest() if stat.S_ISREG(about.st_mode) else None
            found[str(path.relative_to(folder))] = (about.st_mode, about.st_mtime_ns, leads, content)
    return found
