"""The bases of errors that tell a user what to change."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterable
from typing import Any


class BadInput(ValueError):
    """What was given cannot be used: one line that says what is wrong, where, and what to do (exit status 2)."""


class Failed(RuntimeError):
    """What was asked for cannot be done, though the input is in order: one line as above (exit status 1)."""


def command(*words: object) -> str:
    """A command of this program as a user types it, quoted for the shell."""
    return shlex.join(["ddco-pyro", *map(str, words)])


def nearest(given: Any, names: Iterable[str]) -> str:
    """A question whether the closest of the names was meant; nothing where none is close."""
    close = difflib.get_close_matches(str(given), list(names), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
