"""Needle insertion: grasp a suturing needle, turn it towards a tissue phantom, insert it into a 1 cm target.

After the paper's first physical experiment (Physical Experiment 1 and SM 1.3). A da Vinci-like arm with
inexact encoders has 15 control steps; in each it is given six joint angles and a jaw angle, moves there and
settles. It is seen through its encoders and through a camera 650 mm above the mat. Simulated lengths are
metres; what is observed is in millimetres.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import dm_env
import numpy as np
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from ddco_pyro.simulation.task import Task

from .. import psm, vision
from ..rendering import render
from . import supervisor
from .geometry import MIDDLE_HEADING, WIRE_RADIUS
from .physics import MOVE_TIME, SETTLE_TIME, Physics

HERE = Path(__file__).parent
STEPS = 15  # control steps in an episode
JAW_RANGE = (0.0, 0.6)  # rad, between the jaws

START_CENTRE = np.array([-0.018, 0.004])  # m: mean position of the middle of the needle's arc
START_SPREAD = np.array([0.012, 0.012])  # m: half widths of the uniform distribution about it
# half width about the heading that would bring the tip straight into the phantom
START_TURN = np.deg2rad(30.0)

# What differs from episode to episode besides the needle's pose; standard deviations.
REPEATABILITY = np.array([6e-4, 6e-4, 1e-4, 2e-3, 2e-3, 2e-3])  # rad, m: under 0.2 mm at the gripper
DEFLECTION = np.deg2rad([7.0, 1.5])  # turn and tilt of the needle in the hand that nothing predicts

INSERTED_DEPTH = 0.003  # m
TARGET_RADIUS = 0.005  # m
FRAME_SIZE = (360, 480)
SHARED_SOURCES = ("arm.py", "planning.py", "psm.py", "rendering.py", "vision.py")


class NeedleInsertion(base.Task):
    """Starts, observes and rewards an episode."""

    def initialize_episode(self, physics: Physics) -> None:
        """The gripper at home with open jaws, the needle on the mat in a random pose."""
        position = START_CENTRE + START_SPREAD * self.random.uniform(-1.0, 1.0, 2)
        heading = MIDDLE_HEADING + START_TURN * self.random.uniform(-1.0, 1.0)
        physics.deflection = DEFLECTION * self.random.standard_normal(2)
        needle = psm.Pose(psm.rotation(2, heading), np.array([*position, WIRE_RADIUS]))
        physics.place(psm.true_joints(supervisor.HOME), supervisor.JAW_OPEN, needle)
        self._ellipse = np.zeros(6)
        self._steps = 0
        super().initialize_episode(physics)

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Set points [7] for what the encoders read: six joints (rad, insertion in m), jaw (rad)."""
        del physics
        limits = np.vstack([psm.JOINT_RANGES, JAW_RANGE])
        name = ",".join((*psm.JOINTS, "jaw"))
        return specs.BoundedArray((7,), float, limits[:, 0], limits[:, 1], name=name)

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Send the arm to where the encoders will read ``action`` [7], within the joints' limits."""
        spec = self.action_spec(physics)
        action = np.clip(np.asarray(action, float), spec.minimum, spec.maximum)
        noise = REPEATABILITY * self.random.standard_normal(6)
        physics.move_to(psm.true_joints(action[:6]) + noise, float(action[6]))
        self._steps += 1

    def get_observation(self, physics: Physics) -> OrderedDict[str, np.ndarray]:
        """What encoders and camera tell.

        ``gripper_pose`` [6]: position (mm) and rotation vector (rad) as the encoders give them, with
        kinematic error; ``jaw`` [1] (rad); ``needle_ellipse`` [6]: see :func:`ddco_tasks.vision.ellipse`.
        While too little of the needle is in view its last ellipse stays.
        """
        reported = psm.forward(physics.encoders())
        image = render(physics, "endoscope", vision.IMAGE_SIZE, vision.IMAGE_SIZE)
        seen = vision.ellipse(image)
        if seen is not None:
            self._ellipse = seen
        observation = OrderedDict()
        pose = [reported.position * 1e3, psm.rotation_vector(reported.rotation)]
        observation["gripper_pose"] = np.concatenate(pose)
        observation["jaw"] = np.array([physics.jaw()])
        observation["needle_ellipse"] = self._ellipse.copy()
        return observation

    def get_reward(self, physics: Physics) -> float:
        """1 at the end of a successful episode, otherwise 0."""
        return measures(physics)["success"] if self._steps == STEPS else 0.0

    def get_termination(self, physics: Physics) -> float | None:
        """The episode ends after its 15 control steps."""
        del physics
        return 0.0 if self._steps == STEPS else None


class Environment(control.Environment):
    """A dm-control environment that frees its simulation and renderer when closed."""

    def close(self) -> None:
        """Free the simulation; the environment cannot be used afterwards."""
        self.physics.free()


def measures(physics: Physics) -> dict[str, float]:
    """How the episode stands: ``grasped``, ``inserted``, ``success`` (0 or 1) and ``accuracy_mm``.

    ``grasped``: the needle was held at some time; ``inserted``: its tip is 3 mm deep in the phantom, anywhere
    (NaN where it never was grasped); ``success``: it went in within the 1 cm target region; ``accuracy_mm``:
    from the centre of the target to where the tip went in (NaN where it is not in).
    """
    grasped = physics.events.grasped
    inserted = grasped and physics.events.entry is not None and physics.depth() >= INSERTED_DEPTH
    miss = float(np.linalg.norm(physics.events.entry - physics.target()[1:])) if inserted else np.nan
    return {
        "grasped": float(grasped),
        "inserted": float(inserted) if grasped else np.nan,
        "success": float(inserted and miss <= TARGET_RADIUS),
        "accuracy_mm": 1e3 * miss,
    }


def outcome(environment: dm_env.Environment) -> dict[str, float]:
    """The measures of the episode that just ended."""
    return measures(environment.physics)


def frame(environment: dm_env.Environment) -> np.ndarray:
    """The scene in perspective, uint8 [360, 480, 3]."""
    return render(environment.physics, "overview", *FRAME_SIZE)


def load(seed: int) -> Environment:
    """A fresh environment whose episodes depend on the seed alone."""
    physics = Physics.from_xml_path(str(HERE / "needle.xml"))
    sub_steps = round((MOVE_TIME + SETTLE_TIME) / physics.timestep())
    return Environment(physics, NeedleInsertion(random=seed), n_sub_steps=sub_steps)


SHARED = [HERE.parent / name for name in SHARED_SOURCES]
task = Task(
    name="needle",
    load=load,
    policies={"open_loop": supervisor.OpenLoop, "supervisor": supervisor.Supervisor},
    outcome=outcome,
    frame=frame,
    steps=STEPS,
    measures={"grasped": "rate", "inserted": "rate", "success": "rate", "accuracy_mm": "mean"},
    sources=(HERE / "needle.xml", *sorted(HERE.glob("*.py")), *SHARED),
)
