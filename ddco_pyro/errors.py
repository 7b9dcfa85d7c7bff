"""Base classes of user-facing errors."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any


class BadInput(ValueError):
    """Unusable input: one line with the problem, the place and the remedy (exit status 2)."""


class Failed(RuntimeError):
    """A failure with valid input: one line with the problem, the place and the remedy (exit status 1)."""


def reason(error: Exception) -> str:
    """Why something failed, in one line; what is no user-facing error is said to be unexpected."""
    message = " ".join(str(error).split())
    expected = isinstance(error, BadInput | Failed | OSError)
    return message if expected else f"unexpected {type(error).__name__}: {message}"


def check_whole(name: str, given: Any, least: int = 0) -> None:
    """Refuse a setting that is not a whole number from ``least`` on; numpy's are.

    :raises BadInput: it is not.
    """
    if not isinstance(given, Integral) or given < least:
        raise BadInput(f"{name}={given!r}: has to be a whole number from {least} on")


def path_of(given: Any, what: str) -> Path:
    """The path of a file or folder.

    :param what: the name of the argument in errors.
    :raises BadInput: it is something else.
    """
    if not isinstance(given, str | PathLike):
        raise BadInput(f"{what}: has to be the path of a file or folder; got {type(given).__name__}")
    return Path(given)


@contextmanager
def needing(extra: str, what: str) -> Iterator[None]:
    """Say how to install a package of an extra of this project that the block imports.

    :raises BadInput: it is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        install = f"install it with: pip install 'ddco-pyro[{extra}]'"
        raise BadInput(f"{what} needs {error.name}; {install}") from None


def refuse_unknown(
    what: str, given: str, known: Iterable[str], error: type[BadInput] = BadInput, place: str = ""
) -> None:
    """Refuse a name that is none of the known ones.

    :raises BadInput: it is none, as ``error``.
    """
    if given not in (names := list(known)):
        there = ", ".join(names) or "none"
        raise error(f"{place}there is no {what} {given!r}{nearest(given, names)}; there is: {there}")


def command(*words: object) -> str:
    """A command of this program, quoted for the shell.

    >>> command("inspect", "my demos.hdf5")
    "ddco-pyro inspect 'my demos.hdf5'"
    """
    return shlex.join(["ddco-pyro", *map(str, words)])


def nearest(given: Any, names: Iterable[str]) -> str:
    """A question that suggests the closest name; empty if no name is close.

    >>> nearest("flt", ["flat", "mixture"])
    " (did you mean 'flat'?)"
    """
    close = difflib.get_close_matches(str(given), list(names), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
