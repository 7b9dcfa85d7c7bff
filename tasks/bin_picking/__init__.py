"""Surgical bin picking with a simulated surgical arm (paper, Physical Experiment 2 and SM 1.4)."""

from .. import rendering  # noqa: F401 (first: dm-control's own error does not name a missing OpenGL)
from .environment import alone, matrix, other_instrument, pose, task

__all__ = ["alone", "matrix", "other_instrument", "pose", "task"]
