"""Which library wrote a file or folder, by its layout; for a layout that is not read here, what converts it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from shlex import quote

import h5py

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources.recording import Format

TRAJECTORY, EPISODE = re.compile(r"traj_(\d+)"), re.compile(r"episode_(\d+)\.(?:hdf5|h5)")
"""Names of ManiSkill's groups, and of ACT's files."""


def format_of(path: Path) -> Format:
    """Which library wrote this.

    :raises DemonstrationsError: there is nothing, nothing known, or something that has to be converted first.
    """
    if path.is_file():
        if path.name == "main_data.hdf5" and path.with_name("metadata.json").is_file():
            return "minari"
        return _of_file(path)
    if not path.exists():
        raise DemonstrationsError(f"{path}: there is no such file or folder; check the path")
    if not path.is_dir():
        raise DemonstrationsError(f"{path}: is neither a regular file nor a folder; name an HDF5 file")
    if (path / "meta" / "info.json").is_file():
        return "lerobot"
    if (path / "data" / "metadata.json").is_file() or (path / "metadata.json").is_file():
        return "minari"
    if path.is_dir() and any(EPISODE.fullmatch(one.name) for one in path.iterdir()):
        return "act"
    for remedy in _remedies(path):
        raise DemonstrationsError(f"{path}: {remedy}")
    raise DemonstrationsError(
        f"{path}: is a folder of no known format; name an HDF5 file, or the folder of a LeRobot dataset (with "
        "meta/info.json), a Minari dataset (with data/metadata.json) or ACT's episodes (episode_0.hdf5)"
    )


def _of_file(path: Path) -> Format:
    """The layout of an HDF5 file; robomimic's, whose reader says what is wrong, where it is no HDF5.

    :raises DemonstrationsError: it has states of a simulator and no observations.
    """
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
    """Whether ``data`` is a group whose first demonstration has states of a simulator, and no observations."""
    if not isinstance(data, h5py.Group):
        return False
    first = next((name for name in data if data.get(name, getclass=True) is h5py.Group), None)
    return first is not None and "states" in data[first] and "obs" not in data[first]


_LINES = "write its episodes into an HDF5 file as data/demo_0, data/demo_1, ... with the lines in docs/own.md"


def _remedies(path: Path) -> Iterator[str]:
    """What to do with a folder of a known layout that is not read here."""
    roots = [path, *(one for one in path.iterdir() if one.is_dir())] if path.is_dir() else []
    if any((root / name).exists() for root in roots for name in (".zgroup", "zarr.json")):
        yield f"is a zarr store, as diffusion policy writes them; {_LINES}"
    if any((root / "dataset_info.json").exists() and (root / "features.json").exists() for root in roots):
        yield f"is a TensorFlow dataset (RLDS); {_LINES}"
