"""``label``: a page on which a person corrects segments."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from ddco_pyro.cli import AllowCode, Wheres, demos, option, where_of
from ddco_pyro.cli.starting import refuse_other
from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import load_spec

Level = Annotated[str | None, option("The level that is opened first; by default the lowest.")]


def label(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="[RUN] DEMOS",
            help="A run with options, and an HDF5 file or a LeRobot dataset. "
            "Without a run, one is fitted first.",
        ),
    ],
    out: Annotated[
        Path | None,
        option("The copy of DEMOS that gets the labels; by default DEMOS_labels, here.", metavar="PATH"),
    ] = None,
    in_place: Annotated[bool, option("Write the labels into DEMOS itself.", "--in-place")] = False,
    skills: Annotated[
        str | None, option("Names of skills, such as reach,grasp,place, or a file of them.", metavar="NAMES")
    ] = None,
    annotator: Annotated[
        str, option("Who labels; each annotator has labels and a journal apart.", metavar="NAME")
    ] = "",
    team: Annotated[
        str, option("Annotators who share the demonstrations out, such as ann,bob.", metavar="NAMES")
    ] = "",
    twice: Annotated[
        float, option("The share of demonstrations that two annotators label.", min=0, max=1)
    ] = 0.0,
    features: Annotated[
        str | None, option("Proposals also read pictures, by a network of encode: timm:NAME.", metavar="NAME")
    ] = None,
    level: Level = None,
    wheres: Wheres = [],  # noqa: B006
    port: Annotated[int, option("Port of the page; 0 is any that is free.", min=0, max=65535)] = 0,
    browser: Annotated[bool, option("Open the page in a browser.", "--browser/--no-browser")] = True,
    allow_code: AllowCode = False,
) -> None:
    """Correct segments on a page of this machine; what you say is used for all other demonstrations at once.

    Labels of each level go into labels/LEVEL, or into a LeRobot dataset's language columns. Ctrl-C saves
    them. The same command goes on with them.
    """
    if len(paths) > 2:
        raise BadInput("label: name a run and a file of demonstrations, or the file alone")
    if in_place and (out is not None or annotator):
        raise BadInput("--in-place excludes --out and --annotator; keep one")
    file = paths[-1]
    place = file if in_place else out or Path(f"{file.stem}_labels{'' if file.is_dir() else '.hdf5'}")
    if annotator:
        place = place.with_name(f"{place.stem}_{annotator}{place.suffix}")
    output = Output("--in-place" if in_place else "--out", place, "folder" if file.is_dir() else "file")
    check_outputs([output], [] if in_place else [file])
    try:
        from ddco_pyro.labelling.server import Listening, serve
    except ModuleNotFoundError as error:
        raise BadInput(f"label needs {error.name}; install it with: pip install 'ddco-pyro[label]'") from None
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.labelling.features import Features
    from ddco_pyro.labelling.session import Session
    from ddco_pyro.labelling.team import Team
    from ddco_pyro.training.processes import one_thread

    people = Team(annotator, tuple(filter(None, team.split(","))), twice)
    names = _names(skills)
    where = where_of(wheres)
    seen = Features.of(file, place, features, allow_code, where) if features else None
    run = paths[0] if len(paths) == 2 else _fitted(file, len(names), where)
    listening = Listening.at(port)

    def ready() -> None:
        print(f"{listening.address}\nCtrl-C saves the labels and ends", flush=True)
        if browser:
            webbrowser.open(listening.address)

    with one_thread():  # a demonstration is inferred sooner so, and a refit has a core of its own
        fit = load(run, allow_code)
        first = Session(fit, file, place, level, names, people, where=where, features=seen)
        others = [own for own in fit.names if own != first.level]
        sessions = [first, *(Session(fit, file, place, own, (), people, first, where) for own in others)]
        for session in sessions:
            session.beside = [other for other in sessions if other is not session]
            session.journal.at(listening.address)
            session.begin()
        print(serve(sessions, listening, ready))


def _names(skills: str | None) -> list[str]:
    """The names of ``--skills``: those of a file, a line each, or those between commas."""
    if skills is None:
        return []
    text = Path(skills).read_text(encoding="utf-8") if Path(skills).is_file() else skills.replace(",", "\n")
    names = [name.strip() for name in text.splitlines() if name.strip()]
    if not names or len({*names}) < len(names) or "control" in names:
        raise BadInput("--skills: name each skill once, such as reach,grasp,place; control is no skill")
    return names


def _fitted(file: Path, count: int = 0, where: Mapping[str, Sequence[str]] = {}) -> Path:
    """A run fitted to the file, without baselines, left-out demonstrations and report; reuses a finished one.

    Of a dataset of another library, the numbers are imported for it.

    :param count: the number of options; as ``init`` chooses where 0.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.data.importing import import_demonstrations
    from ddco_pyro.data.sources import format_of
    from ddco_pyro.fitting.fit import fit

    folder = Path("runs") / file.stem
    spec, run = folder / "spec.yaml", folder / "run"
    foreign = format_of(file) != "robomimic"
    numbers = folder / "numbers.hdf5" if foreign else file
    if spec.exists():
        refuse_other(spec, numbers, "name the run to label with, or copy the file under another name")
    if not (run / "metrics.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        if foreign and not numbers.exists():
            import_demonstrations(file, numbers)
        if not spec.exists():
            demos.write_spec(numbers, spec, where=where)
        changes = ["compare_with=[]", *([f"hierarchy.levels.0.count={count}"] if count else [])]
        if load_spec(spec).demonstrations.holds_out_each:
            changes += ["demonstrations.hold_out_by=null", "demonstrations.valid_fraction=0"]
        with console.Progress() as progress:
            fit(load_spec(spec, changes), None, run, progress)
    return run
