"""What is done with OGBench's manipulation tasks, by the Python of an environment of its own (``apart.py``).

    python -m studies.ogbench_manipspace collect TASK OUT.hdf5 [--number 60] [--noise 0.0] [--goal 0]
        [--labels phase]
    python -m studies.ogbench_manipspace play TASK OUT.json NAME=EXPORTED... [--episodes 50] [--first 0]

``collect`` records OGBench's scripted Markov oracles as OGBench's "noisy" data sets were: an episode has
several targets in turn, drawn by the environment, and normal noise on every control, whose level is drawn for
each episode. An episode counts where every target was reached. Labels are OGBench's own: the ``phase`` that
the oracle announces, numbered over all oracles, and the ``object`` of the target. With ``--goal 1`` the
observation ``goal`` is where all objects are at the end of the episode, as OGBench's oracles have goals.

``play`` lets exported controllers reach OGBench's own five goals of the task, one after another by the seed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium
import numpy as np
import ogbench.manipspace  # noqa: F401  registers the environments
from ogbench.manipspace.oracles.markov.button_markov import ButtonMarkovOracle
from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
from ogbench.manipspace.oracles.markov.drawer_markov import DrawerMarkovOracle
from ogbench.manipspace.oracles.markov.window_markov import WindowMarkovOracle

from studies import arena_recording
from studies.arena_playing import Observation, arguments, named_controllers, play_all
from studies.arena_recording import Recorded

ORACLES = {
    "cube": (CubeMarkovOracle, 9),
    "button": (ButtonMarkovOracle, 4),
    "drawer": (DrawerMarkovOracle, 5),
    "window": (WindowMarkovOracle, 5),
}
"""Of each kind of target, and the phases that it announces as "1: ..." and so on."""

ROBOT = {"joint_pos": 6, "joint_vel": 6, "effector_pos": 3, "effector_yaw": 2, "gripper": 1, "contact": 1}
CUBE, BUTTON, SLIDE = 9, 4, 2
"""Numbers that OGBench's vector of observations has of each object."""

TASKS: dict[str, tuple[dict[str, int], list[str], int]] = {
    "cube-single": ({"cube": CUBE}, ["cube 0"], 1),
    "cube-double": ({"cube_0": CUBE, "cube_1": CUBE}, ["cube 0", "cube 1"], 2),
    "scene": (
        {"cube": CUBE, "buttons": 2 * BUTTON, "drawer": SLIDE, "window": SLIDE},
        ["cube 0", "button 0", "button 1", "drawer", "window"],
        4,
    ),
    "puzzle-3x3": ({"buttons": 9 * BUTTON}, [f"button {number}" for number in range(9)], 4),
}
"""The objects in the vector of observations, those that can be a target, and the targets of an episode."""

LABELS = ("phase", "object")
"""What the oracle does, and what it does it to."""

STACKED = 0.25
"""The chance that a cube is to be put on another one is drawn up to here for each episode."""

SPREAD = np.array([1.0, 1.0, 1.0, 3.0, 10.0])
"""Of the noise, for each control."""


def announcing(kind: str, env: Any) -> Any:
    """OGBench's oracle of a kind of target, which keeps the phase that it announces as ``announced``."""
    oracle = ORACLES[kind][0]

    class Announcing(oracle):  # type: ignore[misc, valid-type]
        def print_phase(self, phase: str) -> None:
            self.announced = int(phase.partition(":")[0]) - 1

    given = {"gripper_always_closed": True} if "puzzle" in env.spec.id else {}
    given |= {"max_step": 100} if "scene" in env.spec.id and kind == "cube" else {}
    return Announcing(env=env, **given)


class Collector:
    """Episodes of a task."""

    def __init__(self, task: str, noise: float, goal: bool, labels: Collection[str]) -> None:
        self.objects, self.targets, self.number = TASKS[task]
        self.env = gymnasium.make(
            f"{task}-v0", mode="data_collection", terminate_at_goal=False, max_episode_steps=10_000
        ).unwrapped
        kinds = dict.fromkeys(target.split()[0] for target in self.targets)
        counts = [ORACLES[kind][1] for kind in kinds]
        self.first = dict(zip(kinds, np.cumsum([0, *counts]).tolist(), strict=False))
        self.labels = labels
        self.oracles = {kind: announcing(kind, self.env) for kind in kinds}
        self.task, self.noise, self.goal = task, noise, goal

    def episode(self, seed: int) -> Recorded | None:
        """The episode of a seed; None where a target was not reached, or the cube left what cameras see."""
        np.random.seed(seed)  # noqa: NPY002  the oracles draw from these numbers
        random = np.random.default_rng(seed)
        level, stacked = random.uniform(0, self.noise), random.uniform(0, STACKED)
        seen, told = self.env.reset(seed=seed)
        rows = []
        for number in range(self.number):
            if number:
                seen, told = self.env.set_new_target(p_stack=stacked)
            kind = told["privileged/target_task"]
            target = self.targets.index(" ".join([kind, *self._which(kind, told)]))
            oracle = self.oracles[kind]
            oracle.reset(seen, told)
            while not oracle.done:
                control = oracle.select_action(seen, told) + random.normal(0, level * SPREAD)
                control = np.clip(control, -1, 1).astype(np.float32)
                rows.append((seen, control, self.first[kind] + oracle.announced, target))
                seen, _, _, _, told = self.env.step(control)
            if not told["success"] or self._hidden(told):
                return None
        seen, controls, phases, targets = (np.array(part) for part in zip(*rows, strict=True))
        observations, said = named(self.task, seen), {"phase": phases, "object": targets}
        if self.goal:
            reached = self.env.compute_oracle_observation().astype(np.float32)
            observations |= {"goal": np.tile(reached, (len(seen), 1))}
        return {
            "actions": controls,
            **{f"obs/{key}": part for key, part in observations.items()},
            **{f"labels/{name}": said[name].astype(np.int8) for name in self.labels},
        }

    def _which(self, kind: str, told: dict[str, Any]) -> list[str]:
        place = {"cube": "privileged/target_block", "button": "privileged/target_button"}.get(kind)
        return [] if place is None else [str(told[place])]

    def _hidden(self, told: dict[str, Any]) -> bool:
        """As OGBench: in the scene a cube has to be in sight or in the drawer."""
        if self.task != "scene":
            return False
        _, y, z = told["privileged/block_0_pos"]
        return bool(y >= 0.29 or (y <= -0.3 and not 0.06 <= z <= 0.08))


class Goals:
    """OGBench's own goals of a task. A seed has the goal of its remainder, and small random displacements."""

    def __init__(self, task: str) -> None:
        self.task, made = task, gymnasium.make(f"{task}-v0", use_oracle_rep=True)
        self.env, self.limit = made.unwrapped, made.spec.max_episode_steps
        self.outcome: dict[str, float] = {}

    def reset(self, seed: int) -> Observation:
        """The initial state of this seed."""
        seen, told = self.env.reset(seed=seed, options={"task_id": 1 + seed % self.env.num_tasks})
        self.goal, self.time = told["goal"].astype(np.float32), 0
        return {**named(self.task, seen), "goal": self.goal}

    def step(self, control: np.ndarray) -> tuple[Observation, bool, bool]:
        """The next observation, whether the goal is reached, and whether OGBench's time is up."""
        seen, _, _, _, told = self.env.step(np.clip(control, -1, 1))
        self.time += 1
        return {**named(self.task, seen), "goal": self.goal}, bool(told["success"]), self.time == self.limit


def named(task: str, seen: np.ndarray) -> dict[str, np.ndarray]:
    """Observations by key, as precise as they are recorded, of OGBench's vectors [..., D]."""
    sizes = ROBOT | TASKS[task][0]
    parts = np.split(seen.astype(np.float32), np.cumsum(list(sizes.values())), axis=-1)
    return dict(zip(sizes, parts, strict=False))


def main() -> None:
    """Collect, or let controllers act."""
    parser = arguments(__doc__, ("collect", "play"), 60)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--goal", type=int, default=0, choices=(0, 1))
    parser.add_argument("--labels", nargs="+", default=LABELS, choices=LABELS)
    own = parser.parse_args()
    if own.task not in TASKS:
        print(f"there is no task {own.task!r}; there is: {', '.join(TASKS)}", file=sys.stderr)
        raise SystemExit(2)
    first = own.first or 0
    if own.what == "play":
        seeds = range(first, first + own.episodes)
        return play_all(Goals(own.task), own.out, named_controllers(own.controllers), seeds)
    collector = Collector(own.task, own.noise, bool(own.goal), own.labels)
    about = own.number, own.held_out, first, own.attempts
    arena_recording.collect(own.out, f"{own.task}-v0", collector.episode, *about)


if __name__ == "__main__":
    main()
