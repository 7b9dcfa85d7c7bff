"""Segments as subtasks in a copy of a LeRobot dataset."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.sources.lerobot import ANNOTATIONS, SUBTASK, LeRobot
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting.formats.asked import Asked, Run
from ddco_pyro.segmenting.segments import Segmented

PERSISTENT, EVENTS = "language_persistent", "language_events"
ATOM = ("role", "content", "style", "timestamp", "tool_calls")


FEATURES = {name: {"dtype": "language", "shape": [1], "names": None} for name in (PERSISTENT, EVENTS)}
"""The entries of the columns of :func:`write_subtasks` in ``meta/info.json``."""


def check(asked: Asked) -> None:
    """Check that nothing is where the copy is to be.

    :raises BadInput: something is.
    """
    if asked.out.exists():
        raise BadInput(f"{asked.out}: exists; remove it, or choose another {asked.option}")


def check_bare(asked: Asked) -> None:
    """The same for a dataset that has no subtasks.

    :raises BadInput: it has.
    """
    if {SUBTASK, PERSISTENT} & LeRobot(asked.demos).features.keys():
        raise BadInput(f"{asked.demos}: has subtasks already; name a dataset without them")
    check(asked)


@contextmanager
def _copied(asked: Asked, segmented: Segmented) -> Iterator[tuple[LeRobot, dict[int, list[Run]]]]:
    """A copy that the block adds to, and the subtasks of each episode by its index.

    Videos are hard links where the file system has them, else copies.
    """
    with whole_folder(asked.out) as temporary:
        folder = LeRobot(asked.demos).folder
        shutil.copytree(folder, temporary, dirs_exist_ok=True, copy_function=_link, ignore_dangling_symlinks=True)
        runs = {int(demo.name.removeprefix("demo_")): asked.runs(demo) for demo in segmented.segments}
        yield LeRobot(temporary), runs


def write_subtasks(asked: Asked, segmented: Segmented) -> str:
    """Each row holds all subtasks of its episode in ``language_persistent``, as LeRobot 0.6 and newer read them.

    A subtask lasts from its ``timestamp``, the time of its first frame, to the next subtask. The page on which
    LeRobot's users label datasets keeps the same in ``meta/lerobot_annotations.json``. Each episode has a row group of
    its own, as in LeRobot's files.
    """
    episodes = {}
    with _copied(asked, segmented) as (dataset, subtasks):
        for path in dataset.data_files:
            file = inside(dataset.folder, path)
            table = parquet.read_table(file)
            file.unlink()  # it may be a link
            writer = None
            for episode, rows in _episodes(table, subtasks):
                for name, values in _columns(rows["timestamp"], _options(subtasks[episode]), asked.names).items():
                    rows = rows.append_column(name, values)
                writer = writer or parquet.ParquetWriter(file, rows.schema)
                writer.write_table(rows)
                atoms = rows[PERSISTENT][0].as_py()
                episodes[str(episode)] = {"atoms": [{key: atom[key] for key in ATOM} for atom in atoms]}
            assert writer is not None  # a file of a dataset holds an episode
            writer.close()
        write_text(dataset.folder / ANNOTATIONS, json.dumps({"version": 2, "episodes": episodes}, indent=1) + "\n")
        info = {**dataset.info, "features": {**dataset.features, **FEATURES}}
        write_text(dataset.folder / "meta" / "info.json", json.dumps(info, indent=4) + "\n")
    return str(asked.out)


def _episodes(table: pyarrow.Table, subtasks: Mapping[int, list[Run]]) -> Iterator[tuple[int, pyarrow.Table]]:
    """The rows of each episode in a data file."""
    if "timestamp" not in table.column_names:
        raise BadInput("the data files have no column timestamp; subtasks begin at times of frames")
    index = table["episode_index"].to_numpy()
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), len(index)]
    for start, stop in pairwise(bounds):
        rows, episode = table.slice(start, stop - start), int(index[start])
        if episode not in subtasks or subtasks[episode][-1][2] != len(rows):
            raise BadInput(f"the data files have rows of episode {episode} that meta/episodes does not name")
        yield episode, rows


def _options(runs: list[Run]) -> np.ndarray:
    """The option of each frame of an episode [T]."""
    return np.concatenate([np.full(stop - start, option) for option, start, stop in runs])


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


def write_stages(asked: Asked, segmented: Segmented) -> str:
    """The stages of SARM, LeRobot's reward model: ``dense_subtask_...`` in ``meta/episodes``, ends inclusive.

    Beside them stands each subtask's mean share of an episode, in order.
    """
    with _copied(asked, segmented) as (dataset, subtasks):
        for file in sorted((dataset.folder / "meta" / "episodes").rglob("*.parquet")):
            table = parquet.read_table(file)
            runs = [subtasks[episode] for episode in table["episode_index"].to_pylist()]
            columns = {
                "names": pyarrow.array([[asked.names[option] for option, _, _ in each] for each in runs]),
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
        every = list(map(_options, subtasks.values()))
        shares = {option: np.mean([np.mean(each == option) for each in every]) for option in asked.order(segmented)}
        proportions = {asked.names[option]: float(share) for option, share in shares.items()}
        path = dataset.folder / "meta" / "temporal_proportions_dense.json"
        write_text(path, json.dumps(proportions, indent=2, ensure_ascii=False) + "\n")
    return str(asked.out)


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
