"""What is done with Meta-World itself, by the Python of an environment of its own (``apart.py``).

    python -m studies.arena_metaworld collect TASK OUT.hdf5 [--number 70] [--held-out 20] [--noise 0.1]
    python -m studies.arena_metaworld play TASK OUT.json NAME=EXPORTED... [--episodes 50] [--first SEED]

``collect`` records the scripted expert, executed with normal noise on every control; of each step its phase
is the return statement by which the expert's ``_desired_pos`` ended, or the assignment of ``delta_pos`` where
it has none. ``play`` lets exported controllers act from the same initial states, never demonstrated.
"""

from __future__ import annotations

import argparse
import copy
import functools
import os
import sys
import warnings
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
from metaworld.policies import ENV_POLICY_MAP

from studies import arena_recording
from studies.arena_phases import Phases
from studies.arena_playing import Observation, arguments, named_controllers, play_all
from studies.arena_recording import Recorded

OBSERVATIONS = {
    "hand_pos": slice(0, 3),
    "gripper": slice(3, 4),
    "object_pos": slice(4, 7),
    "object_quat": slice(7, 11),
    "object2_pos": slice(11, 14),
    "object2_quat": slice(14, 18),
    "goal_pos": slice(36, 39),
}
"""What Meta-World's vector says of now; between is what it said a step before."""

AFTER_SUCCESS = 5
"""Steps that a demonstration goes on once the task has succeeded."""

UNSEEN = 1_000_000
"""Seeds of initial states from here on are not demonstrated."""

_compiled = functools.cache(mujoco.MjModel.from_xml_path)
mujoco.MjModel.from_xml_path = lambda path: copy.copy(_compiled(path))  # most of the time of a short episode

Step = tuple[Observation, np.ndarray, int, bool]
"""What was seen, the control, the phase, and whether the task succeeded thereby."""


class Sawyer:
    """A task of Meta-World; every episode has a world of its own, so that none depends on those before."""

    def __init__(self, task: str) -> None:
        self._make = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-goal-observable"]
        self.outcome: dict[str, float] = {}
        self.world: Any = None
        self.seen = np.zeros(39)

    def reset(self, seed: int) -> Observation:
        """The initial state of this seed."""
        if self.world is not None:
            self.world.close()
        self.world = self._make(seed=seed)
        self.seen, _ = self.world.reset()
        return named(self.seen)

    def step(self, control: np.ndarray) -> tuple[Observation, bool, bool]:
        """The next observation, success, and whether Meta-World's time (500 steps) is up."""
        self.seen, _, _, ended, told = self.world.step(np.clip(control, -1, 1).astype(np.float32))
        return named(self.seen), bool(told["success"]), bool(ended)


def named(vector: np.ndarray) -> Observation:
    """The observations by key, as precise as they are recorded."""
    return {key: vector[part].astype(np.float32) for key, part in OBSERVATIONS.items()}


def demonstrate(world: Sawyer, expert: Any, phases: Phases, seed: int, noise: float) -> list[Step] | None:
    """An episode of the expert, which ends soon after its success; None where there was none."""
    random, steps, left = np.random.default_rng(seed), [], None
    observation, ended = world.reset(seed), False
    while not ended and left != 0:
        control, phase = phases.of(expert.get_action, world.seen)
        executed = np.clip(control + noise * random.normal(size=len(control)), -1, 1).astype(np.float32)
        before = observation
        observation, success, ended = world.step(executed)
        steps.append((before, executed, phase, success))
        left = left - 1 if left else AFTER_SUCCESS if success else None
    return None if left is None else steps


def collect(own: argparse.Namespace) -> None:
    """Record the first successful episodes from seed ``first`` on."""
    world, expert = Sawyer(own.task), ENV_POLICY_MAP[own.task]()
    places = getattr(type(expert), "_desired_pos", None)
    phases = Phases(places) if places else Phases(type(expert).get_action, "delta_pos")

    def demonstration(seed: int) -> Recorded | None:
        steps = demonstrate(world, expert, phases, seed, own.noise)
        return steps and recorded(steps)

    asked = (own.number, own.held_out, own.first or 0, own.attempts)
    arena_recording.collect(own.out, f"metaworld/{own.task}", demonstration, *asked)


def recorded(steps: list[Step]) -> Recorded:
    """The arrays of a demonstration."""
    seen, executed, phase, success = zip(*steps, strict=True)
    return {
        "actions": np.stack(executed),
        **{f"obs/{key}": np.stack([observation[key] for observation in seen]) for key in OBSERVATIONS},
        "labels/phase": np.array(phase, np.int8),
        "rewards": np.array(success, np.float32),
    }


def main() -> None:
    """Collect, or let controllers act."""
    parser = arguments(__doc__, ("collect", "play"), 70)
    parser.add_argument("--noise", type=float, default=0.1)
    own = parser.parse_args()
    warnings.filterwarnings("ignore")  # the experts' gains are meant to saturate
    if own.task not in ENV_POLICY_MAP:
        known = ", ".join(sorted(ENV_POLICY_MAP))
        print(f"there is no task {own.task!r}; Meta-World has: {known}", file=sys.stderr)
        raise SystemExit(2)
    if own.what == "collect":
        collect(own)
    else:
        first = UNSEEN if own.first is None else own.first
        seeds = range(first, first + own.episodes)
        play_all(Sawyer(own.task), own.out, named_controllers(own.controllers), seeds)


if __name__ == "__main__":
    main()
