"""The two forms in which LeRobot datasets have subtasks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow

from ddco_pyro.data.sources.lerobot import SUBTASK

PERSISTENT, EVENTS = "language_persistent", "language_events"


def subtask_names(level: str, count: int) -> list[str]:
    """What each choice of a level is called, control (0) first."""
    return ["control", *(f"{level} {option}" for option in range(1, 1 + count))]


class Form(Protocol):
    """How subtasks are written."""

    @property
    def features(self) -> dict[str, Any]:
        """What ``meta/info.json`` says of the new columns."""

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The new columns of an episode.

        :param rows: its rows [T].
        :param options: the option of each [T].
        :param names: what the options are called.
        """

    def tables(self, names: list[str]) -> dict[Path, pyarrow.Table]:
        """Further files of the dataset."""

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """The metadata of the data files."""


class Language:
    """LeRobot 0.6 and newer: ``language_persistent`` holds the subtasks of the whole episode on each of its rows.

    A subtask is active from its ``timestamp``, which is that of its first frame, until the next one.
    """

    features = {name: {"dtype": "language", "shape": [1], "names": None} for name in (PERSISTENT, EVENTS)}  # noqa: RUF012

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The same list on each row, and no events."""
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

    def tables(self, names: list[str]) -> dict[Path, pyarrow.Table]:
        """None."""
        return {}

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """As it was: what it does not say of the columns is read from their types."""
        return dict(known)


class SubtaskIndex:
    """LeRobot 0.4 and 0.5: ``subtask_index`` of each frame, and the names in ``meta/subtasks.parquet``."""

    features = {SUBTASK: {"dtype": "int64", "shape": [1], "names": None}}  # noqa: RUF012

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The option of each row."""
        return {SUBTASK: pyarrow.array(options.astype(np.int64))}

    def tables(self, names: list[str]) -> dict[Path, pyarrow.Table]:
        """The name of each option, as a pandas index, which is how LeRobot reads them."""
        table = pyarrow.table({"subtask": names, SUBTASK: list(range(len(names)))})
        columns = [_column("subtask", "unicode", "object"), _column(SUBTASK, "int64", "int64")]
        pandas = {"index_columns": ["subtask"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
        return {Path("meta/subtasks.parquet"): table.replace_schema_metadata({"pandas": json.dumps(pandas)})}

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """What the ``datasets`` library says of the columns, with the new one."""
        said = known.get(b"huggingface")
        if said is None:
            return dict(known)
        info: dict[str, Any] = json.loads(said)
        info["info"]["features"][SUBTASK] = {"dtype": "int64", "_type": "Value"}
        return {**known, b"huggingface": json.dumps(info).encode()}


def _column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}


FORMS: Mapping[str, Form] = {"0.6": Language(), "0.4": SubtaskIndex()}
"""By the first version of LeRobot that reads them."""
