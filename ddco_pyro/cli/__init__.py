"""The command line; here, the arguments and options of several commands."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
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


def out_stream(text: str | os.PathLike[str]) -> Path:
    """The name of a file to write, which never replaces an HDF5 file.

    :raises typer.BadParameter: the name is empty, or that of a folder.
    """
    name = os.fspath(text)
    if name.endswith(os.sep) or (name and not Path(name).name):
        raise typer.BadParameter(f"{name} names a folder; name a file")
    return out_folder(name)


def out_file(text: str | os.PathLike[str]) -> Path:
    """The same for a file of any kind."""
    return out_stream(text)


def out_folder(text: str | os.PathLike[str]) -> Path:
    """The name of a folder to write.

    :raises typer.BadParameter: the name is empty.
    """
    if not os.fspath(text):
        raise typer.BadParameter("the name is empty; name a place")
    return Path(text)


def written(parser: Any, text: str, **how: Any) -> Any:
    """An option that names a place to write; ``parser`` is a key of :data:`KINDS`."""
    return typer.Option(help=text, parser=parser, metavar="PATH", **how)


KINDS: Mapping[Any, Literal["folder", "file", "stream"]] = {
    out_stream: "stream", out_file: "file", out_folder: "folder"
}  # fmt: skip


def checking(command: Callable[..., None]) -> Callable[..., None]:
    """A command that first refuses what cannot be written where its options say.

    An output is a parameter of a parser in :data:`KINDS`; other paths are what the command reads.
    """

    @wraps(command)
    def checked(**given: Any) -> None:
        outputs, read = list[Output](), list[Path]()
        for name, hint in get_type_hints(command, include_extras=True).items():
            parsers = {getattr(about, "parser", None) for about in getattr(hint, "__metadata__", ())}
            values = given[name] if isinstance(given.get(name), list) else [given.get(name)]
            for path in (value for value in values if isinstance(value, Path)):
                kinds = [kind for parser, kind in KINDS.items() if parser in parsers]
                option = f"--{name.replace('_', '-')}"
                outputs += [Output(option, path, kind) for kind in kinds]
                read += [] if kinds else [path]
        check_outputs(outputs, read)
        command(**given)

    return checked


SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec, a YAML file.")]
Overrides = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the spec; repeatable.")
]
Wheres = Annotated[
    list[str],
    typer.Option(
        "--where",
        metavar="ATTRIBUTE=VALUE",
        help="Only demonstrations with this value of an attribute, such as task=reach; repeatable.",
    ),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished fit.")]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Import the user code (module:name) that the spec names.")
]


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
