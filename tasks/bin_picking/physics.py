"""The scene of the bin: how the arm moves in it, what it holds, and where the objects are.

Contact and friction alone hold an object; nothing is welded.
"""

from __future__ import annotations

import numpy as np
from dm_control.rl.control import PhysicsError

from .. import psm
from ..arm import ArmPhysics
from ..rendering import mujoco
from .geometry import FOAM_DEPTH, place_of
from .instrument import Instrument, slack_after

MOVE_TIME = 0.26  # s, to reach the goal of a control step
SETTLE_TIME = 0.10  # s, before observing
DROP_TIME = 0.24  # s, from one dropped object to the next
REST_TIME = 0.40  # s, after the last

DROP_HEIGHT = 0.020  # m
DROP_CENTRE = np.array([0.0, -0.006])  # m
DROP_SPREAD = np.array([0.001, 0.001])  # m, standard deviations
DROP_TILT = 0.4  # rad, standard deviation of the angle to the horizontal

HELD_HEIGHT = 0.012  # m: an object whose centre of mass is above this does not rest on the bin or its walls
HELD_REACH = 0.030  # m, from the gripper
PAD_HALF_LENGTH = 0.0025  # m


class Physics(ArmPhysics):
    """The scene, with what the task measures in it."""

    move_time = MOVE_TIME
    instrument = Instrument.numbered(0)
    unstable = False
    slack = np.zeros(6)
    motors = np.zeros(6)
    """What the motors were last told, [6]."""

    def reset(self, keyframe_id: int | None = None) -> None:
        """Back to the model's own state."""
        self.unstable = False
        super().reset(keyframe_id)

    @property
    def objects(self) -> int:
        """How many objects there are, in the bin or out of it."""
        names = (self.model.id2name(number, "body") for number in range(self.model.nbody))
        return sum(name.startswith("object_") for name in names)

    def place_arm(self, joints: np.ndarray, jaw: float) -> None:
        """Put the arm at true joints [6] and the jaws at an angle (rad), at rest."""
        self.place_servos(joints, jaw)
        self.slack = np.zeros(6)
        self.motors = self.instrument.motors(joints, self.slack)
        self.forward()  # a step begins with the forces of what was there before

    def place_object(self, number: int, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Put an object at a pose, at rest."""
        name = f"object_{number}"
        self.named.data.qpos[name] = np.concatenate([position, quaternion])
        self.named.data.qvel[name] = 0.0
        self.forward()

    def drop(self, random: np.random.RandomState) -> None:
        """Drop the objects into the bin, one after another, and let them come to rest."""
        for number in range(self.objects):
            at = DROP_CENTRE + DROP_SPREAD * random.standard_normal(2)
            turn, tilt = random.uniform(0.0, np.pi), DROP_TILT * random.standard_normal()
            turning = psm.rotation(2, turn) @ psm.rotation(1, tilt)
            quaternion = np.zeros(4)
            mujoco.wrapper.mjbindings.mjlib.mju_mat2Quat(quaternion, turning.ravel())
            self.place_object(number, np.array([*at, DROP_HEIGHT]), quaternion)
            self.advance(round(DROP_TIME / self.timestep()))
        self.advance(round(REST_TIME / self.timestep()))

    def predicted(self, motors: np.ndarray) -> np.ndarray:
        """True joints [6] after the motors have gone to ``motors`` [6] from where they are."""
        return self.instrument.joints(motors, slack_after(self.slack, motors - self.motors))

    def command(self, joints: np.ndarray) -> np.ndarray:
        """The motors' set points [6] that bring the joints truly to ``joints`` [6] from where they are."""
        return self.instrument.command(joints, self.motors, self.slack)

    def move_to(self, motors: np.ndarray, jaw: float, noise: np.ndarray) -> None:
        """Set the goal of the next control step: motors [6] and the angle between the jaws (rad). Where the
        motors are not finite the arm stays where it was, and the simulation is ``unstable``.

        :param noise: added to the joints [6], by which a move is not quite repeatable.
        """
        if not np.isfinite(motors).all():
            self.unstable = True
            return
        goal = self.predicted(motors) + noise
        self.slack, self.motors = slack_after(self.slack, motors - self.motors), motors.copy()
        self.aim(goal, jaw)

    def advance(self, steps: int) -> None:
        """Simulate time steps; where the simulation breaks down it stays where it was, ``unstable``."""
        if self.unstable:
            return
        before = self.get_state(), self.time()
        try:
            super().advance(steps)
        except PhysicsError:
            with self.suppress_physics_errors():
                self.unstable = True
                self.set_state(before[0])
                self.data.time = before[1]
                self.data.warning.number[:] = 0
                self.forward()

    def encoders(self) -> np.ndarray:
        """Joints [6] as the motors' encoders read them (rad, m)."""
        return self.instrument.motors(self.true_joints(), self.slack)

    def centres(self) -> np.ndarray:
        """The objects' centres of mass [N, 3] (m)."""
        names = [f"object_{number}" for number in range(self.objects)]
        return np.array([self.named.data.subtree_com[name] for name in names]).reshape(-1, 3)

    def held(self) -> frozenset[int]:
        """The objects that the jaws have lifted: those that only other held objects and the jaws hold up."""
        centres = self.centres()
        near = np.linalg.norm(centres - self.gripper().position, axis=1) < HELD_REACH
        return frozenset(np.flatnonzero(near & (centres[:, 2] > HELD_HEIGHT)).tolist())

    def places(self) -> list[str]:
        """Where each object is (:func:`ddco_tasks.bin_picking.geometry.place_of`)."""
        return [place_of(centre) for centre in self.centres()]

    def pressed(self) -> bool:
        """Whether the jaws are in the foam, of the bin or its walls, further than it gives way."""
        gripper = self.gripper().position
        return place_of(gripper) == "bin" and gripper[2] - PAD_HALF_LENGTH < -FOAM_DEPTH

    def gripper_place(self) -> str:
        """Where the gripper is, as for an object."""
        return place_of(self.gripper().position)
