"""Records the successful episodes of an expert as HDF5 in robomimic's layout. Needs numpy and h5py alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

GIVE_UP = 10
"""Attempts for each demonstration that is wanted."""

Recorded = Mapping[str, np.ndarray]
"""Arrays of a demonstration by their place, such as ``obs/gripper``; each has a row for every step."""


def collect(
    out: Path,
    environment: str,
    demonstrate: Callable[[int], Recorded | None],
    number: int,
    held_out: int,
    first: int = 0,
    attempts: int | None = None,
) -> None:
    """Record the first successful episodes; of them the first ones are held out, however many there are.

    :param demonstrate: the episode of a seed; None where it had no success.
    :param first: the seed of the first attempt; at most so many ``attempts``.
    :raises SystemExit: too few episodes succeed; nothing is written.
    """
    temporary, seed, names = out.with_name(f".{out.name}.tmp"), first, []
    attempts = GIVE_UP * number if attempts is None else attempts
    with h5py.File(temporary, "w") as file:
        data, total = file.create_group("data"), 0
        while len(names) < number:
            if seed >= first + attempts:
                temporary.unlink()
                succeeded = f"the expert succeeded in {len(names)} of {attempts} episodes"
                raise SystemExit(f"{environment}: {succeeded}; {number} are needed")
            recorded = demonstrate(seed)
            if recorded is not None:
                names.append(f"demo_{len(names)}")
                total += _write(data.create_group(names[-1]), recorded, seed)
            seed += 1
        for mask, chosen in (("valid", names[:held_out]), ("train", names[held_out:])):
            file[f"mask/{mask}"] = np.array(chosen, "S")
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps({"env_name": environment, "type": 2, "env_kwargs": {}})
    temporary.replace(out)


def _write(group: Any, recorded: Recorded, seed: int) -> int:
    """A demonstration; its number of steps."""
    for place, values in recorded.items():
        group[place] = values
    steps = len(recorded["actions"])
    group["dones"] = np.arange(steps) == steps - 1
    group.attrs.update({"num_samples": steps, "seed": seed})
    return steps
