"""Formats of demonstrations that can be read; to add one, write its reader and a row of :data:`FORMATS`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple


class Format(NamedTuple):
    """A format of demonstrations.

    :param reader: yields one open :class:`~ddco_pyro.data.sources.Source`, ``module:function`` in
        :mod:`ddco_pyro.data.sources`. A module imports its own library, which other formats do not need.
    :param text: the path in words, such as ``the folder of a Minari dataset``.
    :param sign: a file or folder that tells a folder of this format.
    :param fits: whether a path has the format, if the sign alone does not tell; also given the names at the
        top of an HDF5 file, else none.
    :param parts: whether the control may have parts, whose names are the reader's argument ``actions``.
    """

    reader: str
    text: str
    sign: str = ""
    fits: Callable[[Path, Collection[str]], bool] | None = None
    parts: bool = False


def _minari(path: Path, names: Collection[str]) -> bool:
    folders = (path.parent,) if path.name == "main_data.hdf5" else (path / "data", path)
    return any((folder / "metadata.json").is_file() for folder in folders)


def _maniskill(path: Path, names: Collection[str]) -> bool:
    return any(name.startswith("traj_") for name in names)


def _act(path: Path, names: Collection[str]) -> bool:
    return {"action", "observations"} <= {*names} or _folder(path, names, "episode_*")


def _folder(path: Path, names: Collection[str], files: str = "*") -> bool:
    return any(one.suffix in (".hdf5", ".h5") for one in path.glob(files))


FORMATS = {
    "lerobot": Format(
        "lerobot:open_lerobot", "the folder of a LeRobot dataset", "meta/info.json", parts=True
    ),
    "minari": Format(
        "minari:open_minari", "the folder of a Minari dataset", "data/metadata.json", _minari, parts=True
    ),
    "maniskill": Format("maniskill:open_maniskill", "an HDF5 file of ManiSkill", fits=_maniskill),
    "act": Format("act:open_act", "the folder of ACT's episodes", "episode_0.hdf5", _act),
    "jigsaws": Format("jigsaws:open_jigsaws", "the folder of a task of JIGSAWS", "kinematics/AllGestures"),
    "folder": Format(
        "folder:open_folder", "a folder of HDF5 files, such as one for each task", "TASK.hdf5", _folder
    ),
    "robomimic": Format(
        "robomimic:open_robomimic",
        "an HDF5 file of robomimic's layout",
        fits=lambda path, names: path.is_file(),
    ),
}
"""By name, in the order in which they are recognised; robomimic's reader reports what is no HDF5 file."""


LAYOUTS = {
    "is a zarr store, as diffusion policy writes them": ({"zarr.json"}, {".zgroup"}),
    "is a TensorFlow dataset (RLDS)": ({"dataset_info.json", "features.json"}, {".tfrecord"}),
    "is a recording of ROS: read it with rosbags (pip install rosbags), "
    "at each step the last message of each": ({".mcap"}, {".db3"}),
    "has the layout of RoboMIND, with observations in puppet and controls in master": (
        {"master", "puppet"},
        {"trajectory.hdf5"},
    ),
    "has the layout of AgiBot World, with observations in state and controls in action, "
    "such as joint/position": ({"action", "state", "timestamp"}, {"proprio_stats.h5"}),
    "has the layout of RoboSet, with an episode in each Trial": ({"Trial0"}, {"Trial1"}),
}
"""Layouts that a few lines of Python convert, in words, and alternative sets of names that tell them: at the
top of an HDF5 file, or in a folder and the folders within, where suffixes are names, too."""
