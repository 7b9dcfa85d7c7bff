"""LeRobot v3 datasets: parquet files of many episodes each, JSON and parquet under ``meta``, videos beside them.

Read with pyarrow, without LeRobot itself; what is not used (videos, unless asked for) need not be there.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.sources.recording import Column, Format, Recording, damaged, of_array
from ddco_pyro.data.sources.video import video_column

try:
    import pyarrow
    import pyarrow.parquet as parquet
except ImportError:  # pragma: no cover (the tests' environment has it)
    raise DemonstrationsError(
        "reading LeRobot datasets needs pyarrow; install it with: pip install 'ddco-pyro[lerobot]'"
    ) from None

VERSION = "v3."
OBSERVATION = "observation."
SUBTASK = "subtask_index"
IMAGES_AT_ONCE = 32
_DAMAGE = (pyarrow.ArrowException, OSError, KeyError, ValueError, TypeError, IndexError)


class LeRobot:
    """A dataset's folder: ``meta/info.json``, ``meta/episodes``, ``data`` and ``videos``.

    ``observation.images.top`` becomes ``obs/images/top``; ``action`` becomes ``actions``; ``subtask_index``, where
    there is one, ``labels/subtask``.
    """

    format: Format = "lerobot"

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info: dict[str, Any] = _json(folder / "meta" / "info.json")
        version = str(self.info.get("codebase_version", "of no version"))
        if not version.startswith(VERSION):
            raise DemonstrationsError(
                f"{folder}: is a LeRobot dataset {version}, and {VERSION}x can be read; convert it with "
                "LeRobot's own script first"
            )
        self.features: dict[str, Any] = self.info["features"]
        self._episodes = _episodes(folder)
        if not self._episodes:
            raise DemonstrationsError(f"{folder}: meta/episodes holds no episodes; at least one is needed")
        self.names = tuple(f"demo_{index}" for index in self._episodes)
        fps = self.info.get("fps")
        self.frequency = float(fps) if isinstance(fps, int | float) and fps > 0 else None
        self.masks = self._masks()
        robot = self.info.get("robot_type")
        self.attributes: Mapping[str, Attribute] = {"robot_type": robot} if isinstance(robot, str) else {}
        data = sorted({self.data_file(index) for index in self._episodes})
        self.files = (folder / "meta" / "info.json", *sorted((folder / "meta").rglob("*.parquet")), *data)

    def data_file(self, index: int) -> Path:
        """The parquet file that holds an episode's rows."""
        return self.folder / self._path("data_path", self._episodes[index], "data")

    def _path(self, template: str, episode: Mapping[str, Any], prefix: str, **more: str) -> str:
        numbers = {name: int(episode[f"{prefix}/{name}"]) for name in ("chunk_index", "file_index")}
        return str(self.info[template]).format(**numbers, **more)

    def _masks(self) -> dict[str, tuple[str, ...]]:
        """The splits, such as ``train: "0:40"``, that are not simply all of it."""
        masks = {}
        for name, span in (self.info.get("splits") or {}).items():
            start, _, stop = str(span).partition(":")
            if start.isdecimal() and stop.isdecimal():
                members = [f"demo_{index}" for index in self._episodes if int(start) <= index < int(stop)]
                if 0 < len(members) < len(self.names):
                    masks["valid" if name in ("val", "validation") else name] = tuple(members)
        return masks

    def recording(self, name: str) -> Recording:
        """One episode.

        :raises DemonstrationsError: its rows are missing or damaged.
        """
        index = int(name.removeprefix("demo_"))
        try:
            rows = _Rows(self.data_file(index), index, name)
            keys = [key for key in self.features if key.startswith(OBSERVATION)]
            observations = {_key(key): self._column(rows, key, index) for key in keys}
            labels = {"subtask": rows.vectors(SUBTASK, ())} if SUBTASK in rows.present else {}
            actions = rows.vectors("action", self.features["action"]["shape"])
        except _DAMAGE as error:
            raise damaged(self.folder, name, error) from error
        return Recording(name, observations, actions, labels, self._facts(index))

    def _facts(self, index: int) -> dict[str, Attribute]:
        tasks = self._episodes[index].get("tasks")
        said = {"task": "; ".join(map(str, tasks))} if isinstance(tasks, Sequence) and len(tasks) else {}
        return {"episode_index": index, **said}

    def _column(self, rows: _Rows, key: str, index: int) -> Column:
        kind = self.features[key]["dtype"]
        if kind == "image":
            return rows.images(key, self._size(key))
        if kind == "video":
            episode = self._episodes[index]
            path = self.folder / self._path("video_path", episode, f"videos/{key}", video_key=key)
            start = float(episode[f"videos/{key}/from_timestamp"])
            return video_column(path, start, len(rows), self._size(key), self.frequency or 1.0)
        return rows.vectors(key, self.features[key]["shape"])

    def _size(self, key: str) -> tuple[int, int]:
        """Height and width of an image, whose shape may have its channels first."""
        shape, names = list(self.features[key]["shape"]), list(self.features[key].get("names") or ())
        first = names[:1] in (["channels"], ["channel"]) or (not names and shape[0] in (1, 3))
        height, width = shape[1:] if first else shape[:2]
        return int(height), int(width)


def _key(name: str) -> str:
    return name.removeprefix(OBSERVATION).replace(".", "/")


class _Rows:
    """The rows of one episode in a parquet file."""

    def __init__(self, path: Path, episode: int, name: str) -> None:
        self.path, self.name = path, name
        file, index = _open(path, path.stat().st_mtime_ns)
        self.present = set(file.schema_arrow.names)
        (rows,) = np.nonzero(index == episode)
        if not len(rows) or rows[-1] - rows[0] + 1 != len(rows):
            raise DemonstrationsError(f"{path}: the rows of episode {episode} are missing or not together")
        self.start, self.stop = int(rows[0]), int(rows[-1]) + 1

    def __len__(self) -> int:
        return self.stop - self.start

    def vectors(self, key: str, shape: Sequence[int] = (1,)) -> Column:
        """A column of numbers, or of lists of numbers, whose steps have this shape."""
        parts = [_flat(batch.column(0)).reshape(len(batch), *shape) for batch in self._batches(key, 4096)]
        return of_array(np.concatenate(parts))

    def images(self, key: str, size: tuple[int, int]) -> Column:
        """A column of encoded pictures, uint8 [T, H, W, 3]."""

        def blocks() -> Iterator[np.ndarray]:
            try:
                for batch in self._batches(key, IMAGES_AT_ONCE):
                    yield np.stack([self._picture(picture["bytes"], size) for picture in batch.column(0).to_pylist()])
            except _DAMAGE as error:
                raise damaged(self.path, f"{self.name}: {key}", error) from error

        return Column((len(self), *size, 3), np.dtype(np.uint8), blocks)

    def _picture(self, encoded: bytes | None, size: tuple[int, int]) -> np.ndarray:
        if encoded is None:
            raise DemonstrationsError(f"{self.path}: {self.name}: an image is not in the parquet file itself")
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        if image is None or image.shape[:2] != size:
            raise DemonstrationsError(f"{self.path}: {self.name}: an image is damaged, or not {size[0]} x {size[1]}")
        return np.ascontiguousarray(image[..., ::-1])

    def _batches(self, key: str, rows: int) -> Iterator[Any]:
        """The episode's part of one column, from the row groups that it lies in."""
        file, _ = _open(self.path, self.path.stat().st_mtime_ns)
        ends = np.cumsum([file.metadata.row_group(group).num_rows for group in range(file.metadata.num_row_groups)])
        first, last = np.searchsorted(ends, [self.start, self.stop - 1], side="right")
        at = 0 if first == 0 else int(ends[first - 1])
        for batch in file.iter_batches(rows, list(range(first, last + 1)), [key]):
            low, high = max(self.start - at, 0), min(self.stop - at, len(batch))
            at += len(batch)
            if low < high:
                yield batch.slice(low, high - low)


def _flat(values: Any) -> np.ndarray:
    while pyarrow.types.is_nested(values.type):
        values = values.flatten()
    return values.to_numpy(zero_copy_only=False)


@lru_cache(maxsize=2)
def _open(path: Path, changed: int) -> tuple[parquet.ParquetFile, np.ndarray]:
    """A parquet file and the episode of each of its rows; ``changed`` tells versions of the file apart."""
    file = parquet.ParquetFile(path)
    return file, file.read(["episode_index"]).column(0).to_numpy()


def _episodes(folder: Path) -> dict[int, dict[str, Any]]:
    """What ``meta/episodes`` says of each episode, by its number, without the statistics."""
    episodes: dict[int, dict[str, Any]] = {}
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        try:
            names = parquet.read_schema(path).names
            rows = parquet.read_table(path, columns=[key for key in names if not key.startswith("stats/")]).to_pylist()
            episodes |= {int(row["episode_index"]): row for row in rows}
        except _DAMAGE as error:
            raise damaged(path, "", error) from error
    return dict(sorted(episodes.items()))


def _json(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(info.get("features"), dict):
            raise DemonstrationsError(f"{path}: says nothing of features; is it LeRobot's?")
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise damaged(path, "", error) from error
    return info


@contextmanager
def open_lerobot(path: Path) -> Iterator[LeRobot]:
    """Open such a dataset.

    :raises DemonstrationsError: it is of another version, or damaged.
    """
    try:
        yield LeRobot(path)
    finally:
        _open.cache_clear()
