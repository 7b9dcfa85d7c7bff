"""Segments as subtasks in a copy of a LeRobot dataset."""

from __future__ import annotations

import filecmp
import json
import os
import shutil
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.sources.lerobot import ANNOTATIONS, SUBTASK, LeRobot
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.formats import Run, Writer

PERSISTENT, EVENTS = "language_persistent", "language_events"
ATOM = ("role", "content", "style", "timestamp", "tool_calls")
INFO = Path("meta") / "info.json"


@dataclass(frozen=True)
class Subtasks:
    """What is written.

    :param names: the subtask of each choice, control (0) first.
    :param runs: the subtasks of each episode, by its index.
    :param order: the choices that occur, in the order of :meth:`Writer.order`.
    """

    names: list[str]
    runs: Mapping[int, list[Run]]
    order: list[int]

    def options(self, episode: int) -> np.ndarray:
        """The option of each frame of an episode [T]."""
        return np.concatenate([np.full(stop - start, option) for option, start, stop in self.runs[episode]])


class Copy(Writer):
    """A copy of a LeRobot dataset with subtasks.

    Videos are hard links where the file system has them, else copies. A folder that has these very subtasks is not
    written again.
    """

    features: ClassVar[Mapping[str, Any]] = {}
    """The entries of new columns of frames in ``meta/info.json``."""

    def check(self) -> None:
        source = LeRobot(self.asked.demos)
        if self.features and {SUBTASK, PERSISTENT} & source.features.keys():
            raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
        if self.out.resolve().is_relative_to(source.folder.resolve()):
            raise BadInput(f"{self.out}: lies in the dataset; choose another {self.option}")
        info = self.out / INFO
        if self.out.exists() and not (info.is_file() and info.read_text(encoding="utf-8") == self._info(source)):
            raise self._taken()

    def write(self, segmented: Segmented) -> str:
        source = LeRobot(self.asked.demos)
        with suppress(_SameFolder), whole_folder(self.out) as temporary:
            shutil.copytree(
                source.folder, temporary, dirs_exist_ok=True, copy_function=_link, ignore_dangling_symlinks=True
            )
            write_text(temporary / INFO, self._info(source))
            runs = {int(demo.name.removeprefix("demo_")): self.runs(demo) for demo in segmented.segments}
            self.add(LeRobot(temporary), Subtasks(self.asked.names, runs, self.order(segmented)))
            if self.out.exists():
                raise _SameFolder if _same(self.out, temporary) else self._taken()
        return str(self.out)

    @abstractmethod
    def add(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Write the subtasks into the copy."""

    def _info(self, dataset: LeRobot) -> str:
        """``meta/info.json`` with the subtasks."""
        return json.dumps({**dataset.info, "features": {**dataset.features, **self.features}}, indent=4) + "\n"

    def _taken(self) -> BadInput:
        return BadInput(f"{self.out}: exists; choose another {self.option}")


class Annotated(Copy):
    """Each row holds all subtasks of its episode in ``language_persistent``, as LeRobot 0.6 and newer read them.

    A subtask lasts from its ``timestamp``, the time of its first frame, to the next subtask. The page on which
    LeRobot's users label datasets keeps the same in ``meta/lerobot_annotations.json``.
    """

    features: ClassVar = {name: {"dtype": "language", "shape": [1], "names": None} for name in (PERSISTENT, EVENTS)}

    def add(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Add the columns to the data files, one row group for each episode, as LeRobot does; and the annotations."""
        episodes = {}
        for path in dataset.data_files:
            file = inside(dataset.folder, path)
            table = parquet.read_table(file)
            file.unlink()  # it may be a link
            writer = None
            for episode, rows in _episodes(table, subtasks):
                for name, values in _columns(rows["timestamp"], subtasks.options(episode), subtasks.names).items():
                    rows = rows.append_column(name, values)
                writer = writer or parquet.ParquetWriter(file, rows.schema)
                writer.write_table(rows)
                atoms = rows[PERSISTENT][0].as_py()
                episodes[str(episode)] = {"atoms": [{key: atom[key] for key in ATOM} for atom in atoms]}
            assert writer is not None  # a file of a dataset holds an episode
            writer.close()
        write_text(dataset.folder / ANNOTATIONS, json.dumps({"version": 2, "episodes": episodes}, indent=1) + "\n")


def _episodes(table: pyarrow.Table, subtasks: Subtasks) -> Iterator[tuple[int, pyarrow.Table]]:
    """The rows of each episode in a data file.

    :raises BadInput: the file has no times, or rows of an episode that the dataset does not name.
    """
    if "timestamp" not in table.column_names:
        raise BadInput("the data files have no column timestamp; subtasks begin at times of frames")
    index = table["episode_index"].to_numpy()
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), len(index)]
    for start, stop in pairwise(bounds):
        rows, episode = table.slice(start, stop - start), int(index[start])
        if episode not in subtasks.runs or subtasks.runs[episode][-1][2] != len(rows):
            raise BadInput(f"the data files have rows of episode {episode} that meta/episodes does not name")
        yield episode, rows


def _columns(times: pyarrow.ChunkedArray, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
    """The new columns of an episode: the same list of subtasks on each row, and no events.

    :param times: of its frames [T].
    :param options: the option of each frame [T].
    :param names: the subtask of each option.
    """
    starts = np.flatnonzero(np.diff(options, prepend=-1))
    text = pyarrow.string()
    entries = {
        "role": pyarrow.array(["assistant"] * len(starts)),
        "content": pyarrow.array([names[option] for option in options[starts]]),
        "style": pyarrow.array(["subtask"] * len(starts)),
        "timestamp": times.combine_chunks().take(pyarrow.array(starts)),
        "camera": pyarrow.nulls(len(starts), text),
        "tool_calls": pyarrow.nulls(len(starts), pyarrow.list_(text)),
    }
    events = {name: values.type for name, values in entries.items() if name != "timestamp"}
    persistent = pyarrow.StructArray.from_arrays(list(entries.values()), list(entries))
    on_each_row = persistent.take(pyarrow.array(np.tile(np.arange(len(starts)), len(options))))
    offsets = np.arange(len(options) + 1, dtype=np.int32)
    return {
        PERSISTENT: pyarrow.ListArray.from_arrays(pyarrow.array(offsets * len(starts)), on_each_row),
        EVENTS: pyarrow.ListArray.from_arrays(pyarrow.array(0 * offsets), pyarrow.array([], pyarrow.struct(events))),
    }


class SARM(Copy):
    """The stages of SARM, LeRobot's reward model: subtasks of each episode in ``meta/episodes``, ends inclusive."""

    def add(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Write the columns ``dense_subtask_...`` of episodes, and each subtask's mean share of an episode in order."""
        for file in sorted((dataset.folder / "meta" / "episodes").rglob("*.parquet")):
            table = parquet.read_table(file)
            runs = [subtasks.runs[episode] for episode in table["episode_index"].to_pylist()]
            columns = {
                "names": pyarrow.array([[subtasks.names[option] for option, _, _ in each] for each in runs]),
                "start_frames": pyarrow.array([[start for _, start, _ in each] for each in runs]),
                "end_frames": pyarrow.array([[stop - 1 for _, _, stop in each] for each in runs]),
            }
            for name, values in columns.items():
                if (column := f"dense_subtask_{name}") in table.column_names:
                    table = table.drop_columns([column])
                table = table.append_column(column, values)
            known = {key: value for key, value in (table.schema.metadata or {}).items() if key != b"huggingface"}
            file.unlink()  # it may be a link
            parquet.write_table(table.replace_schema_metadata(known), file)
        shares = np.mean(
            [
                np.bincount(options, minlength=len(subtasks.names)) / len(options)
                for options in map(subtasks.options, subtasks.runs)
            ],
            axis=0,
        )
        proportions = {subtasks.names[option]: float(shares[option]) for option in subtasks.order}
        path = dataset.folder / "meta" / "temporal_proportions_dense.json"
        write_text(path, json.dumps(proportions, indent=2, ensure_ascii=False) + "\n")


class _SameFolder(Exception):
    """The folder exists with the same contents."""


def _same(one: Path, other: Path) -> bool:
    """Whether two folders have the same files."""
    names = [{path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} for folder in (one, other)]
    return names[0] == names[1] and all(
        (one / name).samefile(other / name) or filecmp.cmp(one / name, other / name, shallow=False) for name in names[0]
    )


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
