"""Scripted policies of the needle task: the open-loop plan, and the supervisor that corrects it.

The paper's demonstrations came from an open-loop policy of 15 joint-angle way points which a person
interrupted when it was about to fail; the adjustment was recorded as a change of the joint angles and carried
through the rest of the trajectory. Here the person is replaced by a corrector that sees the true state.
"""

from __future__ import annotations

from typing import NamedTuple

import dm_env
import numpy as np

from ddco_pyro.simulation.task import Observation

from .. import psm
from ..planning import plan_path, points_along
from ..psm import Pose
from . import geometry as geometry
from .physics import Physics

JAW_OPEN = 0.42  # rad: leaves 1.6 mm on either side of the wire
JAW_CLOSED = 0.0
# At home the gripper is beside the part of the mat where needles lie, so that the camera sees all of the
# needle.
HOME = psm.inverse(Pose(psm.rotation(2, np.pi / 4), np.array([-0.015, -0.036, 0.040])))

# The 15 way points. Heights are above the needle, standoffs from the phantom's face to the tip (negative:
# outside).
APPROACH_FRACTION = 0.6  # way point 0: this far along the path from home to way point 1
APPROACH_HEIGHTS = (0.015, 0.006, 0.0, 0.0)  # m, way points 1 to 4; the jaws close in the last
LIFT_HEIGHTS = (0.010, 0.022)  # m, way points 5 and 6
TRANSFER_FRACTIONS = (0.35, 0.7)  # way points 7 and 8, along the path to way point 9
STANDOFFS = (-0.012, -0.010, -0.007, -0.004, 0.001, 0.006)  # m, way points 9 to 14
PHASES = {
    "approach": range(0, 3),
    "grasp": range(3, 5),
    "lift": range(5, 7),
    "orient": range(7, 12),
    "insert": range(12, 15),
}
JAWS = np.array([JAW_OPEN] * 4 + [JAW_CLOSED] * 11)
LIFTED = 6  # from this way point on the plan is about the insertion, before it about the grasp

POSITION_TOLERANCE = 0.0003  # m
TURN_TOLERANCE = np.deg2rad(1.0)
# A hand is inexact, the less so the nearer it is to what it aims at: standard deviations of a move.
HAND_POSITION = 0.0004  # m, in each direction
HAND_TURN = np.deg2rad(1.5)
HAND_POSITION_AWAY = 0.12  # more, in m per m that remains to needle or phantom
HAND_TURN_AWAY = 4.0  # rad per m
# m, by step
REMAINING = {1: 0.015, 2: 0.006, 3: 0.0, 8: 0.018, 9: 0.012, 10: 0.010, 11: 0.007, 12: 0.004, 13: 0.0}

CLEARANCE = 0.001  # m, that planned paths keep from mat and phantom
# The target and the phantom's extent, as the planner knows them (m).
TARGET = np.array([0.030, 0.0, 0.012])
PHANTOM = np.array([[0.030, 0.056], [-0.030, 0.030], [0.0, 0.024]])


class Plan(NamedTuple):
    """Way points [15, 7], and the gripper poses at which they grasp and, at the face, insert."""

    way_points: np.ndarray
    grasp: Pose
    insertion: Pose


def make_plan(observation: Observation) -> Plan:
    """The open-loop plan, a function of the first observation; it trusts the encoders and a nominal grip."""
    grasp = geometry.grasp_pose(geometry.lying_needle(observation["needle_ellipse"]))
    insertion = geometry.insertion_pose(geometry.NOMINAL_GRIP, TARGET)
    above = [psm.inverse(raised(grasp, height)) for height in APPROACH_HEIGHTS + LIFT_HEIGHTS]
    into = [psm.inverse(shifted(insertion, np.array([standoff, 0.0, 0.0]))) for standoff in STANDOFFS]
    path = plan_path(HOME, above[0], psm.JOINT_RANGES, is_free)
    approach = points_along(path, np.array([APPROACH_FRACTION]))
    transfer = points_along(
        plan_path(above[-1], into[0], psm.JOINT_RANGES, is_free_with_needle), np.array(TRANSFER_FRACTIONS)
    )
    joints = np.vstack([approach, above, transfer, into])
    return Plan(np.column_stack([joints, JAWS]), grasp, insertion)


def shifted(pose: Pose, offset: np.ndarray) -> Pose:
    """A pose moved by ``offset`` [3] (m) in the world."""
    return Pose(pose.rotation, pose.position + offset)


def raised(pose: Pose, height: float) -> Pose:
    """A pose moved up by ``height`` (m)."""
    return shifted(pose, np.array([0.0, 0.0, height]))


def is_free(joints: np.ndarray) -> bool:
    """Whether the instrument at joints [6] is clear of mat and phantom."""
    gripper = psm.forward(joints)
    return _clear(gripper.apply(INSTRUMENT))


def is_free_with_needle(joints: np.ndarray) -> bool:
    """The same, for an instrument that holds a needle in the nominal grip."""
    gripper = psm.forward(joints)
    return _clear(gripper.apply(np.vstack([INSTRUMENT, NEEDLE])))


def _clear(points: np.ndarray) -> bool:
    in_phantom = np.all((points > PHANTOM[:, 0] - CLEARANCE) & (points < PHANTOM[:, 1] + CLEARANCE), axis=1)
    return not (in_phantom.any() or (points[:, 2] < CLEARANCE).any())


def _instrument_points() -> np.ndarray:
    """Points [N, 3] of the open jaws and the wrist, in the gripper's frame."""
    side = psm.JAW_LENGTH * np.sin(JAW_OPEN / 2)
    jaws = [[x, y, z] for x in (-side, 0.0, side) for y in (-0.0014, 0.0014) for z in (-0.00125, 0.004)]
    wrist = [[x, y, psm.JAW_LENGTH] for x in (-0.0028, 0.0028) for y in (-0.0028, 0.0028)]
    return np.array(jaws + wrist)


def _needle_points() -> np.ndarray:
    """Points [N, 3] of the needle in the nominal grip, in the gripper's frame."""
    angles = np.linspace(-geometry.ARC_HALF_ANGLE, geometry.ARC_HALF_ANGLE, 9)
    circle = np.stack([np.sin(angles), 1.0 - np.cos(angles), np.zeros_like(angles)], axis=1)
    arc = geometry.ARC_RADIUS * circle
    return geometry.NOMINAL_GRIP.apply(arc)


INSTRUMENT = _instrument_points()
NEEDLE = _needle_points()


class OpenLoop:
    """Follows the plan made from the first observation, whatever happens."""

    def __init__(self, environment: dm_env.Environment) -> None:
        del environment  # blind
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget the plan. Nothing here is random."""
        del seed
        self._plan: Plan | None = None
        self._step = -1

    @property
    def annotations(self) -> dict[str, int]:
        """The phase of the step just decided: 0 approach, 1 grasp, 2 lift, 3 orient, 4 insert."""
        return {"phase": next(i for i, steps in enumerate(PHASES.values()) if self._step in steps)}

    def act(self, observation: Observation) -> np.ndarray:
        """The next set points [7]."""
        if self._plan is None:
            self._plan = make_plan(observation)
        self._step += 1
        return self._plan.way_points[self._step].copy()


class Supervisor(OpenLoop):
    """The open-loop plan with corrections that are carried through the rest of the trajectory.

    Before a step of the approach or of the insertion it predicts where the next way point would really bring
    the gripper, and compares with where the plan meant it to be relative to the true needle. If they differ
    by more than a small tolerance it changes the joint angles by what removes the difference. The jaws are
    not corrected.

    As with a person, what it does is coarser than what it means to do, far away more so than near the aim.
    ``intended`` is the control it meant, and is what is recorded: demonstrations show how to come back from
    an inexact move without teaching the inexactness (noise while executing with clean labels).
    """

    def __init__(self, environment: dm_env.Environment) -> None:
        super().__init__(environment)
        self._physics: Physics = environment.physics

    def reset(self, seed: int) -> None:
        """Forget plan and corrections; ``seed`` decides how inexact the moves are."""
        super().reset(seed)
        self._delta = np.zeros(6)
        self.intended = np.zeros(7)
        self._hand = np.random.default_rng(seed)

    def act(self, observation: Observation) -> np.ndarray:
        """The next set points [7]."""
        action = super().act(observation)
        planned = action[:6].copy()
        self.intended = action.copy()
        if self._step in REMAINING and (self._step < LIFTED or self._physics.held()):
            wanted = self._wanted(psm.forward(planned))
            if differs(psm.forward(psm.true_joints(planned + self._delta)), wanted):
                self._delta = psm.encoder_readings(psm.inverse(wanted)) - planned
            action[:6] = psm.encoder_readings(psm.inverse(self._by_hand(wanted)))
        else:
            action[:6] = planned + self._delta
        self.intended[:6] = planned + self._delta
        return action

    def _by_hand(self, wanted: Pose) -> Pose:
        """The gripper pose that a person achieves who wants another one."""
        remaining = REMAINING[self._step]
        turn = (HAND_TURN + HAND_TURN_AWAY * remaining) * self._hand.standard_normal()
        offset = (HAND_POSITION + HAND_POSITION_AWAY * remaining) * self._hand.standard_normal(3)
        return Pose(psm.rotation(2, turn) @ wanted.rotation, wanted.position + offset)

    def _wanted(self, believed: Pose) -> Pose:
        """Where the gripper should truly be at a way point that the plan believes to be at ``believed``.

        The way point keeps its place relative to the plan's grasp or insertion, but these are made true ones.
        """
        plan = self._plan
        assert plan is not None
        if self._step < LIFTED:
            nominal, true = plan.grasp, geometry.grasp_pose(self._physics.needle())
        else:
            nominal, true = plan.insertion, geometry.insertion_pose(self._physics.grip(), TARGET)
        turn = true.rotation @ nominal.rotation.T
        return Pose(turn @ believed.rotation, true.position + believed.position - nominal.position)


def differs(pose: Pose, wanted: Pose) -> bool:
    """Whether two gripper poses are further apart than an operator would let pass."""
    turn = np.linalg.norm(psm.rotation_vector(pose.rotation.T @ wanted.rotation))
    return bool(np.linalg.norm(pose.position - wanted.position) > POSITION_TOLERANCE or turn > TURN_TOLERANCE)
