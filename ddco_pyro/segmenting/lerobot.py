"""Segments as subtasks in a copy of a LeRobot dataset: ``subtask_index`` of each frame, ``meta/subtasks.parquet``."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.errors import BadInput
from ddco_pyro.files import whole_folder, write_text
from ddco_pyro.segmenting import Segmented
from ddco_pyro.sources.lerobot import SUBTASK, LeRobot

FEATURE = {"dtype": "int64", "shape": [1], "names": None}


def annotate(source: LeRobot, out: Path, found: Segmented, level: str) -> None:
    """Write the dataset with its subtasks to ``out``, a new folder, whole or not at all.

    Videos are linked where the file system can, else copied. A copy that has these very subtasks stays as it is.

    :raises BadInput: ``out`` is something else, or the dataset has subtasks of its own.
    """
    check_target(source, out, level, found.counts[level])
    if out.exists():
        if not _has(source, out, found, level):
            raise _taken(out)
        return
    with whole_folder(out) as temporary:
        shutil.copytree(source.folder, temporary, dirs_exist_ok=True, copy_function=_link)
        for path in (Path("meta/info.json"), *_data(source)):
            (temporary / path).unlink()
        for path in _data(source):
            _write_data(source.folder / path, temporary / path, found, level)
        _write_names(temporary / "meta" / "subtasks.parquet", level, found.counts[level])
        write_text(temporary / "meta" / "info.json", _info(source))


def check_target(source: LeRobot, out: Path, level: str, count: int) -> None:
    """See that ``out`` is not there, or is a copy with such subtasks: options 1 to ``count`` of this level.

    :raises BadInput: it is something else, or the dataset has subtasks of its own.
    """
    if SUBTASK in source.features:
        raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
    info, names = out / "meta" / "info.json", out / "meta" / "subtasks.parquet"
    if out.exists() and not (
        (info.is_file() and info.read_text(encoding="utf-8") == _info(source))
        and (names.is_file() and parquet.read_table(names)["subtask"].to_pylist() == _option_names(level, count))
    ):
        raise _taken(out)


def _taken(out: Path) -> BadInput:
    return BadInput(f"{out}: is there already; choose another --lerobot")


def _info(source: LeRobot) -> str:
    """``meta/info.json`` with the subtasks."""
    return json.dumps({**source.info, "features": {**source.features, SUBTASK: FEATURE}}, indent=4) + "\n"


def _data(source: LeRobot) -> list[Path]:
    """The files of the dataset that hold steps."""
    data = source.folder / "data"
    return sorted(path.relative_to(source.folder) for path in source.files if path.is_relative_to(data))


def _has(source: LeRobot, out: Path, found: Segmented, level: str) -> bool:
    """Whether a copy with such subtasks, which is whole, has these very ones."""
    return all(
        np.array_equal(
            parquet.read_table(out / path, columns=[SUBTASK])[SUBTASK].to_numpy(),
            _options(parquet.read_table(source.folder / path, columns=["episode_index"]), found, level),
        )
        for path in _data(source)
    )


def _link(source: str, target: str) -> None:
    if Path(source).suffix == ".mp4":
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # another file system, or one without links
    shutil.copy2(source, target)


def _write_data(source: Path, target: Path, found: Segmented, level: str) -> None:
    """The same rows with a column that says which option is active."""
    table = parquet.read_table(source)
    index = _options(table, found, level)
    schema = _with_feature(table.schema.metadata or {})
    parquet.write_table(table.append_column(SUBTASK, pyarrow.array(index)).replace_schema_metadata(schema), target)


def _options(table: pyarrow.Table, found: Segmented, level: str) -> np.ndarray:
    """The option of each row."""
    episodes = table["episode_index"].to_numpy()
    index = np.zeros(len(table), np.int64)
    for one in found.segments:
        rows = episodes == int(one.name.removeprefix("demo_"))
        if rows.any():
            index[rows] = one.levels[level].options
    return index


def _with_feature(metadata: dict[bytes, bytes]) -> dict[bytes, bytes]:
    """What the ``datasets`` library says of the columns, with the new one."""
    said = metadata.get(b"huggingface")
    if said is None:
        return metadata
    info: dict[str, Any] = json.loads(said)
    info["info"]["features"][SUBTASK] = {"dtype": "int64", "_type": "Value"}
    return {**metadata, b"huggingface": json.dumps(info).encode()}


def _write_names(path: Path, level: str, count: int) -> None:
    """The name of each option, as a pandas index, which is how LeRobot reads them."""
    table = pyarrow.table({"subtask": _option_names(level, count), SUBTASK: list(range(1 + count))})
    columns = [_column("subtask", "unicode", "object"), _column(SUBTASK, "int64", "int64")]
    pandas = {"index_columns": ["subtask"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _option_names(level: str, count: int) -> list[str]:
    return [f"{level} {choice}" if choice else "control" for choice in range(1 + count)]


def _column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
