"""What lies in the bin: dissection pins, suturing needles and wires, each a chain of capsules.

An object's frame has its origin in the middle of the object and x along it; lengths are metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

KINDS = ("pin", "needle", "wire")
ACCEPTED = "pin"
DENSITY = 7800.0  # kg/m³, of steel

PIN_LENGTH, PIN_RADIUS, HEAD_RADIUS = 0.024, 0.0005, 0.0015
NEEDLE_ARC_RADIUS, NEEDLE_HALF_ANGLE, NEEDLE_RADIUS = 0.009, np.deg2rad(67.5), 0.0006  # three eighths of a circle
NEEDLE_PARTS = 6
WIRE_LENGTH, WIRE_BEND, WIRE_RADIUS = 0.027, np.deg2rad(40.0), 0.001  # three equal parts, bent to either side

Part = tuple[np.ndarray, np.ndarray, float]
"""A capsule: its ends [3] and its radius (m)."""


def parts(kind: str) -> list[Part]:
    """The capsules of an object of this kind."""
    if kind == "pin":
        ends = np.array([[-PIN_LENGTH / 2, 0.0, 0.0], [PIN_LENGTH / 2, 0.0, 0.0]])
        head = ends[1] + [0.0005, 0.0, 0.0]  # a capsule of next to no length is a ball
        return [(ends[0], ends[1], PIN_RADIUS), (ends[1], head, HEAD_RADIUS)]
    corners = _arc() if kind == "needle" else _zigzag()
    radius = NEEDLE_RADIUS if kind == "needle" else WIRE_RADIUS
    return [(start, end, radius) for start, end in itertools.pairwise(corners)]


def _arc() -> np.ndarray:
    angles = np.linspace(-NEEDLE_HALF_ANGLE, NEEDLE_HALF_ANGLE, NEEDLE_PARTS + 1)
    corners = NEEDLE_ARC_RADIUS * np.stack([np.sin(angles), 1.0 - np.cos(angles), np.zeros_like(angles)], axis=1)
    return corners - corners.mean(axis=0) * [0.0, 1.0, 0.0]


def _zigzag() -> np.ndarray:
    headings = np.cumsum([-WIRE_BEND / 2, WIRE_BEND, -WIRE_BEND])
    steps = WIRE_LENGTH / 3 * np.stack([np.cos(headings), np.sin(headings), np.zeros(3)], axis=1)
    corners = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return corners - corners.mean(axis=0)


def bodies(kinds: Sequence[str]) -> str:
    """The XML of free bodies ``object_0``, ``object_1``, ... of these kinds, on the table beside everything else."""
    return "\n".join(_body(number, kind) for number, kind in enumerate(kinds))


def parking(number: int) -> np.ndarray:
    """Where on the table [3] an object waits to be dropped."""
    return np.array([-0.14 + 0.04 * number, 0.12, 0.002])


def _body(number: int, kind: str) -> str:
    contact = 'contype="1" conaffinity="1" condim="3" friction=".4 .0005 .0001" solref=".004 1"'
    geoms = "".join(
        f'<geom type="capsule" fromto="{_numbers(start)} {_numbers(end)}" size="{radius:g}" {contact} '
        f'material="object" density="{DENSITY:g}" group="1"/>'
        for start, end, radius in parts(kind)
    )
    place = _numbers(parking(number))
    return (
        f'<body name="object_{number}" pos="{place}">'
        f'<joint name="object_{number}" type="free" armature="1e-7"/>{geoms}</body>'
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.8g}" for value in values)


def scene(path: Path, kinds: Sequence[str]) -> str:
    """The XML of the scene in ``path`` with objects of these kinds."""
    text = path.read_text(encoding="utf-8")
    return text.replace("</worldbody>", f"{bodies(kinds)}\n</worldbody>", 1)
