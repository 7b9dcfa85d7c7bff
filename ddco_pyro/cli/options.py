"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished fit.", show_default=False)]
AllowCode = Annotated[
    bool,
    typer.Option("--allow-code", help="Import the user code (module:name) that the spec names."),
]
