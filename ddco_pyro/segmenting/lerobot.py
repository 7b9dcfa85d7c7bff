"""Segments as subtasks in a copy of a LeRobot dataset: ``subtask_index`` of each frame, ``meta/subtasks.parquet``."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.errors import BadInput
from ddco_pyro.files import write_text
from ddco_pyro.segmenting import Segmented
from ddco_pyro.sources.lerobot import SUBTASK, LeRobot

FEATURE = {"dtype": "int64", "shape": [1], "names": None}


def annotate(source: LeRobot, out: Path, found: Segmented, level: str) -> None:
    """Write the dataset with its subtasks to ``out``, a new folder, whole or not at all.

    Videos are linked where the file system can, else copied.

    :raises BadInput: ``out`` is there already, or the dataset has subtasks of its own.
    """
    check_target(source, out)
    out.parent.mkdir(parents=True, exist_ok=True)
    for old in out.parent.glob(f".{out.name}-*.tmp"):
        shutil.rmtree(old)
    temporary = Path(tempfile.mkdtemp(prefix=f".{out.name}-", suffix=".tmp", dir=out.parent))
    try:
        changed = {
            path.relative_to(source.folder) for path in source.files if path.is_relative_to(source.folder / "data")
        }
        changed.add(Path("meta/info.json"))
        shutil.copytree(source.folder, temporary, dirs_exist_ok=True, copy_function=_link)
        for path in changed:
            (temporary / path).unlink()
        for path in sorted(changed - {Path("meta/info.json")}):
            _write_data(source.folder / path, temporary / path, found, level)
        _write_names(temporary / "meta" / "subtasks.parquet", level, found.counts[level])
        info = {**source.info, "features": {**source.features, SUBTASK: FEATURE}}
        write_text(temporary / "meta" / "info.json", json.dumps(info, indent=4) + "\n")
        temporary.chmod(0o755)
        temporary.rename(out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_target(source: LeRobot, out: Path) -> None:
    """:raises BadInput: ``out`` is there already, or the dataset has subtasks of its own."""
    if SUBTASK in source.features:
        raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
    if out.exists():
        raise BadInput(f"{out}: is there already; choose another --lerobot")


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
    episodes = table["episode_index"].to_numpy()
    index = np.zeros(len(table), np.int64)
    for one in found.segments:
        rows = episodes == int(one.name.removeprefix("demo_"))
        if rows.any():
            index[rows] = one.levels[level].options
    schema = _with_feature(table.schema.metadata or {})
    parquet.write_table(table.append_column(SUBTASK, pyarrow.array(index)).replace_schema_metadata(schema), target)


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
    names = [f"{level} {choice}" if choice else "control" for choice in range(1 + count)]
    table = pyarrow.table({"subtask": names, SUBTASK: list(range(1 + count))})
    columns = [_column("subtask", "unicode", "object"), _column(SUBTASK, "int64", "int64")]
    pandas = {"index_columns": ["subtask"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
