"""What lies in the bin: dissection pins, suturing needles and wires; and four kinds never demonstrated.

All but the thread are rigid chains of capsules and cylinders. The thread is a chain of links with joints
between them, which keep the shape it has on the spool, but softly. An object's frame has its origin in the
middle of the object and x along it; lengths are metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

KINDS = ("pin", "needle", "wire")
UNSEEN = ("thread", "diode", "nail", "screw")
ACCEPTED = "pin"
DENSITY = 7800.0  # kg/m³, of steel

PIN_LENGTH, PIN_RADIUS, HEAD_RADIUS = 0.024, 0.0005, 0.0015
NEEDLE_ARC_RADIUS, NEEDLE_RADIUS = 0.009, 0.0006
NEEDLE_HALF_ANGLE = np.deg2rad(67.5)  # three eighths of a circle
NEEDLE_PARTS = 6
WIRE_LENGTH, WIRE_BEND, WIRE_RADIUS = 0.027, np.deg2rad(40.0), 0.001  # three equal parts, bent to either side

DIODE_LENGTH, DIODE_RADIUS = 0.005, 0.0013  # as a DO-41, its leads straight
LEADS_LENGTH, LEAD_RADIUS = 0.026, 0.0005
NAIL_LENGTH, NAIL_RADIUS, NAIL_HEAD_LENGTH, NAIL_HEAD_RADIUS = 0.030, 0.0010, 0.0012, 0.0024
SCREW_LENGTH, SCREW_RADIUS = 0.016, 0.0015  # M3 with its head
SCREW_HEAD_LENGTH, SCREW_HEAD_RADIUS = 0.0022, 0.0028
THREAD_LENGTH, THREAD_RADIUS, THREAD_LINKS = 0.028, 0.0005, 9
THREAD_BEND = np.deg2rad(24.0)  # from link to link, as it comes from the spool
THREAD_STIFFNESS, THREAD_DAMPING, THREAD_ARMATURE = 2e-6, 2e-7, 2e-9  # of a joint: N·m/rad, N·m·s/rad, kg·m²


class Part(NamedTuple):
    """A capsule or a cylinder: both ends [3] of its axis, and its radius (m)."""

    start: np.ndarray
    end: np.ndarray
    radius: float
    shape: str = "capsule"


def parts(kind: str) -> list[Part]:
    """What an object of this kind is made of; of a thread, the links in the shape that it keeps."""
    if kind == "pin":
        ends = np.array([[-PIN_LENGTH / 2, 0.0, 0.0], [PIN_LENGTH / 2, 0.0, 0.0]])
        head = ends[1] + [0.0005, 0.0, 0.0]  # a capsule of next to no length is a ball
        return [Part(ends[0], ends[1], PIN_RADIUS), Part(ends[1], head, HEAD_RADIUS)]
    if kind == "diode":
        edges = [-LEADS_LENGTH / 2, -DIODE_LENGTH / 2, DIODE_LENGTH / 2, LEADS_LENGTH / 2]
        return _turned(edges, [LEAD_RADIUS, DIODE_RADIUS, LEAD_RADIUS])
    if kind == "nail":
        edges = [-NAIL_LENGTH / 2, NAIL_LENGTH / 2 - NAIL_HEAD_LENGTH, NAIL_LENGTH / 2]
        return _turned(edges, [NAIL_RADIUS, NAIL_HEAD_RADIUS])
    if kind == "screw":
        edges = [-SCREW_LENGTH / 2, SCREW_LENGTH / 2 - SCREW_HEAD_LENGTH, SCREW_LENGTH / 2]
        return _turned(edges, [SCREW_RADIUS, SCREW_HEAD_RADIUS])
    corners, radius = {
        "needle": (_arc, NEEDLE_RADIUS),
        "wire": (_zigzag, WIRE_RADIUS),
        "thread": (_loop, THREAD_RADIUS),
    }[kind]
    return [Part(start, end, radius) for start, end in itertools.pairwise(corners())]


def _turned(edges: Sequence[float], radii: Sequence[float]) -> list[Part]:
    """Cylinders along x, one after another."""
    ends = [np.array([edge, 0.0, 0.0]) for edge in edges]
    pairs = zip(itertools.pairwise(ends), radii, strict=True)
    return [Part(*pair, radius, "cylinder") for pair, radius in pairs]


def _arc() -> np.ndarray:
    angles = np.linspace(-NEEDLE_HALF_ANGLE, NEEDLE_HALF_ANGLE, NEEDLE_PARTS + 1)
    arc = np.stack([np.sin(angles), 1.0 - np.cos(angles), np.zeros_like(angles)], axis=1)
    corners = NEEDLE_ARC_RADIUS * arc
    return corners - corners.mean(axis=0) * [0.0, 1.0, 0.0]


def _zigzag() -> np.ndarray:
    headings = np.cumsum([-WIRE_BEND / 2, WIRE_BEND, -WIRE_BEND])
    steps = WIRE_LENGTH / 3 * np.stack([np.cos(headings), np.sin(headings), np.zeros(3)], axis=1)
    corners = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return corners - corners.mean(axis=0)


def _loop() -> np.ndarray:
    """A curve that is bent to one side in its first half and to the other one in its second half."""
    links = np.arange(THREAD_LINKS) - THREAD_LINKS // 2
    headings = THREAD_BEND * (np.abs(links) - np.abs(links).mean())
    ways = np.stack([np.cos(headings), np.sin(headings), 0.0 * headings], axis=1)
    steps = THREAD_LENGTH / THREAD_LINKS * ways
    corners = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return corners - (corners[THREAD_LINKS // 2] + corners[THREAD_LINKS // 2 + 1]) / 2


def bodies(kinds: Sequence[str]) -> str:
    """The XML of free bodies ``object_0``, ``object_1``, ... of these kinds, on the table beside all else."""
    return "\n".join(_body(number, kind) for number, kind in enumerate(kinds))


def parking(number: int) -> np.ndarray:
    """Where on the table [3] an object waits to be dropped."""
    return np.array([-0.14 + 0.04 * number, 0.12, 0.002])


def _body(number: int, kind: str) -> str:
    chain = parts(kind)
    content = _linked(chain) if kind == "thread" else "".join(_geom(part) for part in chain)
    place = _numbers(parking(number))
    return (
        f'<body name="object_{number}" pos="{place}">'
        f'<joint name="object_{number}" type="free" armature="1e-7"/>{content}</body>'
    )


def _geom(part: Part) -> str:
    contact = 'contype="1" conaffinity="1" condim="3" friction=".4 .0005 .0001" solref=".004 1"'
    return (
        f'<geom type="{part.shape}" fromto="{_numbers(part.start)} {_numbers(part.end)}" '
        f'size="{part.radius:g}" {contact} material="object" density="{DENSITY:g}" group="1"/>'
    )


def _linked(chain: Sequence[Part]) -> str:
    """The middle link, and bodies that hang on both its ends, each on the one before."""
    middle = len(chain) // 2
    after = _arm([(part.start, part) for part in chain[middle + 1 :]], np.zeros(3))
    before = _arm([(part.end, part) for part in reversed(chain[:middle])], np.zeros(3))
    return _geom(chain[middle]) + after + before


def _arm(links: Sequence[tuple[np.ndarray, Part]], origin: np.ndarray) -> str:
    """Links, each with the point where its joint is, as nested bodies in one with its frame at ``origin``."""
    if not links:
        return ""
    (joint, part), *rest = links
    own = part._replace(start=part.start - joint, end=part.end - joint)
    return (
        f'<body pos="{_numbers(joint - origin)}"><joint type="ball" stiffness="{THREAD_STIFFNESS:g}" '
        f'damping="{THREAD_DAMPING:g}" armature="{THREAD_ARMATURE:g}"/>{_geom(own)}{_arm(rest, joint)}</body>'
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.8g}" for value in values)


def scene(path: Path, kinds: Sequence[str]) -> str:
    """The XML of the scene in ``path`` with objects of these kinds."""
    text = path.read_text(encoding="utf-8")
    return text.replace("</worldbody>", f"{bodies(kinds)}\n</worldbody>", 1)
