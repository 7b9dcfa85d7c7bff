"""Segments as subtasks in a LeRobot dataset: a copy of the demonstrations' own, or a new one."""

from __future__ import annotations

import filecmp
import json
import os
import shutil
from abc import ABC, abstractmethod
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
from ddco_pyro.segmenting.formats import Asked, Run, Writer
from ddco_pyro.segmenting.formats.new_lerobot import write_dataset, write_indexed

PERSISTENT, EVENTS = "language_persistent", "language_events"
ATOM = ("role", "content", "style", "timestamp", "tool_calls")


@dataclass(frozen=True)
class Subtasks:
    """What a form writes.

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


class Form(ABC):
    """How a dataset holds subtasks."""

    features: ClassVar[Mapping[str, Any]] = {}
    """The entries of new columns of frames in ``meta/info.json``."""

    @abstractmethod
    def write(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Write the subtasks into a dataset of our own."""


class FrameColumns(Form):
    """Subtasks as further columns of frames."""

    def write_columns(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Add columns of frames to the data files, one row group for each episode, as LeRobot does."""
        for path in dataset.data_files:
            file = inside(dataset.folder, path)
            table = parquet.read_table(file)
            file.unlink()  # it may be a link
            writer = None
            for rows, columns in self._episodes(table, subtasks):
                for name, values in columns.items():
                    rows = rows.append_column(name, values)
                rows = rows.replace_schema_metadata(self.metadata(table.schema.metadata or {}))
                writer = writer or parquet.ParquetWriter(file, rows.schema)
                writer.write_table(rows)
            assert writer is not None  # a file of a dataset holds an episode
            writer.close()

    def _episodes(
        self, table: pyarrow.Table, subtasks: Subtasks
    ) -> Iterator[tuple[pyarrow.Table, dict[str, pyarrow.Array]]]:
        """The rows of each episode in a data file, and the new columns.

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
            yield rows, self.columns(rows, subtasks.options(episode), subtasks.names)

    @abstractmethod
    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The new columns of an episode.

        :param rows: the episode's rows [T].
        :param options: the option of each row [T].
        :param names: the subtask of each option.
        """

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """The metadata of the data files, from the metadata before."""
        return dict(known)


class Language(FrameColumns):
    """LeRobot 0.6 and newer: each row holds all subtasks of its episode in ``language_persistent``.

    A subtask lasts from its ``timestamp``, the time of its first frame, to the next subtask. The page on which
    LeRobot's users label datasets keeps the same in ``meta/lerobot_annotations.json``.
    """

    features: ClassVar = {name: {"dtype": "language", "shape": [1], "names": None} for name in (PERSISTENT, EVENTS)}

    def write(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Write the columns and the annotations."""
        self.write_columns(dataset, subtasks)
        episodes = {}
        for path in dataset.data_files:
            table = parquet.read_table(dataset.folder / path, columns=["episode_index", PERSISTENT])
            for episode, row in zip(*np.unique(table["episode_index"], return_index=True), strict=True):
                atoms = table[PERSISTENT][int(row)].as_py()
                episodes[str(episode)] = {"atoms": [{key: atom[key] for key in ATOM} for atom in atoms]}
        write_text(dataset.folder / ANNOTATIONS, json.dumps({"version": 2, "episodes": episodes}, indent=1) + "\n")

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


class SubtaskIndex(FrameColumns):
    """LeRobot 0.4 and 0.5: ``subtask_index`` of each frame, and the names in ``meta/subtasks.parquet``."""

    features: ClassVar = {SUBTASK: {"dtype": "int64", "shape": [1], "names": None}}

    def write(self, dataset: LeRobot, subtasks: Subtasks) -> None:
        """Write the column, and the name of each option as the pandas index that LeRobot expects."""
        self.write_columns(dataset, subtasks)
        table = pyarrow.table({"subtask": subtasks.names, SUBTASK: list(range(len(subtasks.names)))})
        write_indexed(dataset.folder / "meta" / "subtasks.parquet", table)

    def columns(self, rows: pyarrow.Table, options: np.ndarray, names: list[str]) -> dict[str, pyarrow.Array]:
        """The option of each row."""
        return {SUBTASK: pyarrow.array(options.astype(np.int64))}

    def metadata(self, known: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        """The columns as the ``datasets`` library lists them, with the new one."""
        listed = known.get(b"huggingface")
        if listed is None:
            return dict(known)
        info: dict[str, Any] = json.loads(listed)
        info["info"]["features"][SUBTASK] = {"dtype": "int64", "_type": "Value"}
        return {**known, b"huggingface": json.dumps(info).encode()}


class Stages(Form):
    """SARM, LeRobot's reward model: the subtasks of each episode in ``meta/episodes``, with inclusive ends."""

    def write(self, dataset: LeRobot, subtasks: Subtasks) -> None:
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


FORMS: Mapping[str, Form] = {"0.6": Language(), "0.4": SubtaskIndex()}
"""The forms of subtasks, by the first version of LeRobot that reads them."""

INFO = Path("meta") / "info.json"


def info_text(dataset: LeRobot, form: Form) -> str:
    """``meta/info.json`` with the subtasks."""
    return json.dumps({**dataset.info, "features": {**dataset.features, **form.features}}, indent=4) + "\n"


class Annotated(Writer):
    """A copy of a LeRobot dataset with subtasks, or a new dataset where the demonstrations are in another format.

    Videos are hard links where the file system has them, else copies. A folder that has these very subtasks is not
    written again.

    :param lerobot_format: the first version of LeRobot that reads its subtasks.
    """

    def __init__(self, option: str, out: Path, asked: Asked, lerobot_format: str = "0.6") -> None:
        super().__init__(option, out, asked)
        self.form = FORMS[lerobot_format]

    def check(self) -> None:
        source = self.asked.source
        if not isinstance(source, LeRobot):
            return
        if self.form.features and {SUBTASK, PERSISTENT} & source.features.keys():
            raise BadInput(f"{source.folder}: has subtasks already; name a dataset without them")
        if self.out.resolve().is_relative_to(source.folder.resolve()):
            raise BadInput(f"{self.out}: lies in the dataset; choose another {self.option}")
        info = self.out / INFO
        expected = info_text(source, self.form)
        if self.out.exists() and not (info.is_file() and info.read_text(encoding="utf-8") == expected):
            raise self._taken()

    def write(self, segmented: Segmented) -> str:
        source = self.asked.source
        with suppress(_SameFolder), whole_folder(self.out) as temporary:
            if isinstance(source, LeRobot):
                shutil.copytree(
                    source.folder, temporary, dirs_exist_ok=True, copy_function=_link, ignore_dangling_symlinks=True
                )
            else:
                write_dataset(temporary, self.asked, segmented)
            dataset = LeRobot(temporary)
            # A LeRobot dataset has numbers for names; the episodes of a new one are in the order of the segments.
            kept = isinstance(source, LeRobot)
            runs = {
                int(demo.name.removeprefix("demo_")) if kept else place: self.runs(demo)
                for place, demo in enumerate(segmented.segments)
            }
            write_text(temporary / INFO, info_text(dataset, self.form))
            self.form.write(dataset, Subtasks(self.asked.names, runs, self.order(segmented)))
            if self.out.exists():
                raise _SameFolder if _same(self.out, temporary) else self._taken()
        return f"{self.out}{'' if kept else self.asked.without}"

    def _taken(self) -> BadInput:
        return BadInput(f"{self.out}: exists; choose another {self.option}")


class SARM(Annotated):
    """A copy of a LeRobot dataset, or a new dataset, with the stages that SARM is trained on."""

    def __init__(self, option: str, out: Path, asked: Asked) -> None:
        super().__init__(option, out, asked)
        self.form = Stages()


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
