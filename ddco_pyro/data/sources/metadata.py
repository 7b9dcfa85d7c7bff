"""Facts and names that sources give: rates, paths that stay in their folder, storable names, counts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from ddco_pyro.data.arrays import NUMBERS
from ddco_pyro.data.errors import DemonstrationsError

FREQUENCY = "control_frequency"
"""Attribute of a file: control steps per second, Hz."""

_RATES = (
    *(FREQUENCY, "control_freq", "control_hz", "control_rate", "frequency", "freq", "hz", "rate"),
    *("sampling_rate", "sample_rate", "fps", "frame_rate", "framerate"),
)
_PERIODS = ("control_dt", "control_timestep", "dt")


def rate(said: Mapping[str, object]) -> float | None:
    """Control steps per second, Hz, under one of the usual names; None where no usable number is under any.

    Upper and lower case are the same. A number may be text with its unit, ``20 Hz``. Periods are in seconds.
    """
    known = {name.lower(): value for name, value in said.items()}
    for name in (*_RATES, *_PERIODS):
        try:
            number = float(str(known.get(name)).lower().removesuffix("hz"))
        except ValueError:
            continue
        if 0 < number < math.inf:
            return number if name in _RATES else float(f"{1 / number:.9g}")
    return None


LONGEST_GAP = 1.5
"""A clock has a gap where a step is longer than LONGEST_GAP × the median step."""


def clock_fault(times: np.ndarray, longest: float = LONGEST_GAP) -> str:
    """The first gap, step back or repeated stamp of a clock [T], in words; empty without any.

    >>> clock_fault(np.array([0.0, 0.1, 0.2, 0.5, 0.6]))
    'has a gap before row 3: 0.2, then 0.5'
    """
    steps = np.diff(times)
    wrong = np.flatnonzero((steps <= 0) | (steps > longest * np.median(steps)))
    if not len(wrong):
        return ""
    at = int(wrong[0])
    step = steps[at]
    fault = "has a gap before" if step > 0 else "steps back in" if step < 0 else "repeats its stamp in"
    return f"{fault} row {at + 1}: {times[at]:.6g}, then {times[at + 1]:.6g}"


def inside(folder: Path, relative: str) -> Path:
    """The path ``folder / relative``, which need not exist; links are followed, as other programs do.

    :raises DemonstrationsError: the path leaves the folder by its name, or is no path.
    """
    pure = PurePosixPath(relative)
    if pure.is_absolute() or ".." in pure.parts or "\0" in relative:
        leads = f"{relative[:100]!r} leads out of the dataset"
        raise DemonstrationsError(f"{folder}: {leads}; correct its metadata")
    return folder / pure


def filled(folder: Path, template: str, values: Mapping[str, int | str]) -> str:
    """A template such as ``data/chunk-{chunk_index:03d}.parquet`` with its placeholders filled.

    The only format is zero padding, to a width of at most 12.

    :raises DemonstrationsError: the template has other placeholders or formats.
    """
    placeholder = rf"\{{({'|'.join(values)})(?::0(\d|1[0-2])d)?\}}"
    path = re.sub(placeholder, lambda found: str(values[found[1]]).zfill(int(found[2] or 0)), template)
    if {*path} & {*"{}"}:
        known = ", ".join(f"{{{name}}}" for name in values)
        allowed = f"may have only {known}, and numbers as {{chunk_index:03d}}"
        raise DemonstrationsError(f"{folder}: the path {template[:200]!r} {allowed}")
    return path


def joined(parts: Mapping[str, np.ndarray], where: str) -> np.ndarray:
    """Arrays [T, ...] by name as one array [T, D], in this order.

    :param where: the demonstration, for messages.
    :raises DemonstrationsError: there is no array, one holds no numbers, or not as many steps as the first.
    """
    if not parts:
        raise DemonstrationsError(f"{where}: has no actions")
    first, steps = next((name, len(array)) for name, array in parts.items())
    for name, array in parts.items():
        if array.dtype.kind not in NUMBERS:
            holds = f"{name} holds {array.dtype}, not numbers"
            raise DemonstrationsError(f"{where}: {holds}; name the control with --action")
        if len(array) != steps:
            raise DemonstrationsError(f"{where}: {name} has {len(array)} steps, but {first} has {steps}")
    flat = [array.reshape(steps, math.prod(array.shape[1:])) for array in parts.values()]
    return np.concatenate(flat, axis=1)


def stored_keys(folder: Path, names: Sequence[str], preferred: Sequence[str]) -> list[str]:
    """Keys under which HDF5 can store observations together.

    Each name has its preferred key, or itself where another name has that key, or one above or below.

    :param preferred: of each name.
    :raises DemonstrationsError: a name cannot be stored, or occurs too often.
    """
    for name in names:
        if len(name) > 250 or "\0" in name or not {"", "."}.isdisjoint(name.split("/")):
            called = f"an observation is called {name[:100]!r}"
            raise DemonstrationsError(f"{folder}: {called}, which cannot be stored; rename it")
    keys = [name if _meets(key, preferred) else key for name, key in zip(names, preferred, strict=True)]
    if any(_meets(key, keys) for key in keys):
        text = "two observations have one name, or one lies in the other; rename one"
        raise DemonstrationsError(f"{folder}: {text}")
    return keys


def _meets(key: str, keys: Sequence[str]) -> bool:
    """Whether another of the keys equals this one of them, or is a group above or below it."""
    own = f"{key}/"
    return sum(own.startswith(f"{other}/") or f"{other}/".startswith(own) for other in keys) > 1


def check_count(folder: Path, total: object, there: int, named: str) -> None:
    """Refuse a dataset whose metadata count other episodes than there are.

    :param total: number of episodes by the metadata; ignored unless a whole number.
    :param named: where the episodes are, for messages.
    :raises DemonstrationsError: they do.
    """
    if isinstance(total, int) and total != there:
        counts = f"the metadata counts {total} episodes, and {named} has {there}"
        raise DemonstrationsError(f"{folder}: {counts}; correct total_episodes, or fetch the dataset again")
