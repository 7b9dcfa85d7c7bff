"""Commands on demonstrations: ``collect``, ``inspect``, ``init``, ``import`` and ``encode``."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ddco_pyro.cli import AllowCode, Overrides, SpecPath, Wheres, option, where_of, written
from ddco_pyro.data.files import write_text
from ddco_pyro.data.formats import FORMATS
from ddco_pyro.errors import BadInput, Failed, command
from ddco_pyro.spec import Spec, SpecError, load_spec, parse_spec
from ddco_pyro.spec.yaml import read_yaml

if TYPE_CHECKING:
    from ddco_pyro.data.inspection import Inspection
    from ddco_pyro.data.starting import Decided
    from ddco_pyro.data.tasks import Where

_FORMS = ", ".join(about.text for about in FORMATS.values())
SourcePath = Annotated[Path, typer.Argument(metavar="FILE", help=f"Demonstrations: {_FORMS}.")]
FormatOption = Annotated[
    str | None, option(f"One of {', '.join(FORMATS)}; recognised unless given.", "--format", metavar="NAME")
]


def collect(
    spec: SpecPath,
    out: Annotated[
        Path | None, written("file", "The HDF5 file; by default in the cache, by content.")
    ] = None,
    overrides: Overrides = [],  # noqa: B006
    allow_code: AllowCode = False,
) -> None:
    """Record demonstrations of the task's supervisor, unless they exist."""
    loaded = load_spec(spec, overrides, allow_code)
    if loaded.demonstrated_task is None:
        raise SpecError(f"{spec}: names no task, so there is no supervisor to record")
    from ddco_pyro.cli import console
    from ddco_pyro.simulation.collect import collect as record

    file = out or loaded.demonstrations.file
    with console.Progress() as progress:
        print(record(loaded.demonstrated_task, loaded.demonstrations, file, progress, loaded.observed))


def inspect(
    file: SourcePath,
    form: FormatOption = None,
    as_json: Annotated[bool, option("Print all of it as JSON.", "--json")] = False,
    against: Annotated[
        Path | None, option("Compare labels with those of another annotator instead.", metavar="FILE")
    ] = None,
    wheres: Wheres = [],  # noqa: B006
    tolerance: Annotated[int, option("Steps between boundaries that match, for --against.", min=0)] = 5,
) -> None:
    """Print a file's keys, shapes, lengths, ranges, NaN, constant dimensions, masks, and a starting spec."""
    if against is not None:
        from ddco_pyro.cli import console
        from ddco_pyro.evaluation.agreement import compare_annotators

        found = compare_annotators(file, against, tolerance)
        if as_json:
            each = {name: asdict(own) | {"boundary_f1": own.boundary_f1} for name, own in found.items()}
            print(json.dumps(each, indent=1))
        else:
            console.annotators(found, tolerance)
        return
    from ddco_pyro.data.errors import DemonstrationsError
    from ddco_pyro.data.inspection import inspect as look
    from ddco_pyro.data.starting import starting_spec

    facts = look(file, form, where=where_of(wheres))
    if as_json:
        print(json.dumps(facts.as_json(), indent=1))
        return
    from ddco_pyro.cli import console

    console.inspection(facts)
    if facts.format != "robomimic":
        print(f"\nto fit to it, import it first: {command('import', file, '--out', 'demos.hdf5')}")
        return
    try:
        following = command("init", file, "--out", f"{file.stem}.yaml")
        print(f"\n{starting_spec(facts, file).text}\nnext: {following}")
    except DemonstrationsError as error:
        print(f"\nno spec to start with: {str(error).removeprefix(f'{file}: ')}")


def init(
    file: SourcePath,
    out: Annotated[Path, written("stream", "Where to write the spec.")] = Path("spec.yaml"),
    hold_out_by: Annotated[
        str | None,
        option(
            "Hold out all demonstrations with some values of an attribute, such as the operator.",
            metavar="ATTRIBUTE",
        ),
    ] = None,
    segment: Annotated[
        str | None,
        option(
            "How long options last, by the median: such as 2s, or 20 for steps. Small fits find the "
            "settings.",
            metavar="LENGTH",
        ),
    ] = None,
    segments: Annotated[
        int | None, option("The same by the number of segments in a demonstration.", min=1)
    ] = None,
    wheres: Wheres = [],  # noqa: B006
    force: Annotated[bool, option("Replace a file that is there already.", "--force")] = False,
) -> None:
    """Write a commented spec for a file of demonstrations, ready to fit.

    Without --segment or --segments, options do not switch within half a second, or five steps, all the time.
    """
    write_spec(file, out, hold_out_by, segment, segments, force, where_of(wheres))
    print(f"{out}: fit it with: {command('fit', out, '--out', f'runs/{out.stem}')}")


def write_spec(
    file: Path,
    out: Path,
    hold_out_by: str | None = None,
    segment: str | None = None,
    segments: int | None = None,
    force: bool = False,
    where: Where = {},  # noqa: B006 (it is not changed)
) -> None:
    """Write the spec of ``init``, and print what was decided."""
    from ddco_pyro.data.inspection import inspect as look
    from ddco_pyro.data.sources import refuse_foreign
    from ddco_pyro.data.starting import starting_spec

    if out.exists() and not force:
        raise BadInput(f"{out}: exists; choose another --out, or replace it with --force")
    facts = look(file, where=where)
    refuse_foreign(file)
    starting = starting_spec(facts, file, hold_out_by)
    spec = parse_spec(read_yaml(starting.text))
    if spec.training.optimizer.name == "em":
        decided = _decided(spec, facts, segment, segments)
        starting = starting_spec(facts, file, hold_out_by, decided)
    elif segment or segments:
        raise BadInput(f"{file}: --segment needs vectors to observe, since small fits find the settings")
    write_text(out, starting.text.replace("THIS_FILE", quote(str(out))))
    for note in starting.notes:
        print(note)


def _decided(spec: Spec, facts: Inspection, segment: str | None, segments: int | None) -> Decided | None:
    """What small fits decide: heavy tails, and what makes options last as asked; None if these fail."""
    from ddco_pyro.cli import console
    from ddco_pyro.selection.small import decide, in_steps
    from ddco_pyro.training.data import demonstrations

    if segment and segments:
        raise BadInput("--segment and --segments exclude each other; keep one")
    rate = facts.frequency
    steps = in_steps("--segment", segment, rate) if segment else None
    if segments:
        steps = sum(facts.lengths.values()) / len(facts.lengths) / segments
    try:
        with console.Progress() as progress:
            return decide(spec, demonstrations(spec), rate, steps, progress)
    except (BadInput, Failed):
        if steps is not None:
            raise
        return None  # the fit will say what is wrong


def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="Demonstrations, as inspect takes them; several are pooled."),
    ],
    out: Annotated[Path, written("file", "The HDF5 file to write.")],
    form: FormatOption = None,
    observations: Annotated[
        list[str], option("Import only this one; repeatable.", "--observation", metavar="KEY")
    ] = [],  # noqa: B006 (typer reads the default, which never changes)
    actions: Annotated[
        list[str],
        option(
            "The control, where a dataset has several; repeatable, joined in this order.",
            "--action",
            metavar="KEY",
        ),
    ] = [],  # noqa: B006
    mask: Annotated[str | None, option("Import only the demonstrations of this mask (filter key).")] = None,
    wheres: Wheres = [],  # noqa: B006
    videos: Annotated[bool, option("Decode the videos of a LeRobot dataset too.", "--videos")] = False,
    image_size: Annotated[
        int | None, option("Scale pictures to so many pixels in height and width.", min=8, max=4096)
    ] = None,
    hz: Annotated[float | None, option("Steps a second: means over the source's frames.", min=0.01)] = None,
    labels: Annotated[
        Path | None,
        option(
            "A table (CSV, TSV, Parquet) of segments that become labels, such as exported by ELAN, BORIS or "
            "Label Studio.",
            metavar="TABLE",
        ),
    ] = None,
    columns: Annotated[
        str | None,
        option("The columns of TABLE: demonstration=A,label=B,start=C,stop=D.", metavar="ROLE=NAME,..."),
    ] = None,
    unit: Annotated[
        Literal["seconds", "milliseconds", "steps"] | None,
        option("The unit of TABLE's times, unless its columns say it."),
    ] = None,
    fps: Annotated[
        float | None, option("Steps per second, for --labels; by default what FILE says.", min=0.001)
    ] = None,
    skip_broken: Annotated[
        bool, option("Leave out demonstrations that cannot be used, and list them.", "--skip-broken")
    ] = False,
) -> None:
    """Write demonstrations of another format, or of several files, into this project's layout.

    Of several files, each is a task unless the demonstrations name theirs. What only some have is left out,
    and said. With --labels, FILE may have this layout already.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.data.annotations import LabelTable
    from ddco_pyro.data.importing import Choice, import_demonstrations

    if labels is None and (fps or columns or unit):
        about = "--fps, --columns and --unit are about the table of --labels"
        raise BadInput(f"{about}; give it, or --hz for another rate")
    size = (image_size, image_size) if image_size else None
    table = LabelTable(labels, _columns(columns), unit, fps) if labels else None
    where = where_of(wheres)
    choice = Choice(tuple(observations), mask, videos, size, hz, skip_broken, tuple(actions), table, where)
    with console.Progress() as progress:
        imported = import_demonstrations(sources, out, form, choice, progress)
    for name, reason in imported.left_out.items():
        print(f"left out {name}: {reason}", file=sys.stderr)
    for line in imported.notes:
        print(f"note: {line}", file=sys.stderr)
    counts = "".join(f", labels/{name} in {number}" for name, number in imported.labelled.items())
    print(f"{out}: {len(imported.names)} demonstrations{counts}")


def _columns(text: str | None) -> dict[str, str]:
    """The columns that ``demonstration=A,label=B,start=C,stop=D``, or a part of it, names."""
    from ddco_pyro.data.annotations import ROLES

    parts = [part.partition("=") for part in text.split(",")] if text else []
    columns = {role: name for role, _, name in parts}
    if columns.keys() - set(ROLES) or "" in columns.values():
        wanted = ",".join(f"{role}=COLUMN" for role in ROLES)
        raise BadInput(f"--columns {text}: write {wanted}, or a part of it")
    return columns


def encode(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An HDF5 file of demonstrations.")],
    observation: Annotated[str, option("The pictures to encode.", metavar="KEY")],
    encoder: Annotated[
        str, option("timm:NAME, such as timm:resnet18.a1_in1k, or your own module:function.", metavar="NAME")
    ],
    out: Annotated[Path, written("file", "The HDF5 file to write.")],
    size: Annotated[
        int | None, option("Principal components to keep; 64 unless there are fewer features.", min=1)
    ] = None,
    name: Annotated[
        str | None, option("The new observation; KEY_features by default.", "--as", metavar="NAME")
    ] = None,
    allow_code: Annotated[bool, option("Import the user code that --encoder names.", "--allow-code")] = False,
) -> None:
    """Write demonstrations with a vector of features in place of pictures.

    The file holds the encoder, too; ddco_pyro.encoding.load reads it for acting.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.encoding import encode as write

    with console.Progress() as progress:
        about = write(file, out, observation, encoder, size, name, progress, allow_code).about
    of = f"{about.size} of {about.features} features, {about.explained:.1%} of their variance"
    print(f"{out}: obs/{name or f'{observation}_features'}: {of}")
