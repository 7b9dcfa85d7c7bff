"""Sources of demonstrations: files and folders of several libraries behind one interface.

``robomimic`` HDF5 files (also this project's layout), ``minari`` and ``lerobot`` v3 datasets, HDF5 files of
``maniskill``, ``act`` and ``d4rl``, npz files of ``ogbench``, and the text files of ``jigsaws``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from shlex import quote
from typing import Protocol
from zipfile import is_zipfile

import h5py

from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.sources.recording import Column, Format, Recording
from ddco_pyro.errors import command, path_of

__all__ = ["Column", "Format", "Recording", "Source", "open_source", "refuse_foreign"]


class Source(Protocol):
    """A set of recordings, open for reading."""

    @property
    def format(self) -> Format:
        """The library that wrote the source."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings, in order."""

    @property
    def masks(self) -> Mapping[str, tuple[str, ...]]:
        """Name of each mask (robomimic: filter key) to names of recordings."""

    @property
    def frequency(self) -> float | None:
        """Control steps per second, Hz; None if unknown."""

    @property
    def attributes(self) -> Mapping[str, Attribute]:
        """Facts about the whole source."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the source, whose sizes and times identify its contents."""

    def recording(self, name: str) -> Recording:
        """One recording; its arrays can be read while the source is open."""


@contextmanager
def open_source(
    path: str | Path, form: Format | None = None, external: bool = False, actions: Sequence[str] = ()
) -> Iterator[Source]:
    """Open a file or folder.

    :param form: its format; recognised if None.
    :param external: whether parts of an HDF5 file may be in other files.
    :param actions: names of the arrays that are the control together, where a LeRobot or Minari dataset has several.
    :raises DemonstrationsError: the source cannot be read, or has another format.
    """
    path = path_of(path, "demonstrations")
    form = form or format_of(path)
    if actions and form not in ("lerobot", "minari"):
        raise DemonstrationsError(
            f"{path}: has the format {form}, with one control; --action is for LeRobot and Minari datasets"
        )
    opened: AbstractContextManager[Source]
    # Each reader imports its own library, which need not be installed for other formats.
    if form == "robomimic":
        from ddco_pyro.data.sources.robomimic import open_robomimic

        opened = open_robomimic(path, external)
    elif form == "minari":
        from ddco_pyro.data.sources.minari import open_minari

        opened = open_minari(path, external, actions)
    elif form == "lerobot":
        from ddco_pyro.data.sources.lerobot import open_lerobot

        opened = open_lerobot(path, actions)
    elif form == "ogbench":
        from ddco_pyro.data.sources.ogbench import open_ogbench

        opened = open_ogbench(path)
    elif form == "jigsaws":
        from ddco_pyro.data.sources.jigsaws import open_jigsaws

        opened = open_jigsaws(path)
    else:
        from ddco_pyro.data.sources.hdf5_layouts import open_layout

        opened = open_layout(path, form)
    with opened as source:
        yield source


# --- recognition ------------------------------------------------------------------------------------------------------

TRAJECTORY, EPISODE = re.compile(r"traj_(\d+)"), re.compile(r"episode_(\d+)\.(?:hdf5|h5)")
"""Names of ManiSkill's groups, and of ACT's files."""


def format_of(path: Path) -> Format:
    """The library that wrote a file or folder, by its layout.

    :raises DemonstrationsError: nothing is there, the layout is unknown, or it must be converted first.
    """
    if path.is_file():
        if path.name == "main_data.hdf5" and path.with_name("metadata.json").is_file():
            return "minari"
        return "ogbench" if path.suffix == ".npz" or is_zipfile(path) else _format_of_file(path)
    if not path.exists():
        raise DemonstrationsError(f"{path}: there is no such file or folder; check the path")
    if not path.is_dir():
        raise DemonstrationsError(f"{path}: is neither a regular file nor a folder; name an HDF5 file")
    if (path / "meta" / "info.json").is_file():
        return "lerobot"
    if (path / "data" / "metadata.json").is_file() or (path / "metadata.json").is_file():
        return "minari"
    if any(EPISODE.fullmatch(one.name) for one in path.iterdir()):
        return "act"
    if (path / "kinematics" / "AllGestures").is_dir():
        return "jigsaws"
    roots = [path, *(one for one in path.iterdir() if one.is_dir())]
    lines = "write its episodes into an HDF5 file as data/demo_0, data/demo_1, ... with the lines in docs/own.md"
    if any((root / name).exists() for root in roots for name in (".zgroup", "zarr.json")):
        raise DemonstrationsError(f"{path}: is a zarr store, as diffusion policy writes them; {lines}")
    if any((root / "dataset_info.json").exists() and (root / "features.json").exists() for root in roots):
        raise DemonstrationsError(f"{path}: is a TensorFlow dataset (RLDS); {lines}")
    raise DemonstrationsError(
        f"{path}: is a folder of no known format; name an HDF5 file, or the folder of a LeRobot dataset (with "
        "meta/info.json), a Minari dataset (with data/metadata.json), ACT's episodes (episode_0.hdf5) or a task of "
        "JIGSAWS (with kinematics/AllGestures)"
    )


def refuse_foreign(path: Path) -> None:
    """Refuse a dataset of another library, which is to be imported first.

    :raises DemonstrationsError: it is one, nothing is there, or the layout is unknown.
    """
    if (form := format_of(path)) != "robomimic":
        first = command("import", path, "--out", "demos.hdf5")
        raise DemonstrationsError(f"{path}: has the format {form}; first: {first}")


def _format_of_file(path: Path) -> Format:
    """The layout of an HDF5 file; robomimic's for files that are not HDF5, whose reader then reports the problem."""
    try:
        with h5py.File(path, "r") as file:
            names = set(file)
            prepared = "env_args" in file["data"].attrs if _has_states_only(file.get("data")) else None
    except (OSError, RuntimeError, ValueError, KeyError):
        return "robomimic"
    if prepared is not None:
        scripts, name = "python -m robomimic.scripts", quote(str(path))
        before = "" if prepared else f"{scripts}.conversion.convert_robosuite --dataset {name} && "
        raise DemonstrationsError(
            f"{path}: has states of robosuite's simulator and no observations; robomimic makes them: {before}"
            f"{scripts}.dataset_states_to_obs --dataset {name} --output_name low_dim.hdf5"
        )
    if any(TRAJECTORY.fullmatch(name) for name in names):
        return "maniskill"
    if {"action", "observations"} <= names:
        return "act"
    if {"actions", "observations"} <= names and names & {"terminals", "timeouts"}:
        return "d4rl"
    return "robomimic"


def _has_states_only(data: object) -> bool:
    """Whether the first demonstration in a group has simulator states and no observations."""
    if not isinstance(data, h5py.Group):
        return False
    first = next((name for name in data if data.get(name, getclass=True) is h5py.Group), None)
    return first is not None and "states" in data[first] and "obs" not in data[first]
