"""What is done with BabyAI's levels themselves, by the Python of an environment of its own (``apart.py``).

    python babyai_minigrid.py collect LEVEL OUT.hdf5 [--number 80] [--held-out 20]
    python babyai_minigrid.py play LEVEL OUT.json NAME=EXPORTED... [--episodes 50] [--recorded DEMONSTRATIONS.hdf5]

``collect`` records minigrid's bot; the labels of a step are the kind of the subgoal on top of its stack, and the number
of the instruction that it follows. ``play`` lets exported controllers, the bot, and random actions act in missions that
were never demonstrated, the same for all. Only missions of two instructions or more count.
"""

from __future__ import annotations

import contextlib
import io
import os
from itertools import count
from typing import Any

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

import arena_recording
import gymnasium
import minigrid  # noqa: F401  its levels are registered
import numpy as np
from arena_playing import Observation, arguments, named_controllers, play_all
from arena_recording import Recorded
from babyai_labels import MOST, SUBGOALS, Stack, leaves, subgoal
from babyai_seen import observation
from minigrid.utils.baby_ai_bot import BabyAIBot

LIMIT = 120
"""Steps that an episode has at most, the bot's too."""

UNSEEN = 1_000_000
"""Seeds of missions from here on are not demonstrated."""

TRIES = 1000
"""An episode's mission is the first of so many that has two instructions or more."""

ACTIONS = 6
"""Those that do something; the one after them, ``done``, does not."""


class Level:
    """A level of BabyAI."""

    def __init__(self, name: str) -> None:
        self._made = gymnasium.make(f"BabyAI-{name}-v0", max_episode_steps=LIMIT)
        self.world: Any = self._made.unwrapped
        self.outcome: dict[str, float] = {}

    def reset(self, seed: int) -> Observation:
        """The mission of this seed."""
        for number in count(seed * TRIES):
            with contextlib.redirect_stdout(io.StringIO()):  # it prints which missions it rejects
                self._made.reset(seed=number)
            if len(leaves(self.world.instrs)) > 1:
                break
        self._seen = np.zeros((self.world.width, self.world.height), bool)
        return self._observed()

    def step(self, control: np.ndarray) -> tuple[Observation, bool, bool]:
        """The next observation, success, and whether the time is up."""
        _, reward, ended, late, _ = self._made.step(int(control[0]))
        return self._observed(), reward > 0, bool(ended or late)

    def _observed(self) -> Observation:
        self._look()
        return observation(self.world, self._seen, self.world.instrs)

    def _look(self) -> None:
        """What is in view now has been seen."""
        _, visible = self.world.gen_obs_grid()
        size, ahead, right = self.world.agent_view_size, self.world.dir_vec, self.world.right_vec
        corner = self.world.agent_pos + ahead * (size - 1) - right * (size // 2)
        for i, j in np.argwhere(visible):
            place = corner - ahead * j + right * i
            if (place >= 0).all() and (place < self._seen.shape).all():
                self._seen[tuple(place)] = True


class Bot:
    """minigrid's bot in a level, as a controller; it looks at the world, not at observations."""

    def __init__(self, level: Level) -> None:
        self._level = level

    def reset(self, _: int) -> None:
        """Begin the mission that the level is at."""
        self._bot = BabyAIBot(self._level.world)
        self._bot.stack = Stack(self._bot.stack, self._level.world.instrs)
        self._action: int | None = None

    def act(self, _: Observation) -> np.ndarray:
        """The next action [1]."""
        try:
            self._action = int(self._bot.replan(self._action))
        except AssertionError:  # so the bot says that it is at a loss
            self._action = ACTIONS
        return np.array([self._action])

    def labels(self) -> tuple[int, int]:
        """What the last action was for: the kind of subgoal, and the number of the instruction."""
        return subgoal(self._bot.stack), self._bot.stack.instruction


class Random:
    """Every action as likely as any other."""

    def reset(self, seed: int) -> None:
        """Begin anew."""
        self._random = np.random.default_rng(seed)

    def act(self, _: Observation) -> np.ndarray:
        """The next action [1]."""
        return self._random.integers(ACTIONS, size=1)


def demonstration(level: Level, bot: Bot, seed: int) -> Recorded | None:
    """The bot's episode; None where it did not succeed."""
    now, success, ended, steps = level.reset(seed), False, False, []
    bot.reset(seed)
    while not (success or ended):
        action = bot.act(now)
        steps.append((now, action, bot.labels()))
        now, success, ended = level.step(action)
    if not success:
        return None
    seen, actions, labels = zip(*steps, strict=True)
    kinds, instructions = np.array(labels, np.int8).T
    return {
        "actions": np.stack(actions),
        **{f"obs/{key}": np.stack([one[key] for one in seen]) for key in seen[0]},
        "labels/subgoal": kinds,
        "labels/mission": instructions,
        "rewards": (np.arange(len(steps)) == len(steps) - 1).astype(np.float32),
    }


def main() -> None:
    """Collect or play."""
    own = arguments(__doc__, ("collect", "play"), 80).parse_args()
    if f"BabyAI-{own.task}-v0" not in gymnasium.registry:
        raise SystemExit(f"minigrid has no level BabyAI-{own.task}-v0")
    level = Level(own.task)
    bot = Bot(level)
    if own.what == "collect":
        labels = {"subgoal": len(SUBGOALS), "mission": MOST}
        arena_recording.collect(
            own.out, f"BabyAI-{own.task}-v0", lambda seed: demonstration(level, bot, seed), own.number, own.held_out,
            labels,
        )  # fmt: skip
    else:
        seeds, scripted = range(UNSEEN, UNSEEN + own.episodes), {"bot": bot, "random": Random()}
        play_all(level, own.out, named_controllers(own.controllers), seeds, own.recorded, scripted)


if __name__ == "__main__":
    main()
