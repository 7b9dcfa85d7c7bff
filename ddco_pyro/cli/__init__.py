"""The command line; here, the arguments and options of several commands."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any, Literal, get_type_hints

import typer

from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput

NARROW = get_terminal_size().columns < 60
"""Whether tables of help would cut the names of options: help is plain text then."""
BRACKET = "[" if NARROW else "\\["
"""A bracket in a help text, which tables would take for markup."""


@dataclass(frozen=True)
class Place:
    """The parser of an option that names a place to write, a :class:`~ddco_pyro.data.files.Output`."""

    kind: Literal["folder", "file", "stream"]
    __name__ = "path"

    def __call__(self, text: str | os.PathLike[str]) -> Path:
        """:raises typer.BadParameter: the name is empty, or that of a folder where it has to be a file."""
        name = os.fspath(text)
        if not name:
            raise typer.BadParameter("the name is empty; name a place")
        if self.kind != "folder" and (name.endswith(os.sep) or not Path(name).name):
            raise typer.BadParameter(f"{name} names a folder; name a file")
        return Path(name)


def option(text: str, *names: str, **how: Any) -> Any:
    """An option and its help; ``names`` where it is not called like the parameter."""
    return typer.Option(*names, help=text, **how)


def written(kind: Literal["folder", "file", "stream"], text: str, **how: Any) -> Any:
    """An option that names a place to write."""
    return typer.Option(help=text, parser=Place(kind), metavar="PATH", **how)


def checking(command: Callable[..., None]) -> Callable[..., None]:
    """A command that first refuses what cannot be written where its options say; other paths are read."""

    @wraps(command)
    def checked(**given: Any) -> None:
        outputs, read = list[Output](), list[Path]()
        for name, hint in get_type_hints(command, include_extras=True).items():
            places = [getattr(about, "parser", None) for about in getattr(hint, "__metadata__", ())]
            values = given[name] if isinstance(given.get(name), list) else [given.get(name)]
            for path in (value for value in values if isinstance(value, Path)):
                kinds = [place.kind for place in places if isinstance(place, Place)]
                outputs += [Output(f"--{name.replace('_', '-')}", path, kind) for kind in kinds]
                read += [] if kinds else [path]
        check_outputs(outputs, read)
        command(**given)

    return checked


SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec, a YAML file.")]
Overrides = Annotated[
    list[str], option("Override a key of the spec; repeatable.", "--set", metavar="KEY=VALUE")
]
Wheres = Annotated[
    list[str],
    option(
        "Only demonstrations with this value of an attribute, such as task=reach; repeatable.",
        "--where",
        metavar="ATTRIBUTE=VALUE",
    ),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished fit.")]
AllowCode = Annotated[bool, option("Import the user code (module:name) that the spec names.", "--allow-code")]


def where_of(wheres: Iterable[str]) -> dict[str, list[str]]:
    """The values of each attribute that ``--where`` names.

    :raises BadInput: one of them is no ``ATTRIBUTE=VALUE``.
    """
    where: dict[str, list[str]] = {}
    for text in wheres:
        attribute, _, value = text.partition("=")
        if not attribute or not value:
            raise BadInput(f"--where {text}: write ATTRIBUTE=VALUE, such as task=reach")
        where.setdefault(attribute, []).append(value)
    return where
