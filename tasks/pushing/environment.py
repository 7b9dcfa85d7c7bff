"""Planar pushing: a 3-link arm pushes a box along a surface to goals left and right without toppling it.

After the paper's simulation (§5.1, SM 1.1), in MuJoCo instead of Box2D: links of 5, 5 and 3 units (0.1 m
each) in the vertical plane, controlled by joint velocities; a box with friction and gravity; as many goals as
possible in 2000 steps of 50 ms. The box is 0.16 m wide and 0.25 m high; a push higher than half its width
over the friction coefficient, 0.2 m, topples it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import dm_env
import numpy as np
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from ddco_pyro.simulation.cameras import Camera
from ddco_pyro.simulation.task import Kind, Task

from ..rendering import render
from . import geometry as geometry
from . import supervisor
from .physics import Physics

HERE = Path(__file__).parent
STEPS = 2000  # control steps in an episode (paper §5.1)
GOAL_STEPS = 250  # control steps that one goal may take, where that is limited
SUB_STEPS = 20  # of 2.5 ms in a control step

EXTENT = 0.45  # m: goals and boxes are put at |x| up to this
MIN_DISTANCE = 0.2  # m: from the box to a new goal, or from the goal to a box that is put back
OUT_OF_REACH = 0.55  # m: the arm cannot get behind a box that is further out
RAISED = geometry.inverse(np.array([0.0, 0.6]), 0.0)  # rad: an arm that is in no box's way
START_CLEARANCE = 0.02  # m, between arm and box
START_PITCH = 0.4  # rad: half width of the uniform distribution of the hand's first pitch
START_X, START_HEIGHT = (-0.6, 0.6), (0.08, 0.6)  # m: where the tip is at first

POSITION_TOLERANCE = 0.03  # m
TILT_TOLERANCE = 0.1  # rad
REST_SPEED = 0.02  # m/s
TOPPLED = np.pi / 4  # rad

FRAME_SIZE = (240, 320)
CAMERA_SIZE = (480, 640)  # of the observed pictures (paper §5.1)
SHARED_SOURCES = ("planning.py", "rendering.py")


@dataclass
class Counts:
    """What has happened in the episode so far."""

    goals: int = 0
    topples: int = 0
    lost: int = 0
    missed: int = 0


class Pushing(base.Task):
    """Starts, observes and rewards an episode.

    :param goal_steps: steps after which a goal is missed, and box and goal are drawn anew; None for no limit.
    :param single: the episode is about one goal, until that is reached or missed, or the box is put back.
    """

    def __init__(
        self, goal_steps: int | None = None, single: bool = False, random: int | None = None
    ) -> None:
        super().__init__(random=random)
        self._goal_steps, self._single = goal_steps, single
        self.counts = Counts()

    @property
    def limited(self) -> bool:
        """Whether a goal has to be reached in a number of steps."""
        return self._goal_steps is not None

    def initialize_episode(self, physics: Physics) -> None:
        """Box and goal anywhere, apart; the arm's tip anywhere that is clear of the box."""
        self.counts = Counts()
        self._steps = 0
        self._reward = 0.0
        physics.place_arm(RAISED)
        self._draw_box_and_goal(physics)
        physics.place_arm(self._clear_angles(physics.box()[0]))
        # The base class would call after_step, for colours that are not used here; this one's counts.

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Joint velocities [3] (rad/s); the servos saturate at the limits."""
        del physics
        name, most = "shoulder,elbow,wrist", geometry.MAX_SPEED
        return specs.BoundedArray((3,), float, -most, most, name=name)

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Send the joint velocities to the servos, which saturate at their limits."""
        physics.set_velocities(np.clip(np.asarray(action, float), -geometry.MAX_SPEED, geometry.MAX_SPEED))

    def after_step(self, physics: Physics) -> None:
        """Count what became of the goal."""
        before = self.counts.goals
        self._steps += 1
        self._since += 1
        if self._decided(physics):
            physics.forward()  # things were put somewhere else
        self._reward = float(self.counts.goals - before)

    def _decided(self, physics: Physics) -> bool:
        """Whether something became of the goal; if so, box and goal are put where next steps need them."""
        x, _, tilt = physics.box()
        if is_reached(physics):
            self.counts.goals += 1
            self._place_goal(physics, -self._side)
        elif abs(tilt) > TOPPLED:
            self.counts.topples += 1
            self._put_back(physics)
        elif abs(x) > OUT_OF_REACH:
            self.counts.lost += 1
            self._put_back(physics)
        elif self._goal_steps is not None and self._since >= self._goal_steps:
            self.counts.missed += 1
            self._draw_box_and_goal(physics)
        else:
            return False
        return True

    def get_observation(self, physics: Physics) -> OrderedDict[str, np.ndarray]:
        """The state, in the paper's coordinates and relative to tip and box.

        ``joint_angles`` [3] (rad), ``joint_velocities`` [3] (rad/s), ``box_pose`` [3]: x, z (m), tilt (rad),
        ``goal`` [1]: x (m); ``tip`` [2]: x, z (m); ``box_from_tip`` [2]: from the tip to the box's centre
        (m); ``goal_from_box`` [1] and ``goal_from_tip`` [1]: along x (m).
        """
        box, tip, goal = physics.box(), physics.tip(), physics.goal()
        observation = OrderedDict()
        observation["joint_angles"] = physics.joint_angles()
        observation["joint_velocities"] = physics.joint_velocities()
        observation["box_pose"] = box
        observation["goal"] = np.array([goal])
        observation["tip"] = tip
        observation["box_from_tip"] = box[:2] - tip
        observation["goal_from_box"] = np.array([goal - box[0]])
        observation["goal_from_tip"] = np.array([goal - tip[0]])
        return observation

    def get_reward(self, physics: Physics) -> float:
        """1 at a step in which a goal is reached, otherwise 0."""
        del physics
        return self._reward

    def get_termination(self, physics: Physics) -> float | None:
        """The episode ends after its steps; one about a single goal ends when that is decided."""
        del physics
        counts = self.counts
        decided = counts.goals + counts.topples + counts.lost + counts.missed > 0
        return 0.0 if self._steps == STEPS or (self._single and decided) else None

    def _draw_box_and_goal(self, physics: Physics) -> None:
        side = self.random.choice([-1, 1])
        physics.place_box(self._clear_place(physics, -side * EXTENT, side * (EXTENT - MIN_DISTANCE)))
        self._place_goal(physics, side)

    def _place_goal(self, physics: Physics, side: int) -> None:
        """A new goal to the left (-1) or right (1) of the box; goals reached in turn are on alternate sides.

        A box at rest at a goal on one side has room on the other, but for the goal's tolerance.
        """
        box = physics.box()[0]
        farthest = max(EXTENT - side * box, MIN_DISTANCE)
        physics.place_goal(box + side * self.random.uniform(MIN_DISTANCE, farthest))
        self._side, self._since = side, 0

    def _put_back(self, physics: Physics) -> None:
        """The box upright somewhere else, at a distance from its goal that stays."""
        goal = physics.goal()
        room = {side: EXTENT - side * goal - MIN_DISTANCE for side in (-1, 1)}  # on either side of the goal
        sides = [side for side in room if room[side] > 0.0]
        side = sides[self.random.randint(len(sides))]
        physics.place_box(self._clear_place(physics, goal + side * MIN_DISTANCE, side * EXTENT))
        self._side = -side

    def _clear_place(self, physics: Physics, one: float, other: float) -> float:
        """A place for the box between two, clear of the arm if the arm leaves any."""
        for _ in range(100):
            place = self.random.uniform(*sorted((one, other)))
            if geometry.is_clear(physics.joint_angles(), place, START_CLEARANCE):
                break
        return float(place)

    def _clear_angles(self, box: float) -> np.ndarray:
        """Joint angles with the tip anywhere that is clear of the box."""
        while True:
            tip = np.array([self.random.uniform(*START_X), self.random.uniform(*START_HEIGHT)])
            pitch = START_PITCH * self.random.uniform(-1.0, 1.0)
            angles = geometry.inverse(tip, pitch)
            if geometry.is_clear(angles, box, START_CLEARANCE):
                return angles


def is_reached(physics: Physics) -> bool:
    """Whether the box rests upright at its goal."""
    x, _, tilt = physics.box()
    at_goal = abs(physics.goal() - x) < POSITION_TOLERANCE
    return bool(at_goal and abs(tilt) < TILT_TOLERANCE and physics.box_speed() < REST_SPEED)


class Environment(control.Environment):
    """A dm-control environment that frees its simulation and renderer when closed."""

    def close(self) -> None:
        """Free the simulation; the environment cannot be used afterwards."""
        self.physics.free()


def outcome(environment: dm_env.Environment) -> dict[str, float]:
    """The counts of the episode: ``goals`` reached, ``topples``, boxes pushed out of reach (``lost``), goals
    ``missed`` (NaN without a limit), and ``success``: at least one goal was reached.
    """
    counts: Counts = environment.task.counts
    return {
        "success": float(counts.goals > 0),
        "goals": float(counts.goals),
        "topples": float(counts.topples),
        "lost": float(counts.lost),
        "missed": float(counts.missed) if environment.task.limited else np.nan,
    }


def frame(environment: dm_env.Environment) -> np.ndarray:
    """The scene from the side, uint8 [240, 320, 3]."""
    return render(environment.physics, "side", *FRAME_SIZE)


def camera(height: int, width: int) -> Camera:
    """The scene from the side: arm, box and goal, and nothing else that tells the state."""
    return Camera((height, width), lambda environment: render(environment.physics, "side", height, width))


def load(seed: int) -> Environment:
    """2000 steps, however long a goal takes."""
    return _load(Pushing(random=seed))


def load_single(seed: int) -> Environment:
    """One goal, which may take 250 steps: what a demonstration is."""
    return _load(Pushing(GOAL_STEPS, single=True, random=seed))


def load_limited(seed: int) -> Environment:
    """2000 steps, at most 250 of them for each goal: one trap does not decide the episode."""
    return _load(Pushing(GOAL_STEPS, random=seed))


def _load(task: Pushing) -> Environment:
    return Environment(Physics.from_xml_path(str(HERE / "pushing.xml")), task, n_sub_steps=SUB_STEPS)


MEASURES: dict[str, Kind] = {"success": "rate", "goals": "mean"}
MEASURES |= {"topples": "mean", "lost": "mean", "missed": "mean"}


def _task(name: str, load: Callable[[int], Environment], steps: int) -> Task:
    shared = (HERE.parent / name for name in SHARED_SOURCES)
    sources = (HERE / "pushing.xml", *sorted(HERE.glob("*.py")), *shared)
    cameras = {"camera": camera(*CAMERA_SIZE)}
    return Task(name, load, supervisor.POLICIES, outcome, frame, sources, steps, MEASURES, cameras)


task = _task("pushing", load, STEPS)
single = _task("pushing_goal", load_single, GOAL_STEPS)
limited = _task("pushing_limit", load_limited, STEPS)
