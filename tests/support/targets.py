"""Planted demonstrations with velocities as controls, and the same with targets in their place."""

from dataclasses import replace

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.planted import pick_and_place


def velocities(count: int = 12) -> Demonstrations:
    """Planted demonstrations without the jaw's command: the control is the way to the next position."""
    return Demonstrations(tuple(replace(demo, actions=demo.actions[:, :3]) for demo in pick_and_place(count)))


def targets(demos: Demonstrations) -> Demonstrations:
    """The same, with the next position itself as the control."""
    moved = (replace(demo, actions=demo.actions + demo.observations["gripper"]) for demo in demos)
    return Demonstrations(tuple(moved))
