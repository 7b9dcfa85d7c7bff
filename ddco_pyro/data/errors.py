"""The error about unusable demonstrations."""

from __future__ import annotations

from pathlib import Path

from ddco_pyro.errors import BadInput


class DemonstrationsError(BadInput):
    """Unusable demonstrations: one line with the file, the demonstration and the key.

    :param located: whether the line names the file already.
    """

    def __init__(self, text: str, located: bool = False) -> None:
        super().__init__(text)
        self.located = located

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """A text as one line without control characters, which names in a file can contain."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


def damaged(path: Path, where: str, error: BaseException) -> DemonstrationsError:
    """A library's error about an unreadable file, as one line; a :class:`DemonstrationsError` is unchanged.

    :param where: the part of the file; may be empty.
    """
    if isinstance(error, DemonstrationsError):
        return error
    text = " ".join(str(error).split()) or type(error).__name__
    return DemonstrationsError(f"{path}: {where + ': ' if where else ''}cannot be read, or is damaged: {text}")
