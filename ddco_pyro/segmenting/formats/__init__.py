"""The formats of segments, a row each: a function that writes, in a module of its own.

``write(asked, segmented)`` writes a file or folder, whole or not at all, and returns in words what was
written. ``check(asked)`` of formats that copy demonstrations refuses these or an existing place first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from statistics import fmean
from typing import TYPE_CHECKING, Literal, NamedTuple

from ddco_pyro.data.labels import SOURCE, SOURCES, UNKNOWN
from ddco_pyro.errors import BadInput
from ddco_pyro.names import name_in_level

if TYPE_CHECKING:
    from ddco_pyro.data.sources import Source
    from ddco_pyro.fitting.fitted import Fit
    from ddco_pyro.segmenting.segments import Segmented, Segments

Run = tuple[int, int, int]
"""An option that stays active: (option, first step, step after the last)."""


@dataclass(frozen=True)
class Asked:
    """What a format is asked to write, and how it names and orders subtasks.

    :param option: the option of ``segment`` that asks for the format, such as ``--csv``.
    :param out: the file or folder to write.
    :param source: the demonstrations.
    :param level: the level whose options are subtasks.
    :param annotator: who labelled; empty where no one did.
    :param same_order: leave out demonstrations whose options follow another order than most; else refuse.
    """

    option: str
    out: Path
    fit: Fit
    source: Source
    level: str
    same_order: bool = False
    annotator: str = ""

    @cached_property
    def names(self) -> list[str]:
        """The subtask of each choice of the level, control (0) first."""
        return self.names_of(self.level)

    def names_of(self, level: str) -> list[str]:
        """The name of each choice of a level, control (0) first."""
        names = self.fit.names[level]
        return [name_in_level(option, level, names) for option in range(len(names))]

    def runs(self, demo: Segments) -> list[Run]:
        """The subtasks of a demonstration: its level's options; the same option chosen anew stays one run.

        There is none where a person left steps open.
        """
        return [run for run in demo.levels[self.level].runs(anew=False) if run[0] != UNKNOWN]

    def said_by(self, demo: Segments, start: int, stop: int) -> str | None:
        """Who says what steps are, of :data:`~ddco_pyro.data.labels.SOURCES`; None if no person labelled."""
        known = demo.sources.get(self.level + SOURCE)
        return None if known is None else SOURCES[known[start:stop].min()]

    def order(self, segmented: Segmented) -> list[int]:
        """The options that are ever active, by how far through a demonstration they are active on average."""
        places: dict[int, list[float]] = {}
        for demo in segmented.segments:
            options = demo.levels[self.level].options
            for option in {*options.tolist()} - {UNKNOWN}:
                (steps,) = (options == option).nonzero()
                places.setdefault(option, []).append(float(steps.mean()) / len(options))
        return sorted(sorted(places), key=lambda option: fmean(places[option]))


class Format(NamedTuple):
    """A format of segments.

    :param write: its function in this package, ``module:function``.
    :param text: what is written, in words.
    :param takes: the format of demonstrations that it copies, which its module's ``check`` sees; empty: any.
    :param extra: of this project, where the format needs a package: a key of :data:`PACKAGES`.
    """

    kind: Literal["file", "folder", "stream"]
    write: str
    text: str
    takes: Literal["", "robomimic", "lerobot"] = ""
    extra: str = ""


PACKAGES = {"lerobot": "pyarrow", "rerun": "rerun"}

FORMATS = {
    "--html": Format("stream", "tables:write_html", "A page with the timeline of every demonstration."),
    "--csv": Format("stream", "tables:write_csv", "A table with a row for each step."),
    "--parquet": Format("stream", "tables:write_parquet", "The same table as Parquet.", extra="lerobot"),
    "--out": Format(
        "file", "labels:write", "A copy of the HDF5 file with labels for each step.", "robomimic"
    ),
    "--lerobot": Format(
        "folder", "lerobot:write_subtasks", "A copy of a LeRobot dataset with subtasks.", "lerobot"
    ),
    "--sarm": Format(
        "folder", "lerobot:write_stages", "The same with the stages of SARM's reward model.", "lerobot"
    ),
    "--mimicgen": Format(
        "file", "mimicgen:write", "A copy of a prepared file with MimicGen's signals.", "robomimic"
    ),
    "--isaac": Format("file", "mimicgen:write", "The same for Isaac Lab Mimic.", "robomimic"),
    "--label-studio": Format("folder", "annotations:write_label_studio", "Predictions for Label Studio."),
    "--elan": Format("folder", "annotations:write_elan", "ELAN's .eaf of each demonstration."),
    "--rerun": Format(
        "folder", "annotations:write_rerun", "Rerun's .rrd of each demonstration.", extra="rerun"
    ),
}
"""Every format, by its option of ``segment``. A new one is a function, a row here and a parameter there."""

TAKEN = {"robomimic": "HDF5 file in robomimic's layout", "lerobot": "LeRobot dataset"}


def format_of(option: str) -> Format:
    """The format of an option; ``--in-place`` writes what ``--out`` does."""
    return FORMATS[option.replace("--in-place", "--out")]


def check_format(asked: Asked) -> None:
    """Check, before anything is segmented, that a format can be written.

    :raises BadInput: the format copies other demonstrations, its place is taken, or its package is missing.
    """
    form = format_of(asked.option)
    if form.takes not in ("", asked.source.format):
        needs = f"is no {TAKEN[form.takes]}, which {asked.option} needs"
        raise BadInput(f"{asked.source.path}: {needs}; name another format, such as --csv or --html")
    if form.extra and find_spec(PACKAGES[form.extra]) is None:
        remedy = f"install it with: pip install 'ddco-pyro[{form.extra}]'"
        raise BadInput(f"{asked.option} needs {PACKAGES[form.extra]}; {remedy}")
    if form.takes:
        resolve_name(f"{__name__}.{form.write.partition(':')[0]}:check")(asked)


def check_copy(form: str, out: Path, path: Path) -> None:
    """Refuse a place that is no labelled copy of demonstrations of a format.

    :raises BadInput: something else is there.
    """
    module = "labels" if form == "robomimic" else "lerobot"
    if out.exists() and not resolve_name(f"{__name__}.{module}:is_copy")(out, path):
        exists = f"exists and is not a labelled copy of {path}"
        raise BadInput(f"--out {out}: {exists}; choose another --out, or remove it")


def write_format(asked: Asked, segmented: Segmented) -> str:
    """Write segments in a format, and say what was written."""
    said: str = resolve_name(f"{__name__}.{format_of(asked.option).write}")(asked, segmented)
    return said
