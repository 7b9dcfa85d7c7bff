"""The command line; here, the arguments and options of several commands."""

from __future__ import annotations

import os
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any

import typer

NARROW = get_terminal_size().columns < 60
"""Whether tables of help would cut the names of options: help is plain text then."""
BRACKET = "[" if NARROW else "\\["
"""A bracket in a help text, which tables would take for markup."""


def out_file(text: str | os.PathLike[str]) -> Path:
    """The name of a file to write.

    :raises typer.BadParameter: the name is empty, or that of a folder.
    """
    name = os.fspath(text)
    if name.endswith(os.sep) or (name and not Path(name).name):
        raise typer.BadParameter(f"{name} names a folder; name a file")
    return out_folder(name)


def out_folder(text: str | os.PathLike[str]) -> Path:
    """The name of a folder to write.

    :raises typer.BadParameter: the name is empty.
    """
    if not os.fspath(text):
        raise typer.BadParameter("the name is empty; name a place")
    return Path(text)


def written(parser: Any, text: str, **how: Any) -> Any:
    """An option that names a place to write, :func:`out_file` or :func:`out_folder`."""
    return typer.Option(help=text, parser=parser, metavar="PATH", **how)


SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec, a YAML file.")]
Overrides = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the spec; repeatable.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished fit.")]
Level = Annotated[str | None, typer.Option(help="Name of their level; by default the lowest.")]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Import the user code (module:name) that the spec names.")
]
