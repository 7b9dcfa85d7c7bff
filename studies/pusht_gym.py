"""What is done with PushT itself (gym-pusht), by the Python of an environment of its own (``apart.py``).

    python -m studies.pusht_gym play PushT OUT.json NAME=EXPORTED... [--episodes 50] [--first 100000]

Lets exported controllers push the T onto its target from initial states of their own seeds.
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # or the window of a person is asked for

import numpy as np
from gym_pusht.envs.pusht import PushTEnv

from studies.arena_playing import Observation, arguments, named_controllers, play_all

TIME = 300
"""Steps of an episode, as in the published results (Chi et al. 2023)."""


class PushT:
    """Pushing the T; ``outcome`` has the largest part of the target that it covered; 95 % count as all."""

    def __init__(self) -> None:
        self._world = PushTEnv()
        self.outcome = {"coverage": 0.0}

    def reset(self, seed: int) -> Observation:
        """The initial state of this seed."""
        state, _ = self._world.reset(seed=seed)
        self.outcome, self._time = {"coverage": 0.0}, 0
        return named(state)

    def step(self, control: np.ndarray) -> tuple[Observation, bool, bool]:
        """The next observation, whether the target is covered, and whether the time is up."""
        state, reward, covered, _, _ = self._world.step(np.clip(control, 0, 512))
        self.outcome = {"coverage": max(self.outcome["coverage"], float(reward))}
        self._time += 1
        return named(state), bool(covered), self._time == TIME


def named(state: np.ndarray) -> Observation:
    """The observations by key, as precise as they are recorded."""
    turned = [np.sin(state[4]), np.cos(state[4])]
    seen = {"agent_pos": state[:2], "block_angle_sincos": turned, "block_pos": state[2:4]}
    return {key: np.array(values, np.float32) for key, values in seen.items()}


def main() -> None:
    """Let controllers act."""
    own = arguments(__doc__, ("play",), 0).parse_args()
    first = own.first or 0
    seeds = range(first, first + own.episodes)
    play_all(PushT(), own.out, named_controllers(own.controllers), seeds)


if __name__ == "__main__":
    main()
