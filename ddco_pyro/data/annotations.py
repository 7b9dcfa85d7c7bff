"""Labels of a table: a row for each segment that a person marked: demonstration, label, start and stop."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from urllib.parse import unquote, urlsplit

import numpy as np
import pandas as pd

from ddco_pyro.data.controls import few
from ddco_pyro.data.labels import UNKNOWN, label_names
from ddco_pyro.data.sources import Source
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


Labelled = dict[str, dict[str, np.ndarray]]
"""For labels by name and demonstrations by name, the label of each step [T]; -1 where none is said."""


def labels_of_table(table: LabelTable, source: Source) -> tuple[Labelled, dict[str, list[str]], list[str]]:
    """The labels that a table gives to a source's demonstrations; the source's labels keep their numbers.

    :returns: the labels, the names of labels 0, 1, ... of the table and of the source, and a line for each
        thing in the table that is left out, or read in another way.
    :raises BadInput: the table cannot be read, or does not fit the demonstrations.
    """
    names, found = label_names(source.attributes), Labelled()
    try:
        rows, unit, notes = _segments(_read(table.path), table.columns)
        rows = rows[rows["label"].str.strip() != ""]
        if rows.empty:
            raise BadInput("; ".join(("names no segment", *notes)))
        rows = _in_steps(rows, table.unit or unit, source.frequency)
        rows["demonstration"] = [_demonstration(name, source.names) for name in rows["demonstration"]]
        for labels, of_labels in rows.groupby("labels", sort=False):
            if labels in ("", ".", "..") or "/" in labels:
                raise BadInput(f"{labels!r} cannot be a name of labels; give it another one")
            known = names.get(labels, [])
            spelled = _spelling(of_labels["label"], known)
            if others := [f"{name!r} as {to!r}" for name, to in spelled.items() if name != to]:
                notes.append(f"labels/{labels}: read {', '.join(others)}, since case or blanks alone differ")
            names[labels] = list(dict.fromkeys([*known, *spelled.values()]))
            numbers = {label: names[labels].index(name) for label, name in spelled.items()}
            found[labels] = {
                demo: _painted(f"{demo}: {labels}", of_demo, numbers, len(source.read(demo)))
                for demo, of_demo in of_labels.groupby("demonstration", sort=False)
            }
    except BadInput as error:
        raise BadInput(f"--labels {table.path}: {error}") from None
    return found, names, notes


# --- tables -------------------------------------------------------------------------------------------------

COLUMNS = {
    "demonstration": ("File Name", "Observation id"),
    "label": ("Behavior",),
    "start": ("Begin Time - ss.msec", "Begin Time - msec", "Start (s)"),
    "stop": ("End Time - ss.msec", "End Time - msec", "Stop (s)"),
}
"""The columns of ELAN's tab-delimited text and of BORIS' aggregated events, by role."""

TIERS_BESIDE = ("Begin Time - ", "End Time - ", "Duration - ", "File ")
"""How the columns of ELAN's text begin that are no tiers."""


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


def _segments(table: pd.DataFrame, said: Mapping[str, str]) -> tuple[pd.DataFrame, str | None, list[str]]:
    """Segments, the unit of their times (None if the table is silent), and a line for each thing left out.

    A segment is a row with ``demonstration``, ``labels`` (their name), ``label``, ``start``, ``stop``, and
    ``last``, which says whether the step of ``stop`` is a part of it.

    :param said: the columns by role that the user named.
    """
    table, notes = _aggregated(table)
    for name in said.values():
        if name not in table:
            raise BadInput(f"has no column {name!r}{nearest(name, table)}; there is: {', '.join(table)}")
    known = {role: next((name for name in (role, *COLUMNS[role]) if name in table), "") for role in ROLES}
    columns = {role: name for role, name in {**known, **said}.items() if name}
    if "annotation_id" in table and "demonstration" in columns:
        return _regions(table, columns["demonstration"]), None, []
    tiers = [name for name in table if not name.startswith(TIERS_BESIDE)] if "File Name" in table else []
    if tiers and "label" not in columns:  # ELAN has a column for each
        table = table.melt([name for name in table if name not in tiers], tiers, "labels", "label")
        columns["label"] = "label"
    if missing := ",".join(f"{role}=COLUMN" for role in ROLES if role not in columns):
        raise BadInput(f"its columns are {', '.join(table)}; say what they are with --columns {missing}")
    rows = pd.DataFrame({role: table[columns[role]] for role in ROLES})
    rows = rows.assign(labels=table["labels"] if tiers else columns["label"], last=False)
    if "Behavior type" in table:  # BORIS
        rows, left_out = _states(rows, table)
        notes += left_out
    words = {word for side in ("start", "stop") for word in re.split(r"[^a-z]+", columns[side].lower())}
    units = [unit for unit, its_words in UNITS.items() if its_words & words]
    return rows, "seconds" if "ss" in words else units[0] if len(units) == 1 else None, notes


def _aggregated(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """BORIS' tabular events as its aggregated ones: a row for each START with the next STOP of its behavior.

    Other tables stay. Events without a partner are left out, and a line names them.
    """
    ends = ["START", "STOP"]
    columns = [name for name in ("Behavior type", "Status") if name in table]
    kind = next((name for name in columns if table[name].isin(ends).any()), "")
    if not kind or not {"Observation id", "Subject", "Behavior", "Time"} <= {*table}:
        return table, []
    times = _numbers(table, "Time")
    table = table.assign(**{"Behavior type": table[kind], "Start (s)": times, "Stop (s)": times})
    events = table[table[kind].isin(ends)].sort_values("Start (s)", kind="stable")
    of_behavior = events.groupby(["Observation id", "Subject", "Behavior"], sort=False)
    starts = (events[kind] == "START") & (of_behavior[kind].shift(-1) == "STOP")
    stops = (events[kind] == "STOP") & (of_behavior[kind].shift(1) == "START")
    alone = events[~starts & ~stops]
    next_stop = of_behavior["Stop (s)"].shift(-1)
    states = events.assign(**{"Stop (s)": next_stop, "Behavior type": "STATE"})[starts]
    named = alone["Observation id"] + ": " + alone["Behavior"] + " " + alone[kind] + " at " + alone["Time"]
    notes = [f"left out events without a partner ({len(alone)}): {few([*named])}"] if len(alone) else []
    return pd.concat([states, table.drop(events.index)]).sort_index(), notes


def _states(rows: pd.DataFrame, table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """The states among BORIS' events; labels are called as the subject, or ``behavior`` without one."""
    states = table["Behavior type"] != "POINT"
    rows = rows.assign(labels=table["Subject"].replace(["", "No focal subject"], "behavior"))[states]
    if "Time offset (s)" in table:
        before = _numbers(table[states], "Time offset (s)")
        rows = rows.assign(**{side: _numbers(rows, side) - before for side in ("start", "stop")})
    modifiers = [name for name in table if name.startswith("Modifier")]
    modified = (table.loc[states, modifiers] != "").any(axis=1).sum()
    notes = [f"left out {(~states).sum()} point events, which last no step"] if not states.all() else []
    notes += [f"left out the modifiers of {modified} rows: a label is a behavior alone"] if modified else []
    return rows, notes


def _regions(table: pd.DataFrame, demonstrations: str) -> pd.DataFrame:
    """Segments of Label Studio's CSV: a column for each tag, whose cells list regions as JSON.

    Frames of videos count from 1.
    """
    rows = []
    try:
        for labels in table.drop(columns=demonstrations):
            for demo, cell in zip(table[demonstrations], table[labels], strict=True):
                for region in json.loads(cell) if cell.startswith("[{") else ():
                    kind = next((kind for kind in REGIONS if kind in region), None)
                    if kind and len(region[kind]) > 1:
                        several = f"a region of {labels} has {len(region[kind])} labels"
                        raise BadInput(f"{demo}: {several}; a step has one")
                    for part in region.get("ranges", [region]) if kind else ():
                        start = part["start"] - ("ranges" in region)
                        last = kind == "timeserieslabels"
                        rows.append((demo, labels, "".join(region[kind]), start, part["end"], last))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"is no table as its tool exports it, or is damaged: {error}") from None
    return pd.DataFrame(rows, columns=["demonstration", "labels", "label", "start", "stop", "last"])


REGIONS = ("timeserieslabels", "timelinelabels", "labels")
"""Keys of a region's label in Label Studio, by what is labelled."""

# --- segments -----------------------------------------------------------------------------------------------


def _in_steps(rows: pd.DataFrame, unit: str | None, rate: float | None) -> pd.DataFrame:
    """The segments in whole steps; ``stop`` is exclusive."""
    if unit is None:
        raise BadInput("does not say the unit of its times; add --unit seconds, milliseconds or steps")
    if unit != "steps" and rate is None:
        raise BadInput("the demonstrations do not say how long a step is; add --fps")
    scale = {"seconds": rate, "milliseconds": (rate or 0) / 1000, "steps": 1}[unit]
    start, stop = ((_numbers(rows, side) * scale).round().astype(int) for side in ("start", "stop"))
    rows = rows.assign(start=start, stop=stop + rows["last"])
    after = rows.sort_values("start", kind="stable").groupby(["labels", "demonstration"])["start"].shift(-1)
    after = after.reindex(rows.index)
    shared = rows["last"] & (rows["start"] < after) & (after == rows["stop"] - 1)  # an edge drawn once
    return rows.assign(stop=rows["stop"] - shared)


def _numbers(rows: pd.DataFrame, column: str) -> pd.Series:
    numbers = pd.to_numeric(rows[column], errors="coerce")
    if (bad := ~np.isfinite(numbers)).any():
        row = bad.idxmax()
        raise BadInput(f"row {row + 1}: the {column} {rows[column][row]!r} is no number; correct it")
    return numbers


def _spelling(labels: Iterable[str], known: Collection[str]) -> dict[str, str]:
    """One name for labels that differ by case or blanks alone: that of the source, else the commonest."""
    counts, chosen = Counter(labels), dict[str, str]()
    for name in (*known, *(name for name, _ in counts.most_common())):
        chosen.setdefault("".join(name.split()).casefold(), name.strip())
    return {name: name if name in known else chosen["".join(name.split()).casefold()] for name in counts}


def _demonstration(said: str, names: Collection[str]) -> str:
    """The demonstration that a table names, by itself or by a file, which Label Studio gives a prefix."""
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
            short = f"{row.label} at step {row.start} is shorter than a step"
            raise BadInput(f"{where}: {short}; remove or lengthen it")
        if row.start < before:
            overlap = f"{row.label} and another segment overlap at step {row.start}"
            raise BadInput(f"{where}: {overlap}; a step has one label: end one of them")
        painted[row.start : row.stop], before = numbers[row.label], row.stop
    return painted
