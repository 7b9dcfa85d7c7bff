"""The error about unusable demonstrations, and about files that cannot be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ddco_pyro.errors import BadInput, Failed


class DemonstrationsError(BadInput):
    """Unusable demonstrations: one line with the file, the demonstration and the key."""

    def __str__(self) -> str:
        return printable(super().__str__())


class Located(DemonstrationsError):
    """An error whose line names the file already."""


@contextmanager
def located(path: str | Path) -> Iterator[None]:
    """Name a file in errors about its demonstrations that do not name one yet."""
    try:
        yield
    except Located:
        raise
    except DemonstrationsError as error:
        raise Located(f"{path}: {error}") from None


def printable(text: str) -> str:
    """A text as one line without control characters, which names in a file can contain."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


DAMAGE = (
    OSError, RuntimeError, MemoryError, ArithmeticError, ValueError, TypeError, LookupError, AttributeError,
    AssertionError, ImportError,
)  # fmt: skip
"""The errors of libraries about damaged files."""


@contextmanager
def reading(path: Path, where: str = "") -> Iterator[None]:
    """Tell what a library raises about a damaged file as one line.

    :param where: the part of the file; may be empty.
    :raises Located: the block raises one of :data:`DAMAGE`.
    """
    try:
        yield
    except (BadInput, Failed):
        raise
    except DAMAGE as error:
        text = " ".join(str(error).split()) or type(error).__name__
        place = f"{path}: {where}" if where else path
        raise Located(f"{place}: cannot be read, or is damaged: {text}") from error
