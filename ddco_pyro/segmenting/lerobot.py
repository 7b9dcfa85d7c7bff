"""Segments as subtasks in a copy of a LeRobot dataset, in the form that LeRobot reads from 0.6 on, or up to 0.5."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.sources.lerobot import SUBTASK, LeRobot
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.lerobot_forms import PERSISTENT, Form, subtask_names


def annotate(source: LeRobot, out: Path, segmented: Segmented, level: str, form: Form) -> None:
    """Write the dataset with its subtasks to ``out``, a new folder, whole or not at all.

    Videos are linked where the file system can, else copied. A copy that has these very subtasks stays as it is.

    :raises BadInput: ``out`` is something else, or the dataset has subtasks of its own, or rows of unknown episodes.
    """
    names = subtask_names(level, segmented.counts[level])
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
    """See that ``out`` is not there, or is a copy with such subtasks.

    :raises BadInput: it is something else, or the dataset has subtasks of its own.
    """
    if {SUBTASK, PERSISTENT} & source.features.keys():
        raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
    if out.resolve().is_relative_to(source.folder.resolve()):
        raise BadInput(f"{out}: lies in the dataset itself; choose another --lerobot")
    info = out / "meta" / "info.json"
    if out.exists() and not (
        (info.is_file() and info.read_text(encoding="utf-8") == _info(source, form))
        and all((out / path).is_file() and _equal(out / path, table) for path, table in form.tables(names).items())
    ):
        raise _taken(out)


def _equal(path: Path, table: pyarrow.Table) -> bool:
    return parquet.read_table(path).to_pylist() == table.to_pylist()


def _taken(out: Path) -> BadInput:
    return BadInput(f"{out}: is there already; choose another --lerobot")


def _info(source: LeRobot, form: Form) -> str:
    """``meta/info.json`` with the subtasks."""
    return json.dumps({**source.info, "features": {**source.features, **form.features}}, indent=4) + "\n"


def _link(source: str, target: str) -> None:
    """Copy a file; of a link in the dataset, the file that it leads to."""
    source = os.path.realpath(source)
    if Path(target).suffix == ".mp4":
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system, or one without links
    shutil.copy2(source, target)


def _write(source: Path, target: Path, options: Mapping[str, np.ndarray], names: list[str], form: Form) -> None:
    """The same rows with the form's columns, a row group for each episode, as LeRobot writes them."""
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
    """Whether a data file of a copy, which is whole, has these very subtasks."""
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
    """The rows of each episode in a data file, and the columns that go with them.

    :raises BadInput: it has rows of an episode that the dataset does not name, or no times.
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
