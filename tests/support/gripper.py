"""Demonstrations of a planted pick and place whose control has a two-valued gripper and a constant dimension.

    python tests/support/gripper.py OUT.hdf5

writes a file of them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations

PHASES = ("reach", "lift", "carry", "lower")
GAINS = (0.5, 0.3, 0.25, 0.4)
"""Part of the way to the phase's target that the hand goes in a step."""

CONSTANT = 0.5
NOISE = 0.05
ABOVE = np.array([0.0, 0.0, 0.4])
NEAR = 0.12
LONGEST = 100


def planted(count: int = 120, seed: int = 0) -> Demonstrations:
    """Demonstrations with labels ``phase``. In each phase the hand's velocity (controls 0 to 2) is linear in the
    observations, with Gaussian noise; control 3 is −1 with an open gripper and 1 with a closed one; control 4 never
    changes.
    """
    return Demonstrations(tuple(_record(f"demo_{number}", seed + number) for number in range(count)))


def _record(name: str, seed: int) -> Demonstration:
    random = np.random.default_rng(seed)
    hand, item, goal = random.uniform([-1, -1, 0], [1, 1, 0.6], (3, 3)) * [[1, 1, 1], [1, 1, 0], [1, 1, 0]]
    targets = (item, item + ABOVE, goal + ABOVE, goal)
    phase, gripper, rows = 0, -1.0, []
    while phase < len(PHASES) and len(rows) < LONGEST:
        velocity = GAINS[phase] * (targets[phase] - hand) + NOISE * random.normal(size=3)
        control = [*velocity, 1.0 if phase else -1.0, CONSTANT]
        rows.append((hand, [gripper], item, goal, phase, control))
        hand, gripper = hand + velocity, control[3]
        phase += int(np.linalg.norm(hand - targets[phase]) < NEAR)
    hands, grippers, items, goals, phases, controls = (np.array(column) for column in zip(*rows, strict=True))
    observations = {"hand": hands, "gripper": grippers, "item": items, "goal": goals}
    return Demonstration(name, observations, controls, {"phase": phases})


if __name__ == "__main__":
    planted().write(Path(sys.argv[1]))
