"""Collision-free paths in joint space: RRT-Connect, then shortcuts, from the Open Motion Planning Library.

A path is a function of its end points alone: the planner's random numbers start from the same seed for every
path, and it ends by a count of iterations, not by the clock.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ompl import base, geometric, util

SEED = 1
ITERATIONS = 5000

util.setLogLevel(util.LOG_ERROR)


@dataclass(frozen=True)
class Settings:
    """How a path is planned.

    :param range: the longest step of the tree (rad).
    :param resolution: between validity checks, as a part of the extent of the joint space.
    :param shortcuts: how many times a shortcut between two random points of the path is tried, at most.
    :param repeatable: start the random numbers anew for this path. If not, equal ends give different paths.
    """

    range: float = 0.3
    resolution: float = 0.01
    shortcuts: int = 0
    repeatable: bool = True


class NoPath(RuntimeError):
    """No collision-free path was found."""


DEFAULT = Settings()


def plan_path(
    start: np.ndarray,
    goal: np.ndarray,
    ranges: np.ndarray,
    is_free: Callable[[np.ndarray], bool],
    settings: Settings = DEFAULT,
) -> np.ndarray:
    """Corners [K, J] of a short path from ``start`` [J] to ``goal`` [J] through free joints (``is_free``).

    :param ranges: the joints' limits [J, 2].
    :raises NoPath: when an end is not free, or the planner gives up.
    """
    for name, end in (("start", start), ("goal", goal)):
        if np.any(end < ranges[:, 0]) or np.any(end > ranges[:, 1]):
            raise NoPath(f"the {name} of the path is beyond the joints' limits: {np.round(end, 3)}")
        if not is_free(end):  # OMPL would wait for other ends until it runs out of iterations
            raise NoPath(f"the {name} of the path collides: {np.round(end, 3)}")
    joints = len(ranges)
    if settings.repeatable:
        _restart_random_numbers()
    space = base.RealVectorStateSpace(joints)
    bounds = base.RealVectorBounds(joints)
    for joint, (low, high) in enumerate(ranges):
        bounds.setLow(joint, float(low))
        bounds.setHigh(joint, float(high))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: bool(is_free(_to_array(state, joints))))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(settings.resolution)
    planner = geometric.RRTConnect(information)
    planner.setRange(settings.range)
    setup.setPlanner(planner)
    setup.setStartAndGoalStates(_to_state(space, start), _to_state(space, goal))
    iterations = itertools.count()
    setup.solve(base.PlannerTerminationCondition(lambda: next(iterations) >= ITERATIONS))
    if not setup.haveExactSolutionPath():
        ends = f"from {np.round(start, 3)} to {np.round(goal, 3)}"
        raise NoPath(f"no path {ends} within {ITERATIONS} iterations")
    path = setup.getSolutionPath()
    _simplify(path, information, settings.shortcuts)
    return np.array([_to_array(path.getState(corner), joints) for corner in range(path.getStateCount())])


def _simplify(path: geometric.PathGeometric, information: base.SpaceInformation, shortcuts: int) -> None:
    """Leave out corners; then cut across what the tree's random growth left, which makes paths alike."""
    simplifier = geometric.PathSimplifier(information)
    simplifier.reduceVertices(path)
    if shortcuts:
        simplifier.partialShortcutPath(path, shortcuts, shortcuts)
        simplifier.reduceVertices(path)


def _restart_random_numbers() -> None:
    """Let every generator made from here on start as in a new process.

    OMPL calls it an error to do this twice, since generators keep their state. None is kept here.
    """
    level = util.getLogLevel()
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(SEED)
    util.setLogLevel(level)


def points_along(path: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """The points [N, J] at fractions [N] of the length of a path with corners [K, J]."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = fractions * lengths[-1]
    return np.stack([np.interp(at, lengths, joint) for joint in path.T], axis=1)


def _to_array(state: base.State, size: int) -> np.ndarray:
    return np.array([state[i] for i in range(size)])  # iterating a state runs past its end


def _to_state(space: base.RealVectorStateSpace, values: np.ndarray) -> base.State:
    state = space.allocState()
    for i, value in enumerate(values):
        state[i] = float(value)
    return state
