"""Few demonstrations of two arms: fourteen commands of joint positions, and many observations."""

from __future__ import annotations

import numpy as np
from random_demonstrations import numbered

from ddco_pyro.data.demonstrations import Demonstrations

JOINTS = 14


def bimanual(number: int = 20, steps: int = 60, seed: int = 0) -> Demonstrations:
    """Both arms go through six poses that vary with the demonstration; so do objects, which stand still."""
    random = np.random.default_rng(seed)
    poses, rows = 0.5 * random.normal(size=(6, JOINTS)), []
    for _ in range(number):
        own = poses + 0.1 * random.normal(size=poses.shape)
        times = np.r_[0, np.sort(random.choice(np.arange(5, steps - 5), 4, replace=False)), steps - 1]
        path = np.stack([np.interp(np.arange(steps), times, joint) for joint in own.T], axis=1)
        commands, place = path + 0.002 * random.normal(size=path.shape), np.zeros((steps, JOINTS))
        place[0] = path[0]
        for step in range(1, steps):
            place[step] = (place[step - 1] + commands[step - 1]) / 2
        effort = 5 * (commands - place) + 0.05 * random.normal(size=place.shape)
        objects = own[2:4, :6].ravel() + 0.001 * random.normal(size=(steps, 12))
        rows.append(({"place": place, "effort": effort, "objects": objects}, commands))
    return numbered(rows)
