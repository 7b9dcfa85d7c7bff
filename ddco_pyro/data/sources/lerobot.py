"""LeRobot v3 datasets: parquet files of several episodes, metadata in JSON and parquet, and videos.

The reader uses pyarrow and not LeRobot. Files that are not read, such as videos by default, may be missing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import numpy as np

from ddco_pyro.data.arrays import PICTURES, LazyArray, Observed, channels_last, in_blocks, turned
from ddco_pyro.data.demonstration import DIMENSION_NAMES, Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError, reading
from ddco_pyro.data.labels import EXCLUDE, LABEL_NAMES, SOURCE, UNKNOWN
from ddco_pyro.data.sources import Source
from ddco_pyro.data.sources.metadata import (
    check_count,
    clock_fault,
    filled,
    inside,
    joined,
    rate,
    stored_keys,
)
from ddco_pyro.data.sources.video import frames_of_steps
from ddco_pyro.errors import nearest, needing

with needing("lerobot", "reading LeRobot datasets"):
    import pyarrow
    import pyarrow.compute as compute
    import pyarrow.parquet as parquet

VERSION = "v3."
_CONVERT = (
    "convert it with LeRobot's own script: python -m lerobot.scripts.convert_dataset_v21_to_v30 "
    "(in LeRobot 0.4: lerobot.datasets.v30.convert_dataset_v21_to_v30)"
)
OBSERVATION, ACTION = "observation.", "action"
SUBTASK, TASK = "subtask_index", "task_index"
MOST_NAMES = 10_000
"""Most tasks, or subtasks, that have names."""
ANNOTATIONS = Path("meta") / "lerobot_annotations.json"
WHO = "subtask" + SOURCE
"""The column, and the label, of who says what a step's subtask is, where a person labelled."""
_NO_CONTROL = {"timestamp", "frame_index", "episode_index", "index", "task_index", "image", "video", "string"}
"""Names and types of features that are never the control."""


class LeRobot:
    """A dataset's folder: ``meta/info.json``, ``meta/episodes``, ``data`` and ``videos``.

    ``observation.images.top`` becomes ``obs/images/top``, ``action`` becomes ``actions``, and
    ``subtask_index`` becomes ``labels/subtask``. Beside ``observation.state``, the feature
    ``observation.state.gripper`` keeps its dots. Where tasks change within an episode, ``task_index`` becomes
    ``labels/task``. Names are those of ``meta/subtasks.parquet`` and ``meta/tasks.parquet``. Without the
    column of subtasks, the subtasks in ``meta/lerobot_annotations.json`` become labels: they are numbered in
    the order in which they first occur, and -1 marks steps before the first one.

    :param actions: features that are the control together, in this order; ``action`` if empty.
    :raises DemonstrationsError: the dataset has another version, or is damaged.
    """

    def __init__(self, folder: Path, actions: Sequence[str] = ()) -> None:
        self.folder = folder
        with reading(path := folder / "meta" / "info.json"):
            self.info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(self.info.get("features"), dict):
                raise DemonstrationsError(f"{path}: says nothing of features; is it LeRobot's?")
        version = str(self.info.get("codebase_version", "of no version"))
        if not version.startswith(VERSION):
            other = f"is a LeRobot dataset {version}, and {VERSION}x can be read"
            raise DemonstrationsError(f"{folder}: {other}; {_CONVERT}")
        self.features: dict[str, Any] = self.info["features"]
        observed = [feature for feature in self.features if feature.startswith(OBSERVATION)]
        bare = [feature.removeprefix(OBSERVATION) for feature in observed]
        keys = stored_keys(folder, bare, [name.replace(".", "/") for name in bare])
        self.keys = dict(zip(observed, keys, strict=True))
        self._actions = tuple(actions) or (ACTION,)
        self._check_actions()
        self._episodes = _episodes(folder)
        check_count(folder, self.info.get("total_episodes"), len(self._episodes), "meta/episodes")
        self._frequency = rate({"fps": self.info.get("fps")})
        self._noted, self._annotated = dict[int, dict[str, Any]](), dict[int, list[tuple[int, int]]]()
        subtasks = self._annotations() if SUBTASK not in self.features else []
        changing = any(len(row.get("tasks") or ()) > 1 for row in self._episodes.values())
        self._labels = {"subtask": SUBTASK} | ({"task": TASK} if changing else {})
        names = {name: self._named(name) for name in self._labels}
        names |= {"subtask": subtasks} if subtasks else {}
        if WHO in self.features:
            self._labels[WHO], names[WHO] = WHO, self.features[WHO].get("names")
        self._names = {name: each for name, each in names.items() if each}
        files = {self._path("data_path", index, "data") for index in self._episodes}  # some may be missing
        self.data_files = tuple(sorted(path.relative_to(folder) for path in files))

    def source(self) -> Source:
        robot = self.info.get("robot_type")
        about: dict[str, Attribute] = {"robot_type": robot} if isinstance(robot, str) else {}
        if self._names:
            about[LABEL_NAMES] = json.dumps(self._names)
        keys = {**self.keys, **({self._actions[0]: "control"} if len(self._actions) == 1 else {})}
        named = {key: _dimensions(self.features[feature]) for feature, key in keys.items()}
        about[DIMENSION_NAMES] = json.dumps({key: each for key, each in named.items() if each})
        left_out = tuple(f"demo_{index}" for index, noted in self._noted.items() if noted.get(EXCLUDE))
        names = tuple(f"demo_{index}" for index in self._episodes)
        masks = {EXCLUDE: left_out} if left_out else {}
        return Source(names, self._read, masks, self._frequency, about)

    def _check_actions(self) -> None:
        features = self.features.items()
        types = {name: about.get("dtype") if isinstance(about, dict) else None for name, about in features}
        there = [name for name, dtype in types.items() if not {name, str(dtype)} & _NO_CONTROL]
        for feature in self._actions:
            if feature not in there:
                close = [name for name in there if name.startswith(ACTION)] or there
                such = f", such as --action {quote(close[0])}" if close else ""
                known = ", ".join(there) or "none"
                lacks = f"there is no feature {feature!r}{nearest(feature, there)}; there is: {known}"
                raise DemonstrationsError(f"{self.folder}: {lacks}; import the control with --action{such}")

    def _annotations(self) -> list[str]:
        """Read the subtasks of each annotated episode as (first step, number of its name), -1 for none.

        :returns: the names.
        """
        path = self.folder / ANNOTATIONS
        if not path.is_file() or self._frequency is None:
            return []
        names = dict[str, int]()
        with reading(path):
            for episode, noted in json.loads(path.read_text(encoding="utf-8"))["episodes"].items():
                atoms = [atom for atom in noted.get("atoms", ()) if atom["style"] == "subtask"]
                self._noted[int(episode)] = noted
                for atom in sorted(atoms, key=lambda atom: float(atom["timestamp"])):
                    text = atom["content"]
                    number = names.setdefault(str(text), len(names)) if text else UNKNOWN
                    start = round(atom["timestamp"] * self._frequency)
                    self._annotated.setdefault(int(episode), []).append((start, number))
        return list(names)

    def _named(self, kind: str) -> list[str]:
        """The names of tasks, or subtasks, by number; empty where no table names them."""
        path = self.folder / "meta" / f"{kind}s.parquet"
        if not path.is_file():
            return []
        with reading(path):
            columns = parquet.read_table(path).to_pydict()
            numbers = columns.pop(f"{kind}_index")
            worded = (each for each in columns.values() if all(isinstance(text, str) for text in each))
            texts = next(worded, ())
            names = {int(number): text for number, text in zip(numbers, texts, strict=True) if number >= 0}
            if max(names, default=0) >= MOST_NAMES:
                raise ValueError(f"{kind}_index is {max(names)}")
        return [names.get(number, f"{kind} {number}") for number in range(1 + max(names, default=-1))]

    def _path(self, template: str, index: int, prefix: str, **more: str) -> Path:
        """A file of an episode, in the dataset's folder, by a template of ``meta/info.json``."""
        with reading(self.folder, f"demo_{index}: {template}"):
            episode = self._episodes[index]
            numbers = {name: int(episode[f"{prefix}/{name}"]) for name in ("chunk_index", "file_index")}
            path = filled(self.folder, str(self.info[template]), {**numbers, "episode_index": index, **more})
        return inside(self.folder, path)

    def _read(self, name: str) -> Demonstration:
        """One episode."""
        index = int(name.removeprefix("demo_"))
        path = self._path("data_path", index, "data")
        if not path.is_file():
            raise DemonstrationsError(f"{name}: {path} is missing; fetch the dataset again")
        with reading(self.folder, name):
            rows = _Rows(path, index, name)
            self._check(rows, index)
            seen = {key: self._observation(rows, feature, index) for feature, key in self.keys.items()}
            there = {name: column for name, column in self._labels.items() if column in rows.schema.names}
            labels = {name: np.asarray(rows.numbers(column, ())) for name, column in there.items()}
            if self._annotated:
                labels["subtask"] = np.full(len(rows), -1)
                for start, number in self._annotated.get(index, ()):
                    labels["subtask"][max(start, 0) :] = number
            shapes = {key: self.features[key]["shape"] for key in self._actions}
            controls = {key: np.asarray(rows.numbers(key, shape)) for key, shape in shapes.items()}
        tasks = self._episodes[index].get("tasks")
        about: dict[str, Attribute] = {"episode_index": index}
        if isinstance(tasks, Sequence) and len(tasks):
            about["task"] = "; ".join(map(str, tasks))
        noted = self._noted.get(index, {})
        about |= {key: noted[key] for key in ("flag", "note") if isinstance(noted.get(key), bool | str)}
        return Demonstration.stored(name, seen, joined(controls, f"{self.folder}: {name}"), labels, about)

    def _check(self, rows: _Rows, index: int) -> None:
        """Refuse an episode with a wrong number of rows, or with rows out of order."""
        length = self._episodes[index].get("length")
        if length not in (None, len(rows)):
            has = f"{rows.path} has {len(rows)} rows of it"
            raise DemonstrationsError(f"{rows.name}: length in meta/episodes is {length}, and {has}")
        for column, frequency in (("frame_index", 1.0), ("timestamp", self._frequency)):
            if column in rows.schema.names and frequency:
                times = np.asarray(rows.numbers(column, ())).astype(float)
                expected = np.arange(len(times)) / frequency
                wrong = ~(np.abs(times - expected) < 0.5 / frequency)
                if wrong.any():
                    at = int(wrong.argmax())
                    other = f"is {times[at]:.6g} in row {at}, not {expected[at]:.6g}"
                    fault = clock_fault(times) or f"{other}; correct it, or fps in meta/info.json"
                    raise DemonstrationsError(f"{rows.path}: {rows.name}: {column} {fault}")

    def _observation(self, rows: _Rows, key: str, index: int) -> Observed:
        about = self.features[key]
        shape, names = list(about["shape"]), list(about.get("names") or ())
        if about["dtype"] not in ("image", "video"):
            return rows.numbers(key, shape)
        first = names[:1] in (["channels"], ["channel"]) or (not names and shape[0] in (1, 3))
        height, width = shape[1:] if first else shape[:2]
        size, video = (int(height), int(width)), about["dtype"] == "video"
        read = partial(self._frames, rows, key, index, size) if video else partial(rows.images, key, size)
        return LazyArray((len(rows), *size, 3), PICTURES, read, key, video=video)

    def _frames(
        self, rows: _Rows, key: str, index: int, size: tuple[int, int], start: int, stop: int
    ) -> Iterator[np.ndarray]:
        """Frames of a video, which is looked for when it is read."""
        with reading(self.folder, f"{rows.name}: {key}"):
            path = self._path("video_path", index, f"videos/{key}", video_key=key)
            begin = float(self._episodes[index][f"videos/{key}/from_timestamp"])
        rate = self._frequency or 1.0
        seen = frames_of_steps(path, rows.name, begin + start / rate, stop - start, rate, size)
        yield from in_blocks(seen, size)


class _Rows:
    """The rows of one episode in a parquet file."""

    def __init__(self, path: Path, episode: int, name: str) -> None:
        self.path, self.name, self.schema = path, name, parquet.read_schema(path)
        self.only = [("episode_index", "==", episode)]
        self.steps = len(self.column("episode_index"))
        if not self.steps:
            raise DemonstrationsError(f"{name}: its rows are missing in {path}")

    def __len__(self) -> int:
        return self.steps

    def column(self, key: str) -> Any:
        """A column of the episode, in one piece."""
        if key not in self.schema.names:
            lacks = f"has no column {key}, which meta/info.json names"
            raise DemonstrationsError(f"{self.path}: {self.name}: {lacks}")
        return parquet.read_table(self.path, columns=[key], filters=self.only).column(key).combine_chunks()

    def numbers(self, key: str, shape: Sequence[int]) -> LazyArray:
        """A column of numbers or lists of numbers; ``shape`` is the shape of a step."""
        dtype: np.dtype[Any] = np.dtype(np.float32)  # where the column is missing, which its reading reports
        if key in self.schema.names:
            kind = self.schema.field(key).type
            while pyarrow.types.is_nested(kind) and hasattr(kind, "value_type"):
                kind = kind.value_type
            dtype = np.dtype(object) if pyarrow.types.is_nested(kind) else np.dtype(kind.to_pandas_dtype())
        read = partial(self._numbers, key, tuple(shape))
        return LazyArray(channels_last((len(self), *shape), dtype), dtype, read, key)

    def _numbers(self, key: str, shape: tuple[int, ...], start: int, stop: int) -> Iterator[np.ndarray]:
        with reading(self.path, f"{self.name}: {key}"):
            values = self.column(key).slice(start, stop - start)
            row, size = np.arange(stop - start), math.prod(shape)
            while pyarrow.types.is_nested(values.type):
                row = np.repeat(row, compute.list_value_length(values).fill_null(0).to_numpy())
                values = values.flatten()
            valid = values.is_valid().to_numpy(zero_copy_only=False)
            counts = np.bincount(row[valid], minlength=stop - start)
            if (counts != size).any():
                at = int((counts != size).argmax())
                has = f"{key} has {counts[at]} numbers in row {start + at}, and meta/info.json says {size}"
                raise DemonstrationsError(f"{self.path}: {self.name}: {has}; correct one of them")
            yield turned(values.to_numpy(zero_copy_only=False).reshape(stop - start, *shape))

    def images(self, key: str, size: tuple[int, int], start: int, stop: int) -> Iterator[np.ndarray]:
        """Encoded pictures of consecutive steps, uint8 [steps, H, W, 3], in blocks."""

        def decoded(encoded: bytes | None) -> np.ndarray:
            image = (
                None if encoded is None else cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
            )
            if image is None or image.shape[:2] != size:
                wrong = f"an image is damaged, not in the parquet file itself, or not {size[0]} x {size[1]}"
                raise DemonstrationsError(f"{self.path}: {self.name}: {wrong}")
            return np.ascontiguousarray(image[..., ::-1])

        with reading(self.path, f"{self.name}: {key}"):
            values = self.column(key).slice(start, stop - start)
            yield from in_blocks((decoded(picture.as_py()["bytes"]) for picture in values), size)


def _episodes(folder: Path) -> dict[int, dict[str, Any]]:
    """The rows of ``meta/episodes`` by episode, without statistics."""
    episodes: dict[int, dict[str, Any]] = {}
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        with reading(path):
            columns = [key for key in parquet.read_schema(path).names if not key.startswith("stats/")]
            for row in parquet.read_table(path, columns=columns).to_pylist():
                index = int(row["episode_index"])
                if index in episodes:
                    raise DemonstrationsError(f"{path}: demo_{index}: is there twice; remove one of the two")
                episodes[index] = row
    if not episodes:
        raise DemonstrationsError(f"{folder}: meta/episodes holds no episodes; at least one is needed")
    return dict(sorted(episodes.items()))


def _dimensions(feature: dict[str, Any]) -> list[str]:
    """The names of a vector's dimensions; empty where there are none."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next((each for each in names.values() if isinstance(each, list)), None)
    return [str(name) for name in names or ()] if len(feature["shape"]) == 1 else []


def open_lerobot(path: Path, actions: Sequence[str] = ()) -> Iterator[Source]:
    """Open a dataset.

    :param actions: features that are the control together; ``action`` if empty.
    :raises DemonstrationsError: the dataset has another version, or is damaged.
    """
    yield LeRobot(path, actions).source()
