"""Four planted tasks with three options of their own each: in each, phases are numbers from 0 to 2."""

from __future__ import annotations

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations

TASKS = ("close", "open", "press", "push")
OPTIONS = 3
"""Of each task."""

STATE, NOISE = 0.2, 0.05
"""Standard deviations of the state and of the control."""


def four_tasks(number: int = 10, seed: int = 0) -> Demonstrations:
    """Each option has a place of its own on a circle, and the control is the way there from a state that wanders.

    A demonstration has three segments of 6 to 9 steps, one of each option of its task.
    """
    random, demos = np.random.default_rng(seed), []
    angles = 2 * np.pi * np.arange(OPTIONS * len(TASKS)) / (OPTIONS * len(TASKS))
    places = np.column_stack([np.cos(angles), np.sin(angles)])
    for task, name in enumerate(TASKS):
        for _ in range(number):
            phases = np.repeat(np.arange(OPTIONS), random.integers(6, 10, OPTIONS))
            states = random.normal(0, STATE, (len(phases), 2))
            controls = places[task + len(TASKS) * phases] - states + random.normal(0, NOISE, states.shape)
            about = {"task": name}
            demos.append(Demonstration(f"demo_{len(demos)}", {"state": states}, controls, {"phase": phases}, about))
    return Demonstrations(tuple(demos))
