"""Small random demonstrations with a vector, a camera and labels, for tests of files; others by number."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations


def demonstration(name: str, steps: int = 4, seed: int = 0) -> Demonstration:
    random = np.random.default_rng(seed)
    return Demonstration(
        name=name,
        observations={
            "pose": random.normal(size=(steps, 3)),
            "camera": random.integers(0, 256, (steps, 6, 5, 3), dtype=np.uint8),
        },
        actions=random.normal(size=(steps, 2)),
        labels={"phase": random.integers(0, 3, steps)},
        attributes={"seed": seed, "accuracy": 0.5, "success": True, "policy": "supervisor"},
    )


def demonstrations(number: int = 12, masks: dict[str, tuple[str, ...]] | None = None) -> Demonstrations:
    records = tuple(demonstration(f"demo_{index}", 3 + index % 4, index) for index in range(number))
    return Demonstrations(records, masks or {}, {"task": "needle", "version": 3})


def numbered(rows: Iterable[tuple[Any, ...]]) -> Demonstrations:
    """``demo_0``, ``demo_1``, … of these: observations, controls and perhaps labels."""
    return Demonstrations(tuple(Demonstration(f"demo_{n}", *row) for n, row in enumerate(rows)))


def of_states(lengths: Iterable[int], seed: int = 0) -> Demonstrations:
    """Demonstrations of so many steps each, with a state of three numbers and a control of two."""
    random = np.random.default_rng(seed)
    return numbered(
        ({"state": random.normal(size=(steps, 3))}, random.normal(size=(steps, 2))) for steps in lengths
    )
