"""Segments as subtasks in a copy of a LeRobot dataset, in either of the two forms that LeRobot reads."""

from __future__ import annotations

import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.sources.lerobot import SUBTASK, LeRobot
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.drawing.words import name_in_level
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented

PERSISTENT, EVENTS = "language_persistent", "language_events"


def subtasks(level: str, count: int, names: Sequence[str]) -> list[str]:
    """The subtask of each choice of a level, control (0) first."""
    return [name_in_level(option, level, names) for option in range(1 + count)]


class Form(ABC):
    """How a dataset holds subtasks: ``features`` are the entries of the new columns in ``meta/info.json``."""

    features: ClassVar[dict[str, Any]]

    @abstractmethod
    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The new columns of an episode.

        :param rows: the episode's rows [T].
        :param options: the option of each row [T].
        :param names: the subtask of each option.
        """

    def tables(self, names: list[str]) -> dict[Path, pyarrow.Table]:
        """Further files of the dataset."""
        return {}

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """The metadata of the data files, from the metadata before."""
        return dict(known)


class Language(Form):
    """LeRobot 0.6 and newer: each row holds all subtasks of its episode in ``language_persistent``.

    A subtask lasts from its ``timestamp``, the time of its first frame, to the next subtask.
    """

    features: ClassVar = {name: {"dtype": "language", "shape": [1], "names": None} for name in (PERSISTENT, EVENTS)}

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The same list of subtasks on each row, and no events."""
        starts = np.flatnonzero(np.diff(options, prepend=-1))
        text = pyarrow.string()
        entries = {
            "role": pyarrow.array(["assistant"] * len(starts)),
            "content": pyarrow.array([names[option] for option in options[starts]]),
            "style": pyarrow.array(["subtask"] * len(starts)),
            "timestamp": rows["timestamp"].combine_chunks().take(pyarrow.array(starts)),
            "camera": pyarrow.nulls(len(starts), text),
            "tool_calls": pyarrow.nulls(len(starts), pyarrow.list_(text)),
        }
        events = {name: values.type for name, values in entries.items() if name != "timestamp"}
        persistent = pyarrow.StructArray.from_arrays(list(entries.values()), list(entries))
        on_each_row = persistent.take(pyarrow.array(np.tile(np.arange(len(starts)), len(rows))))
        offsets = np.arange(len(rows) + 1, dtype=np.int32)
        return {
            PERSISTENT: pyarrow.ListArray.from_arrays(pyarrow.array(offsets * len(starts)), on_each_row),
            EVENTS: pyarrow.ListArray.from_arrays(
                pyarrow.array(0 * offsets), pyarrow.array([], pyarrow.struct(events))
            ),
        }


class SubtaskIndex(Form):
    """LeRobot 0.4 and 0.5: ``subtask_index`` of each frame, and the names in ``meta/subtasks.parquet``."""

    features: ClassVar = {SUBTASK: {"dtype": "int64", "shape": [1], "names": None}}

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The option of each row."""
        return {SUBTASK: pyarrow.array(options.astype(np.int64))}

    def tables(self, names: list[str]) -> dict[Path, pyarrow.Table]:
        """The name of each option, as the pandas index that LeRobot expects."""
        table = pyarrow.table({"subtask": names, SUBTASK: list(range(len(names)))})
        columns = [_column("subtask", "unicode", "object"), _column(SUBTASK, "int64", "int64")]
        pandas = {"index_columns": ["subtask"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
        return {Path("meta/subtasks.parquet"): table.replace_schema_metadata({"pandas": json.dumps(pandas)})}

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """The columns as the ``datasets`` library lists them, with the new one."""
        listed = known.get(b"huggingface")
        if listed is None:
            return dict(known)
        info: dict[str, Any] = json.loads(listed)
        info["info"]["features"][SUBTASK] = {"dtype": "int64", "_type": "Value"}
        return {**known, b"huggingface": json.dumps(info).encode()}


def _column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}


FORMS: Mapping[str, Form] = {"0.6": Language(), "0.4": SubtaskIndex()}
"""The forms, by the first version of LeRobot that reads them."""


def annotate(source: LeRobot, out: Path, segmented: Segmented, level: str, form: Form) -> None:
    """Write a copy of the dataset with subtasks to ``out``, a new folder, whole or not at all.

    Videos are hard links where the file system has them, else copies. A folder that has these very subtasks is not
    written again.

    :raises BadInput: ``out`` is something else, the dataset has subtasks already, or it has rows of unknown episodes.
    """
    names = subtasks(level, segmented.counts[level], segmented.names.get(level, ()))
    check_target(source, out, names, form)
    options = {demo.name.removeprefix("demo_"): demo.levels[level].options for demo in segmented.segments}
    if out.exists():
        if not all(_has(source.folder / path, out / path, options, names, form) for path in source.data_files):
            raise _taken(out)
        return
    with whole_folder(out) as temporary:
        shutil.copytree(
            source.folder, temporary, dirs_exist_ok=True, copy_function=_link, ignore_dangling_symlinks=True
        )
        for path in (Path("meta/info.json"), *source.data_files):
            inside(temporary, path).unlink()
        for path in source.data_files:
            _write(source.folder / path, temporary / path, options, names, form)
        for path, table in form.tables(names).items():
            parquet.write_table(table, temporary / path)
        write_text(temporary / "meta" / "info.json", _info(source, form))


def check_target(source: LeRobot, out: Path, names: list[str], form: Form) -> None:
    """Check that ``out`` does not exist or is a copy with such subtasks.

    :raises BadInput: ``out`` is something else, or the dataset has subtasks already.
    """
    if {SUBTASK, PERSISTENT} & source.features.keys():
        raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
    if out.resolve().is_relative_to(source.folder.resolve()):
        raise BadInput(f"{out}: lies in the dataset; choose another --lerobot")
    info = out / "meta" / "info.json"
    if out.exists() and not (
        (info.is_file() and info.read_text(encoding="utf-8") == _info(source, form))
        and all((out / path).is_file() and _equal(out / path, table) for path, table in form.tables(names).items())
    ):
        raise _taken(out)


def _equal(path: Path, table: pyarrow.Table) -> bool:
    return parquet.read_table(path).to_pylist() == table.to_pylist()


def _taken(out: Path) -> BadInput:
    return BadInput(f"{out}: exists; choose another --lerobot")


def _info(source: LeRobot, form: Form) -> str:
    """``meta/info.json`` with the subtasks."""
    return json.dumps({**source.info, "features": {**source.features, **form.features}}, indent=4) + "\n"


def _link(source: str, target: str) -> None:
    """Copy a file, following links; link a video instead where that is possible."""
    source = os.path.realpath(source)
    if Path(target).suffix == ".mp4":
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system, or one without links
    shutil.copy2(source, target)


def _write(source: Path, target: Path, options: Mapping[str, np.ndarray], names: list[str], form: Form) -> None:
    """Write the rows with the form's columns, one row group for each episode, as LeRobot does."""
    table = parquet.read_table(source)
    writer = None
    for rows, columns in _episodes(table, options, names, form):
        for name, values in columns.items():
            rows = rows.append_column(name, values)
        rows = rows.replace_schema_metadata(form.metadata(table.schema.metadata or {}))
        writer = writer or parquet.ParquetWriter(target, rows.schema)
        writer.write_table(rows)
    assert writer is not None  # a file of a dataset holds an episode
    writer.close()


def _has(source: Path, target: Path, options: Mapping[str, np.ndarray], names: list[str], form: Form) -> bool:
    """Whether a data file of a copy has these very subtasks."""
    there = parquet.read_table(target)
    expected = _episodes(parquet.read_table(source, columns=["episode_index", "timestamp"]), options, names, form)
    start = 0
    for rows, columns in expected:
        if not there.select(list(columns)).slice(start, len(rows)).equals(pyarrow.table(columns)):
            return False
        start += len(rows)
    return start == len(there)


def _episodes(
    table: pyarrow.Table, options: Mapping[str, np.ndarray], names: list[str], form: Form
) -> Iterator[tuple[pyarrow.Table, dict[str, pyarrow.Array]]]:
    """The rows of each episode in a data file, and the new columns.

    :raises BadInput: the file has no times, or rows of an episode that the dataset does not name.
    """
    if "timestamp" not in table.column_names:
        raise BadInput("the data files have no column timestamp; subtasks begin at times of frames")
    index = table["episode_index"].to_numpy()
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), len(index)]
    for start, stop in pairwise(bounds):
        rows = table.slice(start, stop - start)
        known = options.get(str(index[start]))
        if known is None or len(known) != len(rows):
            raise BadInput(f"the data files have rows of episode {index[start]} that meta/episodes does not name")
        yield rows, form.columns(rows, known, names)
