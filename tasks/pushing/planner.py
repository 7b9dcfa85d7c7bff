"""The planning supervisor's mind: RRT-Connect round the box to behind it, then along a band of tip heights.

After the paper's supervisor (§5.1, SM 1.1), whose one parameter is the longest branch of the tree, 0.1. A
plan is made a function of the state, so that it can be imitated: the planner starts from the same random
numbers for every plan, paths are cut short until little of their random growth is left, the configurations
they lead to follow a rule, and all pushes to a side go along one path, wherever they begin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from ..planning import NoPath, Settings, plan_path
from . import geometry as geometry
from . import rules as rules
from .rules import Scene

RRT = Settings(range=0.1, resolution=0.004, shortcuts=60)
MARGIN = 0.05  # m: what a planned path keeps from the box
BAND = 0.04  # m: half height of the band in which the tip pushes
LEAN = 0.25  # rad: how far the hand's pitch may be from the one to push with
LEVEL, UPRIGHT = (
    0.015,
    0.1,
)  # m, rad: the same for a path along which all pushes go: a low one kicks the box's foot away
FARTHEST = 0.55  # m: where such a path begins and ends
# rad: how far a push may leave the range of its ends, which keeps the tree small
ROOM = np.array([0.3, 0.3, 0.4])

SPACING = 0.02  # rad, between the points of a path
LOOK_AHEAD = 0.35  # rad along the path: where the arm aims
ASTRAY = 0.3  # rad: an arm that is further from its path plans again
BOX_MOVED = 0.02  # m: a box that has moved this far since an approach was planned makes it invalid

Replanning = Literal["when_invalid", "every_step"]
IsFree = Callable[[np.ndarray], bool]
"""Whether an arm may be at joint angles [3]."""


class Plan(NamedTuple):
    """Joint angles [N, 3], closely spaced; 0 to approach or 1 to push; and the scene that it was made for."""

    path: np.ndarray
    phase: int
    scene: Scene


@dataclass
class Planner:
    """Follows plans; makes another when the one it has is no longer valid, or at every step.

    :param repeatable: whether equal scenes give equal plans, and equal goals equal pushes. If not, the random
        numbers go on, paths are only cut short by leaving out corners, and the configurations that they lead
        to are drawn: what the planner does by itself.
    """

    replanning: Replanning = "when_invalid"
    repeatable: bool = True

    def __post_init__(self) -> None:
        self._settings = RRT if self.repeatable else Settings(RRT.range, RRT.resolution, 0, repeatable=False)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Forget the plan; ``seed`` decides what is drawn, if anything is."""
        self._plan: Plan | None = None
        self._random = np.random.default_rng(seed)

    @property
    def phase(self) -> int:
        """Of the plan that is followed: 0 approach, 1 push."""
        return self._plan.phase if self._plan else 0

    def decide(self, scene: Scene) -> np.ndarray:
        """Joint velocities [3] (rad/s) along the plan; straight up where there is none."""
        if self._plan is None or self.replanning == "every_step" or not is_valid(self._plan, scene):
            self._plan = self._make(scene)
        if self._plan is None:
            return rules.towards(scene.angles, raised(scene))
        if self._plan.phase == 1:
            return rules.towards(scene.angles, ahead(self._plan.path, scene.angles)) * pace(scene)
        return rules.towards(scene.angles, ahead(self._plan.path, scene.angles))

    def _make(self, scene: Scene) -> Plan | None:
        """A push where the arm is in place for it, otherwise an approach; None where no path is found."""
        try:
            if may_push(scene.angles, scene):
                return Plan(self._push(scene), 1, scene)
            return Plan(self._approach(scene), 0, scene)
        except NoPath:
            return None

    def _approach(self, scene: Scene) -> np.ndarray:
        """A path round the box to behind it. It begins by backing off, where the arm is too near to it."""

        def is_free(angles: np.ndarray) -> bool:
            return geometry.is_clear(angles, scene.box, MARGIN)

        start = within_limits(scene.angles if is_free(scene.angles) else backed_off(scene))
        path = plan_path(start, self._behind(scene), geometry.JOINT_RANGES, is_free, self._settings)
        return dense(np.vstack([scene.angles, path]))

    def _push(self, scene: Scene) -> np.ndarray:
        """A path that takes the box to its goal, and as far beyond as the tip follows through."""
        goal = behind(scene.side, scene.goal, geometry.CONTACT - rules.FOLLOW_THROUGH)
        if self.repeatable:
            path = push_path(scene.side)
            return np.vstack([path[: np.linalg.norm(path - goal, axis=1).argmin()], goal])
        start = within_limits(scene.angles)
        return planned_push(start, goal, lambda angles: in_band(angles, scene.side), self._settings)

    def _behind(self, scene: Scene) -> np.ndarray:
        """Joint angles behind the box, ready to push."""
        if self.repeatable:
            return behind(scene.side, scene.box, rules.BEHIND)
        height, lean = self._random.uniform(-0.8, 0.8, 2) * (BAND, LEAN)
        return behind(scene.side, scene.box, rules.BEHIND + self._random.uniform(-0.02, 0.04), height, lean)


@lru_cache
def push_path(side: int) -> np.ndarray:
    """Joint angles [N, 3] that push a box from one end of the plane to the other."""
    start, goal = (within_limits(behind(side, end * side * FARTHEST, geometry.CONTACT)) for end in (-1, 1))
    return planned_push(start, goal, lambda angles: in_band(angles, side, LEVEL, UPRIGHT), RRT)


def planned_push(start: np.ndarray, goal: np.ndarray, is_free: IsFree, settings: Settings) -> np.ndarray:
    """A path [N, 3] between joint angles that leaves the range of its ends by a little ``ROOM`` only."""
    ends = np.array([start, goal])
    limits = [within_limits(ends.min(axis=0) - ROOM), within_limits(ends.max(axis=0) + ROOM)]
    ranges = np.stack(limits, axis=1)
    return dense(plan_path(start, goal, ranges, is_free, settings))


def within_limits(angles: np.ndarray) -> np.ndarray:
    """Joint angles [3] within the joints' limits: the simulated ones are soft, the planner's are not."""
    return np.clip(angles, geometry.JOINT_RANGES[:, 0], geometry.JOINT_RANGES[:, 1])


def behind(side: int, box: float, distance: float, height: float = 0.0, lean: float = 0.0) -> np.ndarray:
    """Joint angles with the tip a distance (m) behind a box's centre; ``height``, ``lean`` off the usual."""
    tip = np.array([box - side * distance, rules.PUSH_HEIGHT + height])
    return geometry.inverse(tip, side * rules.PUSH_PITCH + lean)


def in_band(angles: np.ndarray, side: int, height: float = BAND, lean: float = LEAN) -> bool:
    """Whether tip height and pitch are such that the arm may push: in half widths (m, rad) of the usual."""
    level = abs(geometry.tip_position(angles)[1] - rules.PUSH_HEIGHT) < height
    return bool(level and abs(float(np.sum(angles)) - side * rules.PUSH_PITCH) < lean)


def may_push(angles: np.ndarray, scene: Scene) -> bool:
    """Whether the arm is behind the box, near it, and within the band."""
    distance = -scene.side * (geometry.tip_position(angles)[0] - scene.box)
    return geometry.BOX_HALF_WIDTH < distance < rules.BEHIND + 0.1 and in_band(angles, scene.side)


def is_valid(plan: Plan, scene: Scene) -> bool:
    """Whether a plan made for another scene still serves: same goal and side, box and arm where they were
    expected, and the arm in place to push where the plan is to push, and nowhere else.
    """
    if scene.goal != plan.scene.goal or scene.side != plan.scene.side:
        return False
    if float(np.linalg.norm(plan.path - scene.angles, axis=1).min()) > ASTRAY:
        return False
    if may_push(scene.angles, scene) or plan.phase == 1:
        return may_push(scene.angles, scene) and plan.phase == 1
    return abs(scene.box - plan.scene.box) < BOX_MOVED


def ahead(path: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """The point [3] of a path [N, 3] that lies ahead of the one nearest to ``angles``."""
    nearest = int(np.linalg.norm(path - angles, axis=1).argmin())
    return path[min(nearest + round(LOOK_AHEAD / SPACING), len(path) - 1)]


def pace(scene: Scene) -> float:
    """How fast to push, as a part of full speed: slower as the box comes near to its goal."""
    return min(1.0, rules.advance(scene) / rules.FULL_ADVANCE)


def backed_off(scene: Scene) -> np.ndarray:
    """Joint angles near those of the scene, further from the box: sideways for a tip beside it, else up."""
    tip = geometry.tip_position(scene.angles)
    pitch = float(np.sum(scene.angles))
    away = np.array([np.copysign(1.0, tip[0] - scene.box), 0.0])
    if tip[1] > geometry.BOX_HEIGHT + geometry.RADIUS / 2:
        away = np.array([0.0, 1.0])
    for distance in (0.04, 0.08, 0.12, 0.16):
        angles = geometry.inverse(tip + distance * away + [0.0, 0.02], pitch)
        if geometry.is_clear(angles, scene.box, MARGIN):
            return angles
    return raised(scene)


def raised(scene: Scene) -> np.ndarray:
    """Joint angles with the tip above the box's top, above where it is."""
    tip = geometry.tip_position(scene.angles)
    return geometry.inverse(np.array([tip[0], geometry.BOX_HEIGHT + 0.2]), 0.0)


def dense(corners: np.ndarray) -> np.ndarray:
    """Points [N, 3] at equal distances along a path with corners [K, 3]."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0.0, lengths[-1], max(2, int(lengths[-1] / SPACING) + 1))
    return np.stack([np.interp(at, lengths, joint) for joint in corners.T], axis=1)
