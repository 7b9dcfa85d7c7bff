"""Needle grasping and insertion with a simulated surgical arm (paper §5.2)."""

from .. import rendering  # noqa: F401 (first: dm-control's own error does not name a missing OpenGL)
from .environment import task

__all__ = ["task"]
