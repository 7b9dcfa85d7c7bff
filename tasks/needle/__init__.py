"""Needle grasping and insertion with a simulated surgical arm (paper §5.2)."""

from .environment import task

__all__ = ["task"]
