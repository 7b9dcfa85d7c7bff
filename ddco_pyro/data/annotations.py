"""Labels of a table: a row for each segment that a person marked, with a demonstration, a label, a start and a stop."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from urllib.parse import unquote, urlsplit

import numpy as np
import pandas as pd

from ddco_pyro.data.hdf5 import Attribute
from ddco_pyro.data.sources import Recording, Source
from ddco_pyro.data.sources.recording import BOUNDARY, LABEL_NAMES, UNKNOWN, label_names, of_array
from ddco_pyro.errors import BadInput, nearest

ROLES = ("demonstration", "label", "start", "stop")

UNITS = {
    "seconds": {"s", "ss", "sec", "secs", "second", "seconds"},
    "milliseconds": {"ms", "msec", "msecs", "millisecond", "milliseconds"},
    "steps": {"step", "steps", "frame", "frames"},
}
"""Units of times, and the words that say them in the name of a column."""


@dataclass(frozen=True)
class LabelTable:
    """A CSV, TSV or Parquet file of segments.

    :param columns: the column of each of :data:`ROLES`; those of ELAN, BORIS and Label Studio are known.
    :param unit: of the times, one of :data:`UNITS`; None where the names of the columns say it.
    :param rate: steps per second; None for those of the demonstrations.
    """

    path: Path
    columns: Mapping[str, str] = field(default_factory=dict)
    unit: str | None = None
    rate: float | None = None


class Labelled:
    """A source whose recordings have the labels of a table; those of the same name are replaced.

    Steps of which the table says nothing are -1. Labels keep the numbers that their names have in the source.

    :ivar counts: for labels by name, the number of demonstrations in which a step is named.
    :ivar notes: a line for each thing in the table that is left out, or read in another way.

    :raises BadInput: the table cannot be read, or does not fit the demonstrations.
    """

    def __init__(self, source: Source, table: LabelTable) -> None:
        self._source, self.frequency = source, table.rate or source.frequency
        self.format, self.names, self.masks, self.files = source.format, source.names, source.masks, source.files
        self._labels: dict[str, dict[str, np.ndarray]] = {}
        names = label_names(source.attributes)
        try:
            said, unit, self.notes = _segments(_read(table.path), table.columns)
            rows = _in_steps(said, table.unit or unit, self.frequency)
            rows["demonstration"] = [_demonstration(name, self.names) for name in rows["demonstration"]]
            for labels, of_labels in rows.groupby("labels", sort=False):
                if labels in ("", ".", "..") or "/" in labels:
                    raise BadInput(f"{labels!r} cannot be a name of labels; give it another one")
                known = names.get(labels, [])
                spelled = _spelling(of_labels["label"], known)
                if others := [f"{name!r} as {to!r}" for name, to in spelled.items() if name != to]:
                    self.notes.append(f"labels/{labels}: read {', '.join(others)}, since case or blanks alone differ")
                names[labels] = list(dict.fromkeys([*known, *spelled.values()]))
                numbers = {label: names[labels].index(name) for label, name in spelled.items()}
                self._labels[labels] = {
                    demo: _painted(f"{demo}: {labels}", of_demo, numbers, source.recording(demo).actions.shape[0])
                    for demo, of_demo in of_labels.groupby("demonstration", sort=False)
                }
        except BadInput as error:
            raise BadInput(f"--labels {table.path}: {error}") from None
        self.counts = {labels: len(each) for labels, each in self._labels.items()}
        self.attributes: Mapping[str, Attribute] = {**source.attributes, LABEL_NAMES: json.dumps(names)}

    def recording(self, name: str) -> Recording:
        """One recording, with its labels."""
        recording = self._source.recording(name)
        unknown = np.full(recording.actions.shape[0], UNKNOWN, np.int16)
        stale = {f"{labels}{end}" for labels in self._labels for end in ("", BOUNDARY)}
        kept = {key: column for key, column in recording.labels.items() if key not in stale}
        given = {labels: of_array(each.get(name, unknown)) for labels, each in self._labels.items()}
        return replace(recording, labels={**kept, **given})


# --- tables -----------------------------------------------------------------------------------------------------------

Said = tuple[pd.DataFrame, str | None, list[str]]
"""Segments, their unit (None where the table does not say it), and a line for each thing that is left out. A segment is
a row with ``demonstration``, ``labels`` (their name), ``label``, ``start``, ``stop``, and ``last``: whether the step of
``stop`` is a part of it."""


def _read(path: Path) -> pd.DataFrame:
    """The cells of a table, as text."""
    if not path.is_file():
        raise BadInput("is a folder; give a table: CSV, TSV or Parquet" if path.exists() else "is missing")
    try:
        if path.suffix == ".parquet":
            table = pd.read_parquet(path).astype(object)
            return table.where(table.notna(), "").astype(str)
        with path.open(encoding="utf-8-sig") as file:
            separator = max("\t;,", key=file.readline().count)
        return pd.read_csv(path, sep=separator, dtype=str, keep_default_na=False, encoding="utf-8-sig")
    except ImportError:
        raise BadInput("Parquet needs pyarrow; install it with: pip install 'ddco-pyro[lerobot]'") from None
    except (ValueError, OSError) as error:
        raise BadInput(f"cannot be read as a table, or is damaged: {' '.join(str(error).split())}") from None


def _segments(table: pd.DataFrame, columns: Mapping[str, str]) -> Said:
    for name in columns.values():
        if name not in table:
            raise BadInput(f"has no column {name!r}{nearest(name, table)}; there is: {', '.join(table)}")
    mark = next((mark for mark in TOOLS if mark in table), "") if columns.keys() <= {"demonstration"} else ""
    needed = ROLES[:1] if mark else ROLES
    columns = {**{role: role for role in ROLES if role in table}, **columns}
    if mark and TOOLS[mark][0] in table:
        columns.setdefault("demonstration", TOOLS[mark][0])
    if missing := ",".join(f"{role}=COLUMN" for role in needed if role not in columns):
        raise BadInput(f"its columns are {', '.join(table)}; say what they are with --columns {missing}")
    rows = pd.DataFrame({role: table[columns[role]] for role in needed})
    if mark:
        try:
            return TOOLS[mark][1](rows.join(table.drop(columns=columns["demonstration"])))
        except BadInput:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise BadInput(f"is no table as its tool exports it, or is damaged: {error}") from None
    words = {word for side in ("start", "stop") for word in re.split(r"[^a-z]+", columns[side].lower())}
    units = [unit for unit, its_words in UNITS.items() if its_words & words]
    return rows.assign(labels=columns["label"], last=False), units[0] if len(units) == 1 else None, []


def _elan(table: pd.DataFrame) -> Said:
    """ELAN's tab-delimited text of multiple files, which has a column for each tier."""
    form, unit = ("msec", "milliseconds") if "Begin Time - msec" in table else ("ss.msec", "seconds")
    table = table.rename(columns={f"Begin Time - {form}": "start", f"End Time - {form}": "stop"})
    fixed, others = ["demonstration", "start", "stop"], ("File Path", "Begin Time - ", "End Time - ", "Duration - ")
    tiers = [name for name in table if name not in fixed and not name.startswith(others)]
    return table.melt(fixed, tiers, "labels", "label").assign(last=False), unit, []


def _boris(table: pd.DataFrame) -> Said:
    """BORIS' events or aggregated events; labels are called as the subject, or ``behavior`` without one."""
    table = table.rename(columns={"Behavior": "label", "Start (s)": "start", "Stop (s)": "stop", "Time": "start"})
    points = table["Behavior type"] == "POINT"
    notes = [f"left out {points.sum()} point events, which last no step"] if points.any() else []
    modifiers = [name for name in table if name.startswith("Modifier")]
    table = table[~points].assign(labels=table["Subject"].replace(["", "No focal subject"], "behavior"), last=False)
    if modified := int((table[modifiers] != "").any(axis=1).sum()):
        notes.append(f"left out the modifiers of {modified} rows: a label is a behavior alone")
    if "stop" not in table:  # a row for each START and each STOP
        table = table.assign(start=_numbers(table, "start")).sort_values("start", kind="stable")
        states = table.groupby(["demonstration", "labels", "label", *modifiers])
        begins, after = table["Behavior type"] == "START", states["Behavior type"].shift(-1)
        paired = begins & (after == "STOP")
        for row in table[np.where(begins, ~paired, states["Behavior type"].shift() != "START")].to_dict("records"):
            kind, other = ("START", "STOP") if row["Behavior type"] == "START" else ("STOP", "START")
            what = f"{row['label']} in {row['demonstration']}, a {kind} at {row['start']:g} s"
            notes.append(f"left out {what} without its {other}")
        table = table.assign(stop=states["start"].shift(-1))[paired]
    before = _numbers(table, "Time offset (s)") if "Time offset (s)" in table else 0
    ends = {side: _numbers(table, side) - before for side in ("start", "stop")}
    return table.assign(**ends), "seconds", notes


def _label_studio(table: pd.DataFrame) -> Said:
    """Label Studio's CSV: a column for each tag, whose cells list regions as JSON. Frames of videos count from 1."""
    rows = []
    for labels in table:
        for demo, cell in zip(table["demonstration"], table[labels], strict=True):
            for region in json.loads(cell) if cell.startswith("[{") else ():
                kind = next((kind for kind in ("timeserieslabels", "timelinelabels", "labels") if kind in region), None)
                if kind and len(region[kind]) > 1:
                    raise BadInput(f"{demo}: a region of {labels} has {len(region[kind])} labels; a step has one")
                for part in region.get("ranges", [region]) if kind else ():
                    start = part["start"] - ("ranges" in region)
                    rows.append((demo, labels, "".join(region[kind]), start, part["end"], kind == "timeserieslabels"))
    return pd.DataFrame(rows, columns=["demonstration", "labels", "label", "start", "stop", "last"]), None, []


TOOLS = {
    "Begin Time - msec": ("File Name", _elan),
    "Begin Time - ss.msec": ("File Name", _elan),
    "Behavior type": ("Observation id", _boris),
    "annotation_id": ("demonstration", _label_studio),
}
"""What ELAN, BORIS and Label Studio export, by a column that other tables do not have: the column of demonstrations,
and the reader."""

# --- segments ---------------------------------------------------------------------------------------------------------


def _in_steps(rows: pd.DataFrame, unit: str | None, rate: float | None) -> pd.DataFrame:
    """The segments that have a label, in whole steps; ``stop`` is exclusive."""
    rows = rows[rows["label"].str.strip() != ""]
    if rows.empty:
        raise BadInput("names no segment")
    if unit is None:
        raise BadInput("does not say the unit of its times; add --unit seconds, milliseconds or steps")
    if unit != "steps" and rate is None:
        raise BadInput("the demonstrations do not say how long a step is; add --fps")
    scale = {"seconds": rate, "milliseconds": (rate or 0) / 1000, "steps": 1}[unit]
    start, stop = ((_numbers(rows, side) * scale).round().astype(int) for side in ("start", "stop"))
    rows = rows.assign(start=start, stop=stop + rows["last"])
    after = rows.sort_values("start", kind="stable").groupby(["labels", "demonstration"])["start"].shift(-1)
    after = after.reindex(rows.index)
    shared = rows["last"] & (rows["start"] < after) & (after == rows["stop"] - 1)  # an edge drawn once for both
    return rows.assign(stop=rows["stop"] - shared)


def _numbers(rows: pd.DataFrame, column: str) -> pd.Series:
    numbers = pd.to_numeric(rows[column], errors="coerce")
    if (bad := ~np.isfinite(numbers)).any():
        raise BadInput(f"row {bad.idxmax() + 1}: the {column} {rows[column][bad.idxmax()]!r} is no number; correct it")
    return numbers


def _spelling(labels: Iterable[str], known: Collection[str]) -> dict[str, str]:
    """One name for labels that differ by case or blanks alone: that of the source, else the commonest."""
    counts, chosen = Counter(labels), dict[str, str]()
    for name in (*known, *(name for name, _ in counts.most_common())):
        chosen.setdefault("".join(name.split()).casefold(), name.strip())
    return {name: name if name in known else chosen["".join(name.split()).casefold()] for name in counts}


def _demonstration(said: str, names: Collection[str]) -> str:
    """The demonstration that a table names, by itself or by a file, before which Label Studio puts a prefix."""
    stem = PurePath(unquote(urlsplit(said).path)).stem
    for name in (said, stem, stem.partition("-")[2]):
        if name in names:
            return name
    raise BadInput(f"there is no demonstration {said!r}{nearest(stem, names)}")


def _painted(where: str, rows: pd.DataFrame, numbers: Mapping[str, int], steps: int) -> np.ndarray:
    """The number of the label of each step of a demonstration."""
    painted, before = np.full(steps, UNKNOWN, np.int16), 0
    for row in rows.sort_values("start", kind="stable").itertuples():
        if not 0 <= row.start <= row.stop <= steps:
            lasts = f"lasts from step {row.start} to {row.stop}, but there are {steps} steps"
            raise BadInput(f"{where}: {row.label} {lasts}; correct it, the unit or --fps")
        if row.start == row.stop:
            raise BadInput(f"{where}: {row.label} at step {row.start} is shorter than a step; remove or lengthen it")
        if row.start < before:
            overlap = f"{row.label} and another segment overlap at step {row.start}"
            raise BadInput(f"{where}: {overlap}; a step has one label: end one of them")
        painted[row.start : row.stop], before = numbers[row.label], row.stop
    return painted
