"""Simulated tasks, each a :class:`ddco_pyro.simulation.task.Task` (import name ``ddco_tasks``)."""

from __future__ import annotations

import os

from .opengl import has_display

# MuJoCo reads the variable once, when it is first imported, so it has to be set before any task is.
if not has_display():
    os.environ.setdefault("MUJOCO_GL", "egl")
