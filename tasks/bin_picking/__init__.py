"""Surgical bin picking with a simulated surgical arm (paper, Physical Experiment 2 and SM 1.4)."""

from .environment import other_instrument, task

__all__ = ["other_instrument", "task"]
