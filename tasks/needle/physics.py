"""The scene of the needle task: what is measured in it, and what grip and phantom do to the needle.

The jaws really close on the needle, by contact. Contact alone would hold a steel wire between flat pads
either rigidly or not at all, so once both pads press on it a weld takes over, in a pose that is *deflected*
from the one in which the needle was caught. The phantom stops a needle that meets it at a flat angle and lets
another one in.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .. import psm
from ..arm import ArmPhysics
from ..rendering import mujoco
from . import geometry as geometry

MOVE_TIME = 0.30  # s, to reach the goal of a control step
SETTLE_TIME = 0.16  # s, before observing

GRIP_FORCE = 0.05  # N on each pad: the least that makes a grasp
CLOSED = 0.20  # rad: the needle can be held while the jaws are told to be closer than this

# In-hand deflection when the jaws close, about the gripper's axis (turn) and about the pads' normal (tilt).
# It grows with the distance of the grasp from the middle of the arc and with the angle between pads and wire.
TURN_PER_OFFSET = 35.0  # rad per m
TURN_PER_ANGLE = 0.8
TILT_PER_OFFSET = 10.0  # rad per m

PIERCE_ANGLE = np.deg2rad(35.0)  # a tip that meets the phantom at a flatter angle slides off
PIERCE_REACH = 0.0008  # m: the axis of the tip is this near to the face when its round end touches
PADS = ("pad_left", "pad_right")
PAD_BITS = 2  # the contact bits in the model
PHANTOM_BITS = 4


@dataclass
class Events:
    """What has happened in the episode so far."""

    grasped: bool = False
    entry: np.ndarray | None = None  # [2]: y, z (m) where the tip went into the phantom
    # Where on the wire (m) and at which angle (rad) the jaws were when they began to close.
    catch: np.ndarray = field(default_factory=lambda: np.zeros(2))


class Physics(ArmPhysics):
    """The scene, with what the task measures in it."""

    move_time = MOVE_TIME
    events = Events()
    deflection = np.zeros(2)  # rad: the part of turn and tilt that nothing predicts

    def reset(self, keyframe_id: int | None = None) -> None:
        """Back to the model's own state: nothing held, nothing pierced."""
        self.events = Events()
        self.named.model.geom_conaffinity[list(PADS)] = PAD_BITS
        self.named.model.geom_conaffinity["phantom"] = PHANTOM_BITS
        super().reset(keyframe_id)

    def place(self, joints: np.ndarray, jaw: float, needle: psm.Pose) -> None:
        """Put the arm at true joints [6] and the jaws at an angle (rad), at rest, and lay down the needle."""
        angle = np.arctan2(needle.rotation[1, 0], needle.rotation[0, 0])
        self.named.data.qpos["needle"] = [*needle.position, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]
        self.place_servos(joints, jaw)

    def move_to(self, joints: np.ndarray, jaw: float) -> None:
        """Set the goal of the next control step: true joints [6] and the angle between the jaws (rad)."""
        if self.held() and jaw < CLOSED:
            jaw = 2 * self._to[7]  # still stalled on the needle
        if self.held() and jaw >= CLOSED:
            self._release()
        if not self.held():
            self.events.catch = self._catch()
        self.aim(joints, jaw)

    def advance(self, steps: int) -> None:
        """Simulate time steps; see whether jaws now hold the needle and whether the phantom lets it in."""
        super().advance(steps)
        self._try_grip()
        self._try_pierce()

    def encoders(self) -> np.ndarray:
        """Joints [6] as the encoders read them (rad, m)."""
        return psm.encoder_readings(self.true_joints())

    def tip(self) -> psm.Pose:
        """The needle's tip: x points where the needle does."""
        return self.site("needle_tip")

    def needle(self) -> psm.Pose:
        """The needle's true pose: origin in the middle of the arc, x along the wire towards the tip."""
        data = self.named.data
        return psm.Pose(np.array(data.xmat["needle"]).reshape(3, 3), np.array(data.xpos["needle"]))

    def grip(self) -> psm.Pose:
        """The needle in the gripper's frame."""
        return self.gripper().inverse() @ self.needle()

    def target(self) -> np.ndarray:
        """The centre of the target region [3] (m); its face looks towards -x."""
        return self.site("target").position

    def held(self) -> bool:
        """Whether the jaws hold the needle."""
        return bool(self.data.eq_active[self.model.name2id("grip", "equality")])

    def depth(self) -> float:
        """How far the tip is in the phantom (m); 0 where it did not go in."""
        return 0.0 if self.events.entry is None else float(self.tip().position[0] - self.target()[0])

    def pad_forces(self) -> np.ndarray:
        """Normal force of the needle on the left and the right pad [2] (N)."""
        pads = [self.model.name2id(name, "geom") for name in PADS]
        forces = np.zeros(2)
        for index, contact in enumerate(self.data.contact):
            for side, pad in enumerate(pads):
                if pad in (contact.geom1, contact.geom2):
                    forces[side] += self.data.contact_force(index)[0, 0]
        return forces

    def _catch(self) -> np.ndarray:
        """Where the gripper is on the needle: place along the wire (m), angle from pads to wire (rad)."""
        grip = self.grip()
        offset = geometry.arc_coordinate(grip.inverse().position)
        wire = grip.rotation @ geometry.arc_tangent(offset)
        return np.array([offset, np.arctan2(wire[0], -wire[1])])

    def _try_grip(self) -> None:
        """Hold the needle if the jaws are told to close, and both pads press on it at rest."""
        closing = 2 * self._to[7] < CLOSED and np.array_equal(self.control(), self._to)
        if closing and not self.held() and np.all(self.pad_forces() > GRIP_FORCE):
            deflected = self._deflected(self.grip())
            # the pads, from the gripper's body
            wrist = psm.Pose(np.eye(3), np.array([0.0, 0.0, -psm.JAW_LENGTH]))
            self._weld("grip", wrist @ deflected)
            self.named.model.geom_conaffinity[list(PADS)] = 0
            self._to[6:] = self.jaw() / 2  # the servos stall on the needle
            self.events.grasped = True

    def _release(self) -> None:
        """Let go of the needle; the phantom keeps one that is in it."""
        self.data.eq_active[self.model.name2id("grip", "equality")] = 0
        self.named.model.geom_conaffinity[list(PADS)] = PAD_BITS
        if self.events.entry is not None:
            phantom = psm.Pose(np.eye(3), np.array(self.named.data.xpos["phantom"]))
            self._weld("phantom", phantom.inverse() @ self.needle())

    def _weld(self, name: str, pose: psm.Pose) -> None:
        """Hold the needle at ``pose`` in the frame of the weld's first body."""
        weld = self.model.name2id(name, "equality")
        quaternion = np.zeros(4)
        mujoco.wrapper.mjbindings.mjlib.mju_mat2Quat(quaternion, pose.rotation.ravel())
        self.model.eq_data[weld, :10] = [0.0, 0.0, 0.0, *pose.position, *quaternion]
        self.data.eq_active[weld] = 1

    def _deflected(self, grip: psm.Pose) -> psm.Pose:
        """The needle in the gripper's frame after it has been deflected from ``grip`` by closing jaws."""
        offset, angle = self.events.catch
        turn = TURN_PER_OFFSET * offset + TURN_PER_ANGLE * angle + self.deflection[0]
        tilt = TILT_PER_OFFSET * offset + self.deflection[1]
        caught = grip.inverse().position  # the gripper, in the needle's frame
        pivot = grip.apply(caught)
        rotated = psm.rotation(2, turn) @ psm.rotation(0, tilt)
        return psm.Pose(rotated @ grip.rotation, pivot + rotated @ (grip.position - pivot))

    def _try_pierce(self) -> None:
        """Let the needle into the phantom if its tip touches the face steeply enough."""
        tip = self.tip()
        half = np.array(self.named.model.geom_size["phantom"])
        inside = self.target()[0] - PIERCE_REACH <= tip.position[0]
        on_face = np.all(np.abs(tip.position - self.target())[1:] < half[1:])
        if self.events.entry is None and inside and on_face and tip.rotation[0, 0] > np.cos(PIERCE_ANGLE):
            self.events.entry = tip.position[1:]
            self.named.model.geom_conaffinity["phantom"] = 0
