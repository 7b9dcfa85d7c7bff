"""HDF5 files of ManiSkill."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from shlex import quote

import h5py

from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import dataset_at, datasets, lazy, member, natural, opened, values_of
from ddco_pyro.data.sources import Source

BARE = "state"
"""Key of an observation array without a name."""


def open_maniskill(path: Path) -> Iterator[Source]:
    """Groups ``traj_0``, ... with ``actions`` [T, A] and ``obs``, one array or a tree of arrays [T + 1, ...].

    The observation after the last action is left out.

    :raises DemonstrationsError: the file cannot be read, or has no observations.
    """
    with opened(path) as file:
        names = sorted((name for name in file if re.fullmatch(r"traj_\d+", name)), key=natural)
        if names and not any(_observed(member(file, name, h5py.Group, ""), name) for name in names):
            raise DemonstrationsError(
                "has no observations; ManiSkill makes them: python -m mani_skill.trajectory.replay_trajectory"
                f" --traj-path {quote(str(path))} --save-traj -o state"
            )

        def read(name: str) -> Demonstration:
            group = member(file, name.replace("demo", "traj"), h5py.Group, "")
            actions = values_of(dataset_at(group, "actions", f"{name}: "), f"{name}: actions")
            observations = {}
            for key, place in _observed(group, name).items():
                dataset, where = dataset_at(group, place, f"{name}: "), f"{name}: {place}"
                steps = len(actions) if len(dataset) == len(actions) + 1 else None
                observations[key] = lazy(dataset, where, steps)
            return Demonstration.stored(name, observations, actions)

        yield Source(tuple(name.replace("traj", "demo") for name in names), read)


def _observed(group: h5py.Group, name: str) -> dict[str, str]:
    """Key and place of each observation of a trajectory."""
    if "obs" not in group:
        return {}
    obs = member(group, "obs", h5py.HLObject, f"{name}: ")
    return {BARE: "obs"} if isinstance(obs, h5py.Dataset) else {key: f"obs/{key}" for key in datasets(obs)}
