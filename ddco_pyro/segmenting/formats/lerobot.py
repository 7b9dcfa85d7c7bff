"""Segments as subtasks in a copy of a LeRobot dataset."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.labels import SOURCE, SOURCES, UNKNOWN
from ddco_pyro.data.sources.lerobot import ANNOTATIONS, SUBTASK, WHO, LeRobot
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.segments import Segmented, Segments

PERSISTENT, EVENTS = "language_persistent", "language_events"
ATOM = ("role", "content", "style", "timestamp", "tool_calls")
WHOSE = "subtask_annotator"

LANGUAGE = {"dtype": "language", "shape": [1], "names": None}
FEATURES = {PERSISTENT: LANGUAGE, EVENTS: LANGUAGE}
"""The entries of the columns of :func:`write_subtasks` in ``meta/info.json``."""
PEOPLE = {
    WHO: {"dtype": "int64", "shape": [1], "names": list(SOURCES)},
    WHOSE: {"dtype": "string", "shape": [1], "names": None},
}
"""Further columns' entries where a person labelled: who says what a frame's subtask is, and the annotator."""

COPIED = "copied_from"
"""In ``meta/lerobot_annotations.json`` of a labelled copy: the dataset that was copied."""


def check(asked: Asked) -> None:
    """Check that nothing is where the copy is to be, and that a dataset that gets subtasks has none.

    :raises BadInput: something is, or it has.
    """
    if asked.option == "--lerobot" and {SUBTASK, PERSISTENT} & LeRobot(asked.source.path).features.keys():
        raise BadInput(f"{asked.source.path}: has subtasks already; name a dataset without them")
    if asked.out.exists():
        raise BadInput(f"{asked.out}: exists; remove it, or choose another {asked.option}")


def is_copy(out: Path, dataset: Path) -> bool:
    """Whether a folder is a labelled copy of a dataset."""
    return _origin(out) == str(dataset.resolve())


def _origin(folder: Path) -> str:
    """The dataset that a folder is a labelled copy of; empty where it is none."""
    path = folder / ANNOTATIONS
    return str(json.loads(path.read_text(encoding="utf-8")).get(COPIED, "")) if path.is_file() else ""


@contextmanager
def _copied(asked: Asked, segmented: Segmented) -> Iterator[tuple[LeRobot, dict[int, Segments]]]:
    """A copy that the block adds to, and the segments of each episode by its index.

    Videos are hard links where the file system has them, else copies.
    """
    with whole_folder(asked.out) as temporary:
        folder = LeRobot(asked.source.path).folder
        copy = partial(shutil.copytree, ignore=_loops, copy_function=_link)
        copy(folder, temporary, ignore_dangling_symlinks=True, dirs_exist_ok=True)
        yield LeRobot(temporary), {int(demo.name.removeprefix("demo_")): demo for demo in segmented.segments}


def write_subtasks(asked: Asked, segmented: Segmented) -> str:
    """Each row holds all subtasks of its episode in ``language_persistent``, as LeRobot from 0.6 on reads it.

    A subtask lasts from its ``timestamp``, the time of its first frame, to the next one; an entry without
    ``content`` is a gap. The page on which LeRobot's users label datasets keeps the same in
    ``meta/lerobot_annotations.json``. Subtasks that are there are replaced, and other language stays. Where a
    person labelled, further columns say who says what each frame is (:data:`PEOPLE`). Each episode has a row
    group of its own, as in LeRobot's files.
    """
    episodes, features = dict[str, Any](), dict[str, Any]()
    with _copied(asked, segmented) as (dataset, subtasks):
        for path in dataset.data_files:
            file = inside(dataset.folder, path.as_posix())
            table = parquet.read_table(file)
            file.unlink()  # it may be a link
            writer = None
            for episode, rows in _episodes(table, subtasks):
                rows = _with(rows, _columns(asked, rows, subtasks[episode]))
                rows = rows.drop_columns([SUBTASK] if SUBTASK in rows.column_names else [])
                writer = writer or parquet.ParquetWriter(file, rows.schema)
                writer.write_table(rows)
                possible = {**FEATURES, **PEOPLE}.items()
                features = {name: about for name, about in possible if name in rows.column_names}
                atoms = [atom for atom in rows[PERSISTENT][0].as_py() if atom["style"] == "subtask"]
                marks = segmented.marks.get(subtasks[episode].name, {})
                atoms = [{key: atom[key] for key in ATOM} for atom in atoms]
                episodes[str(episode)] = {"atoms": atoms, **marks}
            assert writer is not None  # a file of a dataset holds an episode
            writer.close()
        origin = _origin(dataset.folder) or str(asked.source.path.resolve())
        about = {"version": 2, "episodes": episodes, COPIED: origin}
        write_text(dataset.folder / ANNOTATIONS, json.dumps(about, indent=1) + "\n")
        before = {name: feature for name, feature in dataset.features.items() if name != SUBTASK}
        info = {**dataset.info, "features": {**before, **features}}
        write_text(dataset.folder / "meta" / "info.json", json.dumps(info, indent=4) + "\n")
    return str(asked.out)


def _with(table: pyarrow.Table, columns: Mapping[str, Any]) -> pyarrow.Table:
    """A table with columns, in place of those of the same name."""
    for name, values in columns.items():
        table = table.drop_columns([name] if name in table.column_names else []).append_column(name, values)
    return table


def _episodes(table: pyarrow.Table, subtasks: Mapping[int, Segments]) -> Iterator[tuple[int, pyarrow.Table]]:
    """The rows of each episode in a data file."""
    if "timestamp" not in table.column_names:
        raise BadInput("the data files have no column timestamp; subtasks begin at times of frames")
    index = table["episode_index"].to_numpy()
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), len(index)]
    for start, stop in pairwise(bounds):
        rows, episode = table.slice(start, stop - start), int(index[start])
        if episode not in subtasks or len(subtasks[episode]) != len(rows):
            raise BadInput(f"the data files have rows of episode {episode} that meta/episodes does not name")
        yield episode, rows


def _columns(asked: Asked, rows: pyarrow.Table, demo: Segments) -> dict[str, Any]:
    """The new columns of an episode: the same list of language on each row, no events, and who says so."""
    options, times = demo.levels[asked.level].options, rows["timestamp"].to_pylist()
    starts = np.flatnonzero(np.diff(options, prepend=UNKNOWN)).tolist()
    entries: list[dict[str, Any]] = [
        {
            "role": "assistant",
            "content": None if options[start] == UNKNOWN else asked.names[options[start]],
            "style": "subtask",
            "timestamp": times[start],
            "camera": None,
            "tool_calls": None,
        }
        for start in starts
    ]
    text, clock = pyarrow.string(), rows["timestamp"].type
    fields = {"role": text, "content": text, "style": text, "timestamp": clock, "camera": text}
    kind = pyarrow.struct({**fields, "tool_calls": pyarrow.list_(text)}.items())
    if PERSISTENT in rows.column_names:
        kind = rows.schema.field(PERSISTENT).type.value_type
        entries += [entry for entry in rows[PERSISTENT][0].as_py() if entry["style"] != "subtask"]
        entries.sort(key=lambda entry: float(entry["timestamp"]))
    count, steps = len(entries), len(rows)
    on_each_row = pyarrow.array(entries, kind).take(pyarrow.array(np.tile(np.arange(count), steps)))
    offsets = pyarrow.array(np.arange(steps + 1) * count, "int32")
    columns = {PERSISTENT: pyarrow.ListArray.from_arrays(offsets, on_each_row)}
    if EVENTS not in rows.column_names:
        events = pyarrow.struct([kind.field(name) for name in (*fields, "tool_calls") if name != "timestamp"])
        columns[EVENTS] = pyarrow.array([[]] * steps, pyarrow.list_(events))
    who = demo.sources.get(asked.level + SOURCE)
    if who is not None:
        said = who != SOURCES.index("proposed")
        columns[WHO] = pyarrow.array(who.astype(np.int64))
        columns[WHOSE] = pyarrow.array(np.where(said, asked.annotator, "").tolist())
    return columns


def write_stages(asked: Asked, segmented: Segmented) -> str:
    """The stages of SARM, LeRobot's reward model: ``dense_subtask_...`` in ``meta/episodes``, ends inclusive.

    Beside them stands each subtask's mean share of an episode, in order.
    """
    with _copied(asked, segmented) as (dataset, subtasks):
        for file in sorted((dataset.folder / "meta" / "episodes").rglob("*.parquet")):
            table = parquet.read_table(file)
            runs = [asked.runs(subtasks[episode]) for episode in table["episode_index"].to_pylist()]
            columns = {
                "names": [[asked.names[option] for option, _, _ in each] for each in runs],
                "start_frames": [[start for _, start, _ in each] for each in runs],
                "end_frames": [[stop - 1 for _, _, stop in each] for each in runs],
            }
            dense = {f"dense_subtask_{name}": pyarrow.array(values) for name, values in columns.items()}
            table = _with(table, dense)
            metadata = (table.schema.metadata or {}).items()
            known = {key: value for key, value in metadata if key != b"huggingface"}
            file.unlink()  # it may be a link
            parquet.write_table(table.replace_schema_metadata(known), file)
        every = [demo.levels[asked.level].options for demo in segmented.segments]
        order = asked.order(segmented)
        shares = {option: np.mean([np.mean(each == option) for each in every]) for option in order}
        proportions = {asked.names[option]: float(share) for option, share in shares.items()}
        path = dataset.folder / "meta" / "temporal_proportions_dense.json"
        write_text(path, json.dumps(proportions, indent=2, ensure_ascii=False) + "\n")
    return str(asked.out)


def _loops(folder: str, names: list[str]) -> list[str]:
    """The links to a folder around them, which a copy would follow without end."""
    here = Path(os.path.realpath(folder))
    return [name for name in names if Path(os.path.realpath(here / name)) in (here, *here.parents)]


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
