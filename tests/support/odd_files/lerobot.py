"""LeRobot datasets whose metadata lie: paths and links that lead out, and episodes that are not whole."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.compute as compute
import pyarrow.parquet as parquet

from odd_files import Row

FIXTURE = Path(__file__).parents[2] / "fixtures" / "lerobot"
DATA = Path("data/chunk-000/file-000.parquet")
EPISODES = Path("meta/episodes/chunk-000/file-000.parquet")
VIDEO = Path("videos/observation.images.top/chunk-000/file-000.mp4")

Change = Callable[[Path], None]


def changed(*changes: Change) -> Callable[[Path], Path]:
    """Makes ``dataset``, a copy of the fixture with these changes."""

    def make(folder: Path) -> Path:
        dataset = Path(shutil.copytree(FIXTURE, folder / "dataset"))
        for change in changes:
            change(dataset)
        return dataset

    return make


def info(**values: object) -> Change:

    def change(dataset: Path) -> None:
        path = dataset / "meta" / "info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


def feature(name: str, **values: object) -> Change:
    """Adds a feature, of the type of the state unless told otherwise."""

    def change(dataset: Path) -> None:
        features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
        info(features=features | {name: features["observation.state"] | values})(dataset)

    return change


def rewritten(place: Path, change: Callable[[pyarrow.Table], pyarrow.Table]) -> Change:
    return lambda dataset: parquet.write_table(change(parquet.read_table(dataset / place)), dataset / place)


def column(name: str, **about: object) -> Change:
    """Adds a feature of one number, the number of the row."""

    def change(dataset: Path) -> None:
        feature(name, **{"shape": [1], "names": None} | about)(dataset)
        rewritten(
            DATA, lambda table: table.append_column(name, pyarrow.array(map(float, range(len(table)))))
        )(dataset)

    return change


def values(name: str, change: Callable[[int, Any], object]) -> Change:
    """Replaces each value of a column, by the number of its row and what it was."""

    def replace(table: pyarrow.Table) -> pyarrow.Table:
        changed = [change(row, value) for row, value in enumerate(table[name].to_pylist())]
        return table.set_column(table.column_names.index(name), name, pyarrow.array(changed))

    return rewritten(DATA, replace)


def renamed(old: str, new: str) -> Change:
    """Renames a feature and its column."""

    def change(dataset: Path) -> None:
        features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
        info(features={new if name == old else name: about for name, about in features.items()})(dataset)
        rewritten(
            DATA, lambda table: table.rename_columns([{old: new}.get(c, c) for c in table.column_names])
        )(dataset)

    return change


WITHOUT_VIDEOS = rewritten(
    EPISODES,
    lambda table: table.drop_columns([name for name in table.column_names if name.startswith("videos/")]),
)
"""Nothing says where the videos are."""


def episode(index: int, key: str, value: object) -> Change:
    """Sets what ``meta/episodes`` says of one episode."""

    def change(table: pyarrow.Table) -> pyarrow.Table:
        values = table[key].to_pylist()
        values[index] = value
        at = table.column_names.index(key)
        field = table.schema.field(at)
        return table.set_column(at, field, pyarrow.array(values, field.type))

    return rewritten(EPISODES, change)


def without_rows(*rows: int) -> Change:
    """Removes rows of the data file; rows 0 to 4 are episode 0, 5 to 10 episode 1, 11 to 17 episode 2."""
    return rewritten(DATA, lambda table: table.take([at for at in range(len(table)) if at not in rows]))


def reversed_rows(start: int, stop: int) -> Change:

    def change(table: pyarrow.Table) -> pyarrow.Table:
        return table.take([*range(start), *reversed(range(start, stop)), *range(stop, len(table))])

    return rewritten(DATA, change)


def renumbered(table: pyarrow.Table) -> pyarrow.Table:
    """Rows whose frames are counted anew, so that only their times know of frames that are not there."""
    counts: dict[int, int] = {}
    frames = []
    for index in table["episode_index"].to_pylist():
        frames.append(counts.setdefault(index, 0))
        counts[index] += 1
    at = table.column_names.index("frame_index")
    return table.set_column(at, table.schema.field(at), pyarrow.array(frames))


def climbing(dataset: Path) -> None:
    """Another dataset's data outside, and a path through a folder of this one that leads there."""
    shutil.copy(dataset / DATA, dataset.parent / "outside.parquet")
    (dataset / "data" / "l").mkdir()
    info(data_path="data/l/../../../outside.parquet")(dataset)


def twice(table: pyarrow.Table) -> pyarrow.Table:
    return pyarrow.concat_tables([table, table.slice(2, 1)])


def second_file(dataset: Path) -> None:
    """Episodes 2 and 3 lie in file-001, which is not there."""
    for index in (2, 3):
        episode(index, "data/file_index", 1)(dataset)
    without_rows(*range(11, 26))(dataset)


def video_of(*times: int) -> Change:
    """A video with frames at these multiples of 0.1 s alone."""

    def change(dataset: Path) -> None:
        import av
        import numpy as np

        with av.open(dataset / VIDEO, "w") as film:
            stream = film.add_stream("mpeg4", rate=10)
            stream.width, stream.height = 32, 16
            for time in times:
                frame = av.VideoFrame.from_ndarray(np.full((16, 32, 3), 5 * time, np.uint8), format="rgb24")
                frame.pts = time
                film.mux(stream.encode(frame))
            film.mux(stream.encode())

    return change


RAGGED = values("action", lambda row, value: [value[:1], [*value, 0.0]][row] if row < 2 else value)
"""Controls of one number and of three, which are two on average."""


def in_episode_1(name: str, change: Callable[[int, Any], object]) -> Callable[[Path], Path]:
    """A dataset in which the values of a column in episode 1 are replaced."""
    return changed(values(name, lambda row, value: change(row, value) if 5 <= row < 11 else value))


def of_episode(table: pyarrow.Table, index: int) -> pyarrow.Table:
    return table.filter(compute.equal(table["episode_index"], index))


OUT = "leads out of the dataset"
PATHS = {
    "lerobot data_path climbs": Row(changed(climbing), OUT),
    "lerobot wide number": Row(changed(info(data_path="data/{chunk_index:9999999999d}")), "may have only"),
    "lerobot NUL in a path": Row(changed(info(data_path="data/\0")), OUT),
}
"""Paths that are refused before anything is read."""

DROPPED = without_rows(7), episode(1, "length", 5)
"""A frame of episode 1 is gone, and everything that counts says so."""

CUT = "demo_1: length in meta/episodes is 6, and .* has 5 rows"
GAP = "has a gap before row 2:"
RAGGED_ROW = "demo_0: action has 1 numbers in row 0, and meta/info.json says 2; correct"
LATE = r"demo_1: timestamp is 3\.2 in row 0, not 0; correct it, or fps"
RENUMBERED = changed(*DROPPED, rewritten(DATA, renumbered))
EPISODES_NOT_WHOLE = {
    "lerobot dropped frame": (changed(without_rows(7)), CUT),
    "lerobot dropped frame, length corrected": (changed(*DROPPED), f"demo_1: frame_index {GAP} 1,"),
    "lerobot dropped frame, counted anew": (RENUMBERED, rf"demo_1: timestamp {GAP} 0\.1, then 0\.3"),
    "lerobot reversed": (changed(reversed_rows(5, 11)), "demo_1: frame_index steps back in row 1: 5, then 4"),
    "lerobot no rows": (changed(without_rows(*range(5, 11))), "demo_1: its rows are missing in"),
    "lerobot ragged": (changed(RAGGED), RAGGED_ROW),
    "lerobot late": (in_episode_1("timestamp", lambda _, value: value + 3.2), LATE),
}
"""Datasets of which one episode is not whole, and what is said of it."""

ROWS = {
    **PATHS,
    **{name: Row(*row) for name, row in EPISODES_NOT_WHOLE.items()},
    "lerobot missing file": Row(changed(second_file), r"demo_2: .*file-001\.parquet is missing"),
    "lerobot episode twice": Row(changed(rewritten(EPISODES, twice)), "demo_2: is there twice; remove one"),
    "lerobot episodes missing": Row(
        changed(rewritten(EPISODES, lambda table: table.slice(0, 3))),
        "the metadata counts 4 episodes, and meta/episodes has 3; correct total_episodes, or fetch",
    ),
    "lerobot without episodes": Row(
        changed(rewritten(EPISODES, lambda table: table.slice(0, 0)), info(total_episodes=0)),
        "meta/episodes holds no episodes",
    ),
    "lerobot key with a NUL": Row(changed(feature("observation.a\0b")), "which cannot be stored; rename it"),
    "lerobot key twice": Row(changed(column("observation.images/top")), None),
    "lerobot key below another": Row(changed(column("observation.state.x")), None),
    "lerobot feature without a column": Row(
        changed(feature("observation.x")), r"demo_0: has no column observation\.x"
    ),
    "lerobot without a control": Row(
        changed(renamed("action", "action.continuous")),
        "there is no feature 'action'.*; there is: observation.state, action.continuous; .* --action "
        "action.continuous",
    ),
    "lerobot without a place of videos": Row(changed(WITHOUT_VIDEOS), None),
}
