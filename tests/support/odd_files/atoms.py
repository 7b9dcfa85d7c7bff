"""Controls that are exactly one value inside their range in many steps: no-ops of a teleoperator who rests."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from odd_files import Row


def no_ops(number: int = 8, steps: int = 30, dimensions: int = 3, at_once: bool = True) -> Demonstrations:
    """Demonstrations without any skill: in half of the steps the control is exactly 0, else it is normal.

    :param at_once: in all dimensions at once; else in each by itself.
    """
    random, made = np.random.default_rng(0), []
    for index in range(number):
        still = random.random((steps, 1 if at_once else dimensions)) < 0.5
        controls = np.where(still, 0.0, random.normal(size=(steps, dimensions)))
        made.append(Demonstration(f"demo_{index}", {"state": random.normal(size=(steps, 2))}, controls))
    return Demonstrations(tuple(made))


def at_bounds(number: int = 8) -> Demonstrations:
    """The same, cut off at ±1."""
    return Demonstrations(
        tuple(
            Demonstration(demo.name, demo.observations, demo.actions.clip(-1, 1))
            for demo in no_ops(number, at_once=False)
        )
    )


def _written(make: Callable[[], Demonstrations], folder: Path) -> Path:
    make().write(folder / "demos.hdf5")
    return folder / "demos.hdf5"


ROWS = {
    "half of the steps are no-ops": Row(partial(_written, no_ops), None),
    "each dimension rests by itself": Row(partial(_written, partial(no_ops, at_once=False)), None),
    "resting, and at bounds": Row(partial(_written, at_bounds), None),
}
