"""Scripted policies of bin picking: the open-loop plan of a trial, and the supervisor that corrects it.

The paper's demonstrations came from an open-loop policy that a person interrupted when it was about to fail;
the adjustment was carried on. A key let the robot stop in place and drop what it held where that was nothing
or several objects. Here the person is replaced by a corrector that sees the true state.
"""

from __future__ import annotations

from typing import NamedTuple

import dm_env
import numpy as np

from ddco_pyro.simulation.task import Observation

from .. import psm
from ..psm import Pose
from .geometry import CUPS, GRASP_HEIGHT, NEUTRAL_TURN, RETURNING, SHOWING, SHOWN_TURN, lying_at, upright
from .objects import ACCEPTED, KINDS, UNSEEN
from .physics import Physics

JAW_OPEN = 1.25  # rad, between the jaws: 12 mm between the pads
OVER_CUP = 0.026  # m, the gripper's height where it lets go
CARRY_HEIGHT = 0.038  # m
APPROACH_HEIGHTS = (0.025, 0.009, 0.0)  # m above the grasp, way points 0 to 2; the jaws close in the next
LIFT_HEIGHT = 0.028  # m
HALFWAY = 0.5  # of the way from the showing place to the cup, way point 6

PHASES = ("approach", "grasp", "show", "recover", "carry", "release")
KNOWN = 6  # from this step of a trial on the person has seen what is held


class WayPoint(NamedTuple):
    """A gripper pose, whether jaws are open there, and by how much (m) it may be missed uncorrected."""

    pose: Pose
    open: bool
    tolerance: float


NEAR, FAR = 0.0004, 0.0015  # m: tolerances at the grasp and elsewhere
TURN_TOLERANCE = np.deg2rad(2.0)
# A hand is inexact, the less so the nearer it is to what it aims at: standard deviations of a move.
HAND_POSITION = {NEAR: 0.0004, FAR: 0.0010}  # m, in each direction
HAND_HEIGHT_PART = 0.1  # more, in m per m that the gripper is above the grasp
HAND_TURN = np.deg2rad(2.0)  # about each axis


def grasp_plan(grasp: np.ndarray) -> list[WayPoint]:
    """The first six way points of a trial: onto the candidate ``grasp`` [6], close, lift, show."""
    at, turn = lying_at(grasp[:2]), float(np.arctan2(grasp[5], grasp[4]))

    def over(height: float, is_open: bool, tolerance: float) -> WayPoint:
        return WayPoint(upright(turn, np.array([at[0], at[1], GRASP_HEIGHT + height])), is_open, tolerance)

    approach = [over(height, True, FAR if height > 0.01 else NEAR) for height in APPROACH_HEIGHTS]
    showing = WayPoint(upright(SHOWN_TURN, SHOWING), False, FAR)
    return [*approach, over(0.0, False, NEAR), over(LIFT_HEIGHT, False, FAR), showing]


def cup_plan(cup: str) -> list[WayPoint]:
    """The last four: towards the cup, over it, down, and open."""
    middle = CUPS[cup]
    between = SHOWING[:2] + HALFWAY * (middle - SHOWING[:2])
    places = [(between, CARRY_HEIGHT), (middle, CARRY_HEIGHT), (middle, OVER_CUP), (middle, OVER_CUP)]
    poses = [upright(NEUTRAL_TURN, np.array([*at, height])) for at, height in places]
    return [WayPoint(pose, number == 3, FAR) for number, pose in enumerate(poses)]


RECOVERY = [WayPoint(upright(SHOWN_TURN, RETURNING), is_open, FAR) for is_open in (False, True)]
"""What ends a trial in which nothing or several objects are held: back over the bin, where the jaws open."""


class OpenLoop:
    """Follows the plan made from each trial's candidate, and takes everything to the accept cup."""

    def __init__(self, environment: dm_env.Environment) -> None:
        del environment  # blind
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget the plan. Nothing here is random."""
        del seed
        self._plan: list[WayPoint] = []
        self._step = -1

    @property
    def annotations(self) -> dict[str, int]:
        """The phase of the step just decided: 0 approach, 1 grasp, 2 show, 3 recover, 4 carry, 5 release."""
        if self._step < KNOWN:
            return {"phase": (0, 0, 0, 1, 2, 2)[self._step]}
        if len(self._plan) == KNOWN + len(RECOVERY):
            return {"phase": PHASES.index("recover")}
        return {"phase": PHASES.index("release" if self._step == len(self._plan) - 1 else "carry")}

    def act(self, observation: Observation) -> np.ndarray:
        """The next set points [7]."""
        self._follow(observation)
        return np.append(self._planned(), self._plan[self._step].open)

    def _follow(self, observation: Observation) -> None:
        """Go on to the next way point, of the next trial where this one is over."""
        self._step += 1
        if self._step == KNOWN:
            self._plan = self._plan[:KNOWN] + self._rest()
        elif self._step >= len(self._plan):
            self._step, self._plan = 0, grasp_plan(observation["grasp"])

    def _rest(self) -> list[WayPoint]:
        return cup_plan("accept")

    def _planned(self) -> np.ndarray:
        """The way point's joints [6], as if the motors were where the joints are."""
        return psm.inverse(self._plan[self._step].pose)


class Supervisor(OpenLoop):
    """The open-loop plan with corrections that are carried on, and with recovery.

    Before each step it predicts where the next way point would really bring the gripper. Where that is
    further from the way point than an operator would let pass, it changes the motors' set points by what
    removes the difference, from here on. What it holds decides what follows: one object is carried to its
    cup; with none or several the arm goes back over the bin and the jaws open, and the next trial starts from
    there.

    As with a person, what it does is coarser than what it means to do. ``intended`` is the control it meant,
    which is recorded: demonstrations show how to come back from an inexact move without teaching the
    inexactness.
    """

    def __init__(self, environment: dm_env.Environment) -> None:
        super().__init__(environment)
        self._physics: Physics = environment.physics
        self._task = environment.task
        self._kinds: list[str] = environment.task.trials.kinds
        self._held: frozenset[int] = frozenset()

    def reset(self, seed: int) -> None:
        """Forget plan and corrections; ``seed`` decides how inexact the moves are."""
        super().reset(seed)
        self._correction = np.zeros(6)
        self.intended = np.zeros(7)
        self._hand = np.random.default_rng(seed)

    def act(self, observation: Observation) -> np.ndarray:
        """The next set points [7]."""
        self._held = self._physics.held()
        self._follow(observation)
        way_point, planned = self._plan[self._step], self._planned()
        reached = psm.forward(self._physics.predicted(planned + self._correction))
        if _differs(reached, way_point):
            self._correction = self._physics.command(psm.inverse(way_point.pose)) - planned
        self.intended = np.append(planned + self._correction, way_point.open)
        return np.append(self._physics.command(psm.inverse(self._by_hand(way_point))), way_point.open)

    @property
    def annotations(self) -> dict[str, int]:
        """Besides the phase, before the step just decided: how many objects were ``held``, the ``kind`` of a
        single one (-1 otherwise), and how many were ``left`` in the bin when the trial began.
        """
        kind = (KINDS + UNSEEN).index(self._kinds[min(self._held)]) if len(self._held) == 1 else -1
        own = {"held": len(self._held), "kind": kind, "left": len(self._task.remaining)}
        return super().annotations | own

    def _rest(self) -> list[WayPoint]:
        if len(self._held) != 1:
            return RECOVERY
        return cup_plan("accept" if self._kinds[min(self._held)] == ACCEPTED else "reject")

    def _by_hand(self, way_point: WayPoint) -> Pose:
        """The gripper pose that a person achieves who wants another one."""
        height = max(0.0, way_point.pose.position[2] - GRASP_HEIGHT)
        far = HAND_HEIGHT_PART * height * (way_point.tolerance == NEAR)
        spread = HAND_POSITION[way_point.tolerance] + far
        x, y, z = HAND_TURN * self._hand.standard_normal(3)
        turn = psm.rotation(0, x) @ psm.rotation(1, y) @ psm.rotation(2, z)
        offset = spread * self._hand.standard_normal(3)
        return Pose(turn @ way_point.pose.rotation, way_point.pose.position + offset)


def _differs(pose: Pose, way_point: WayPoint) -> bool:
    turn = np.linalg.norm(psm.rotation_vector(pose.rotation.T @ way_point.pose.rotation))
    missed = np.linalg.norm(pose.position - way_point.pose.position)
    return bool(missed > way_point.tolerance or turn > TURN_TOLERANCE)
