"""Pushing whose goal is shown once: the box comes long after the goal has gone out of sight.

For a quarter of a second the goal is seen, on the left or on the right, while the arm goes home, above the
middle. Two to three seconds later a box comes to the middle, and has to be pushed over the line on the goal's
side. Until then arm and box move alike whichever side it is: what is seen after the cue does not tell the
goal.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import dm_env
import numpy as np

from ddco_pyro.simulation.task import Observation, Policy, Task

from . import environment as environment
from . import geometry as geometry
from . import rules as rules
from .environment import Environment, Pushing
from .physics import Physics
from .planner import Planner
from .rules import Scene
from .supervisor import SHAKIER, Decider, Supervisor, WayPoints

STEPS = 200  # control steps in an episode, at most
CUE = 5  # control steps in which the goal is seen
ARRIVAL = (40, 60)  # control steps after which the box comes: uniformly distributed
LINE, GOAL = 0.3, 0.35  # m: a box at this |x| has been pushed to a side; where the goal is shown
MIDDLE = 0.05  # m: half width of where the box comes to
AWAY = 0.9  # m: where it stands before, out of reach
HOME = geometry.inverse(np.array([0.0, 0.5]), 0.0)  # rad: the tip above the middle, clear of the box


class Cued(Pushing):
    """Shows the goal for a few steps, and then sends the box."""

    def __init__(self, random: int | None = None) -> None:
        super().__init__(STEPS, single=True, random=random)
        self._steps = 0  # observations are described before the first episode

    def get_observation(self, physics: Physics) -> OrderedDict[str, np.ndarray]:
        """That of pushing, where all steps tell ``goal``; ``cue`` [1] is ``goal`` while shown, then 0."""
        observation = super().get_observation(physics)
        observation["cue"] = observation["goal"] if self._steps < CUE else np.zeros(1)
        return observation

    def _draw_box_and_goal(self, physics: Physics) -> None:
        self._side, self._since = int(self.random.choice([-1, 1])), 0
        self._arrival = self.random.randint(ARRIVAL[0], ARRIVAL[1] + 1)
        self._place, self._came = self.random.uniform(-MIDDLE, MIDDLE), False
        physics.place_box(AWAY)
        physics.place_goal(self._side * GOAL)

    def _decided(self, physics: Physics) -> bool:
        """Whether goal or box were put somewhere; counts what became of the box.

        The box comes where the arm leaves room.
        """
        x, _, tilt = physics.box()
        hides = self._steps == CUE
        comes = (
            not self._came
            and self._steps >= self._arrival
            and geometry.is_clear(physics.joint_angles(), self._place, environment.START_CLEARANCE)
        )
        if hides:
            physics.hide_goal()
        if comes:
            physics.place_box(self._place)
            self._came = True
        elif self._came and abs(x) > LINE:
            self.counts.goals += x * self._side > 0
            self.counts.lost += x * self._side < 0
        elif self._came and abs(tilt) > environment.TOPPLED:
            self.counts.topples += 1
        elif self._steps == STEPS:
            self.counts.missed += 1
        return hides or comes


class Waiting:
    """A mind that keeps the arm at home until the box comes, and then leaves it to another."""

    def __init__(self, then: Decider) -> None:
        self._then, self.phase = then, 0

    def reset(self, seed: int) -> None:
        """Forget the last episode."""
        self._then.reset(seed)

    def decide(self, scene: Scene) -> np.ndarray:
        """Joint velocities [3] (rad/s)."""
        if abs(scene.box) > environment.OUT_OF_REACH:
            self.phase = 0
            return rules.towards(scene.angles, HOME)
        velocities = self._then.decide(scene)
        self.phase = self._then.phase
        return velocities


class Patient(Supervisor):
    """A supervisor that waits at home for the box. Its label ``side`` is the goal's, from the first step."""

    def __init__(self, decider: Decider, noise: float = 0.0) -> None:
        super().__init__(Waiting(decider), noise)

    def act(self, observation: Observation) -> np.ndarray:
        """Joint velocities [3] (rad/s), within what the servos can do."""
        control = super().act(observation)
        self._side = int(np.sign(observation["goal"][0]))
        return control


def outcome(ended: dm_env.Environment) -> dict[str, float]:
    """What became of the box: over the line on the goal's side (``success``) or on the other
    (``wrong_side``), ``toppled``, or ``missed``: none of them in time.
    """
    counts: environment.Counts = ended.task.counts
    return {
        "success": float(counts.goals),
        "wrong_side": float(counts.lost),
        "toppled": float(counts.topples),
        "missed": float(counts.missed),
    }


def load(seed: int) -> Environment:
    """An episode of at most 200 steps."""
    path = str(environment.HERE / "pushing.xml")
    return Environment(Physics.from_xml_path(path), Cued(random=seed), n_sub_steps=environment.SUB_STEPS)


def _policy(make: Callable[[], Decider], noise: float = 0.0) -> Callable[[dm_env.Environment], Policy]:
    return lambda environment: Patient(make(), noise)


task = Task(
    name="pushing_cue",
    load=load,
    policies={
        "supervisor": _policy(Planner),
        "scripted": _policy(WayPoints),
        **{f"scripted_noisy_{noise}": _policy(WayPoints, noise) for noise in SHAKIER},
    },
    outcome=outcome,
    frame=environment.frame,
    sources=environment.task.sources,
    steps=STEPS,
    measures=dict.fromkeys(("success", "wrong_side", "toppled", "missed"), "rate"),
    cameras=environment.task.cameras,
)
