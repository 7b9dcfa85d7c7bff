"""``label``: a page on which a person corrects segments."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from ddco_pyro.cli import AllowCode, Level, demos, out_file, written
from ddco_pyro.cli.starting import refuse_other
from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import load_spec


def label(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="[RUN] DEMOS", help="A run with options, and an HDF5 file. Without a run, one is fitted first."
        ),
    ],
    out: Annotated[
        Path | None, written(out_file, "The copy of DEMOS that gets the labels; by default DEMOS_labels.hdf5, here.")
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Write the labels into DEMOS itself.")] = False,
    level: Level = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 is any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    allow_code: AllowCode = False,
) -> None:
    """Correct segments on a page of this machine; what you say is used for all other demonstrations at once.

    Labels go into labels/LEVEL, -1 where you said nothing. Ctrl-C saves them. The same command goes on with them.
    """
    if len(paths) > 2:
        raise BadInput("label: name a run and a file of demonstrations, or the file alone")
    if out is not None and in_place:
        raise BadInput("--out and --in-place exclude each other; keep one")
    file = paths[-1]
    place = file if in_place else out or Path(f"{file.stem}_labels.hdf5")
    check_outputs([Output("--in-place" if in_place else "--out", place, "file")], [] if in_place else [file])
    try:
        from ddco_pyro.labelling.server import Listening, serve
    except ModuleNotFoundError as error:
        raise BadInput(f"label needs {error.name}; install it with: pip install 'ddco-pyro[label]'") from None
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.labelling.session import Session
    from ddco_pyro.training.processes import one_thread

    run = paths[0] if len(paths) == 2 else _fitted(file)
    listening = Listening.at(port)

    def ready() -> None:
        print(f"{listening.address}\nCtrl-C saves the labels and ends", flush=True)
        if browser:
            webbrowser.open(listening.address)

    with one_thread():  # a demonstration is inferred sooner so, and a refit has a core of its own
        session = Session(load(run, allow_code), file, place, level)
        session.journal.at(listening.address)
        session.begin()
        print(serve(session, listening, ready))


def _fitted(file: Path) -> Path:
    """A run fitted to the file, without baselines and report; a finished one is used again."""
    from ddco_pyro.cli import console
    from ddco_pyro.data.sources import refuse_foreign
    from ddco_pyro.fitting.fit import fit

    folder = Path("runs") / file.stem
    spec, run = folder / "spec.yaml", folder / "run"
    if spec.exists():
        refuse_other(spec, file, "name the run to label with, or copy the file under another name")
    if not (run / "metrics.json").exists():
        refuse_foreign(file)
        folder.mkdir(parents=True, exist_ok=True)
        if not spec.exists():
            demos.write_spec(file, spec)
        with console.Progress() as progress:
            fit(load_spec(spec, ["compare_with=[]"]), None, run, progress)
    return run
