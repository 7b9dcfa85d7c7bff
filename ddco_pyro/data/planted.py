"""Generated pick-and-place demonstrations with known skills, for trying things out without a simulator."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations

PHASES = ("reach", "grasp", "carry", "release")
"""The skills in their order: the values 0 to 3 of the label ``phase``."""

NEAR = 0.05
"""Distance in metres at which a place is reached."""

SPEED = 0.15
"""The share of the remaining way that a step covers."""

NOISE = 0.003
"""Standard deviation of the velocity, in metres a step."""


def pick_and_place(count: int = 40, seed: int = 0) -> Demonstrations:
    """A point gripper fetches an object: it reaches, grasps, carries and releases.

    Observations are the positions of ``gripper``, ``object`` and ``goal`` [3] in metres, and the opening of
    the ``jaw`` [1] from 0 to 1. The control is the gripper's velocity in metres a step and the jaw's command,
    −1 or 1. The label ``phase`` is the skill.

    >>> demos = pick_and_place(2)
    >>> demos.observation_shapes, demos.control_size, sorted(set(demos[0].labels["phase"].tolist()))
    ({'gripper': (3,), 'object': (3,), 'goal': (3,), 'jaw': (1,)}, 4, [0, 1, 2, 3])
    """
    random = np.random.default_rng(seed)
    demos = []
    for number in range(count):
        observed, controls, phases = zip(*_episode(random), strict=True)
        each = {key: np.stack([step[key] for step in observed]) for key in observed[0]}
        demos.append(Demonstration(f"demo_{number}", each, np.stack(controls), {"phase": np.array(phases)}))
    return Demonstrations(tuple(demos), attributes={"label_names": json.dumps({"phase": PHASES})})


def _episode(random: np.random.Generator) -> Iterator[tuple[dict[str, np.ndarray], np.ndarray, int]]:
    """Observations, control and phase of each step."""
    gripper = np.array([0.0, 0.0, 0.3]) + random.uniform(-0.05, 0.05, 3)
    thing, goal = (np.array([x, 0.0, 0.0]) + random.uniform(-0.2, 0.2, 3) * [1, 1, 0] for x in (-0.4, 0.4))
    jaw, phase, rest = 1.0, 0, 4
    while rest:
        target = (thing, thing, goal, goal + np.array([0.0, 0.0, 0.3]))[phase]
        velocity = SPEED * (target - gripper) * (phase != 1) + NOISE * random.normal(size=3)
        command = -1.0 if phase in (1, 2) else 1.0
        observed = {"gripper": gripper, "object": thing, "goal": goal, "jaw": np.array([jaw])}
        yield observed, np.append(velocity, command), phase
        gripper = gripper + velocity
        jaw = float(np.clip(jaw + 0.25 * command, 0, 1))
        thing = gripper if phase == 2 else thing
        rest -= int(phase == 3 and jaw == 1)
        at_thing, at_goal = (np.linalg.norm(gripper - place) < NEAR for place in (thing, goal))
        done = (at_thing, jaw == 0, at_goal, False)
        phase += int(done[phase])
