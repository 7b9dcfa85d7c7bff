"""A new LeRobot v3 dataset from demonstrations in another format, with pyarrow alone."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import write_text
from ddco_pyro.data.sources import Column, Recording, Source
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.formats import Asked

FREQUENCY = 10.0
"""Steps per second (Hz) of a dataset whose demonstrations do not say."""

DATA, EPISODES = "data/chunk-{:03d}/file-{:03d}.parquet", "meta/episodes/chunk-000/file-000.parquet"
LARGEST = 100
"""Size of a data file, MB, at which a new one begins."""

QUANTILES = (1, 10, 50, 90, 99)
FRAMES, PIXELS = 4, 8
"""Statistics use so many pictures of an episode, and every eighth pixel of a row and of a column."""


def write_dataset(folder: Path, asked: Asked, segmented: Segmented) -> None:
    """Write the segmented demonstrations as episodes 0, 1, ...

    An observation ``arm`` is ``observation.arm``: a picture as PNG in the parquet files, other arrays as vectors.
    Floating point numbers are float32 there, and whole numbers keep their type. ``observation.state`` has all vectors
    one after another, unless the source has a ``state``.

    :raises BadInput: two observations have the same name in LeRobot.
    """
    source, names = asked.source, [demo.name for demo in segmented.segments]
    frequency = segmented.frequency or FREQUENCY
    writer, statistics, tasks = _Rows(folder), _Statistics(), dict[str, int]()
    episodes, features, start = list[dict[str, Any]](), dict[str, Any](), 0
    for episode, name in enumerate(names):
        recording = source.recording(name)
        task = recording.attributes.get("task") or source.attributes.get("task") or _environment(source)
        task = str(task or asked.demos.stem)
        columns, features = _columns(recording, statistics)
        steps = recording.actions.shape[0]
        frame = np.arange(steps)
        columns |= {
            "timestamp": pyarrow.array((frame / frequency).astype(np.float32)),
            "frame_index": pyarrow.array(frame),
            "episode_index": pyarrow.array(np.full(steps, episode)),
            "index": pyarrow.array(start + frame),
            "task_index": pyarrow.array(np.full(steps, tasks.setdefault(task, len(tasks)))),
        }
        place = writer.write(pyarrow.table(columns))
        span = {"dataset_from_index": start, "dataset_to_index": start + steps}
        meta = {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        episodes.append({"episode_index": episode, "tasks": [task], "length": steps, **place, **span, **meta})
        start += steps
    writer.close()
    numbers = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in numbers.items()}
    info = {
        "codebase_version": "v3.0", "robot_type": None, "total_episodes": len(names), "total_frames": start,
        "total_tasks": len(tasks), "chunks_size": 1000, "data_files_size_in_mb": LARGEST,
        "video_files_size_in_mb": 200, "fps": int(frequency) if frequency.is_integer() else frequency,
        "splits": {"train": f"0:{len(names)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        "features": features,
    }  # fmt: skip
    (folder / EPISODES).parent.mkdir(parents=True)
    parquet.write_table(pyarrow.Table.from_pylist(episodes), folder / EPISODES)
    write_indexed(
        folder / "meta" / "tasks.parquet", pyarrow.table({"task": list(tasks), "task_index": [*tasks.values()]})
    )
    write_text(folder / "meta" / "stats.json", json.dumps(statistics.summary(), indent=4) + "\n")
    write_text(folder / "meta" / "info.json", json.dumps(info, indent=4) + "\n")


def write_indexed(path: Path, table: pyarrow.Table) -> None:
    """Write a table of texts and their numbers. The texts are the pandas index that LeRobot expects."""
    text, number = table.column_names
    columns = [_column(text, "unicode", "object"), _column(number, "int64", "int64")]
    pandas = {"index_columns": [text], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
    return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}


def _environment(source: Source) -> str:
    """The name of the environment in robomimic's attributes; empty where there is none."""
    try:
        return str(json.loads(str(source.attributes.get("env_args", ""))).get("env_name") or "")
    except (ValueError, AttributeError):
        return ""


def _columns(
    recording: Recording, statistics: _Statistics
) -> tuple[dict[str, pyarrow.Array], dict[str, Mapping[str, Any]]]:
    """The observations and controls of an episode as columns, and the entries of their features."""
    columns, features = dict[str, pyarrow.Array](), dict[str, Mapping[str, Any]]()
    vectors = dict[str, np.ndarray]()
    for key, column in recording.numbers.items():
        name = "observation." + key.replace("/", ".")
        if name in columns.keys() | vectors.keys():
            raise BadInput(f"obs/{key} and another observation are both {name} in LeRobot; rename one")
        if column.image:
            columns[name] = _pictures(column, name, statistics)
            features[name] = {
                "dtype": "image", "shape": list(column.shape[1:]), "names": ["height", "width", "channels"]
            }  # fmt: skip
        else:
            vectors[name] = _vectors(column)
    if vectors and "observation.state" not in vectors:
        vectors["observation.state"] = np.concatenate(list(vectors.values()), axis=1, dtype=np.float32)
    for name, values in {**vectors, "action": _vectors(recording.actions)}.items():
        size = values.shape[1]
        flat = pyarrow.array(values.ravel())
        columns[name] = flat if size == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, size)
        features[name] = {"dtype": str(values.dtype), "shape": [size], "names": None}
        statistics.add(name, values)
    return columns, features


def _vectors(column: Column) -> np.ndarray:
    """Whole numbers, or float32 [T, D]."""
    values = column.array()
    flat = values.reshape(len(values), math.prod(column.shape[1:]))
    return flat.astype(np.float32) if flat.dtype.kind == "f" else flat


def _pictures(column: Column, name: str, statistics: _Statistics) -> pyarrow.Array:
    """Each picture as PNG."""
    encoded, at = list[dict[str, Any]](), 0
    used = set(np.linspace(0, column.shape[0] - 1, FRAMES).astype(int).tolist())
    for block in column.blocks():
        for picture in block:
            if at in used:
                few = picture[::PIXELS, ::PIXELS].reshape(-1, picture.shape[-1], 1, 1)
                statistics.add(name, few.astype(np.float32) / 255)
            _, png = cv2.imencode(".png", picture[..., ::-1])
            encoded.append({"bytes": png.tobytes(), "path": f"frame-{at:06d}.png"})
            at += 1
    return pyarrow.array(encoded, pyarrow.struct({"bytes": pyarrow.binary(), "path": pyarrow.string()}))


class _Rows:
    """Data files, one row group for each episode."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, -1
        self.writer: parquet.ParquetWriter | None = None

    def write(self, table: pyarrow.Table) -> dict[str, int]:
        """Write an episode; returns the place of its file."""
        path = self.folder / DATA.format(*divmod(self.file, 1000))
        if self.writer is None or path.stat().st_size > LARGEST * 1e6:
            self.close()
            self.file += 1
            path = self.folder / DATA.format(*divmod(self.file, 1000))
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = parquet.ParquetWriter(path, table.schema)
        self.writer.write_table(table)
        chunk, file = divmod(self.file, 1000)
        return {"data/chunk_index": chunk, "data/file_index": file}

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()


class _Statistics:
    """The statistics by which LeRobot scales features, over all steps (of pictures: a few of each episode)."""

    def __init__(self) -> None:
        self.values: dict[str, list[np.ndarray]] = {}

    def add(self, name: str, values: np.ndarray) -> None:
        """Further values [N, ...]."""
        self.values.setdefault(name, []).append(values)

    def summary(self) -> dict[str, dict[str, Any]]:
        """The content of ``meta/stats.json``; the channels of pictures are [C, 1, 1]."""
        found = {}
        for name, parts in self.values.items():
            values = np.concatenate(parts).astype(float)
            numbers = {key: getattr(values, key)(axis=0) for key in ("min", "max", "mean", "std")}
            numbers |= dict(
                zip((f"q{q:02d}" for q in QUANTILES), np.percentile(values, QUANTILES, axis=0), strict=True)
            )
            found[name] = {key: value.tolist() for key, value in numbers.items()} | {"count": [len(values)]}
        return found
