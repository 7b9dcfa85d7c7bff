"""Planar pushing with a three-link arm (paper §5.1)."""

from .environment import limited, single, task

__all__ = ["limited", "single", "task"]
