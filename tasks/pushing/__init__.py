"""Planar pushing with a three-link arm (paper §5.1)."""

from .. import rendering  # noqa: F401 (first: dm-control's own error does not name a missing OpenGL)
from .cue import task as cued
from .environment import limited, single, task

__all__ = ["cued", "limited", "single", "task"]
