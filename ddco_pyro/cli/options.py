"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec, a YAML file.", show_default=False)]
Overrides = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Another value for a key of the spec; repeatable.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished fit.", show_default=False)]
AllowExternal = Annotated[
    bool,
    typer.Option("--allow-external", help="Read the parts of an HDF5 file that lie in other files."),
]
AllowCode = Annotated[
    bool,
    typer.Option("--allow-code", help="Import the user code (module:name) that the spec names."),
]
