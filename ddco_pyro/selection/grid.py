"""The candidates of a selection, one for each point of the grid, and the folds, checked before any fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from ddco_pyro.data.controls import control_parts, difference
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.tasks import are_several
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import Spec, SpecError, with_overrides
from ddco_pyro.spec.base import show
from ddco_pyro.training.networks import Dimensions, check_networks, parameters

DATA = ("task", "demonstrations")
"""Keys that all candidates share, as they are compared on the same demonstrations."""


@dataclass(frozen=True)
class Candidate:
    """One point of the grid.

    :param number: from 0.
    :param values: by key path of the grid.
    :param spec: the whole spec with these values.
    :param parameters: the number of trained parameters.
    """

    number: int
    values: Mapping[str, Any]
    spec: Spec
    parameters: int

    @property
    def name(self) -> str:
        """The candidate's name in tables, such as ``count = 3``."""
        return point_name(self.values)


def point_name(values: Mapping[str, Any]) -> str:
    """Values by key path as a name in tables, such as ``count = 3, std = 0.1``."""
    return ", ".join(f"{_short(path, values)} = {_value(value)}" for path, value in values.items())


def _short(path: str, paths: Iterable[str]) -> str:
    """The shortest end of a key path that no other one has."""
    others = [f".{other}" for other in paths if other != path]
    parts = path.split(".")
    for start in range(len(parts) - 1, 0, -1):
        end = ".".join(parts[start:])
        if not parts[start].isdecimal() and not any(other.endswith(f".{end}") for other in others):
            return end
    return path


def _value(value: Any) -> str:
    """A value of the grid; a list of levels as their numbers of options, lowest first."""
    levels = value if isinstance(value, list | tuple) else ()
    if levels and all(isinstance(level, Mapping) and "count" in level for level in levels):
        return f"[{', '.join(str(level['count']) for level in levels)}]"
    return value if isinstance(value, str) else show(value)


def wide(spec: Spec) -> Spec:
    """The spec with the observations of all candidates, for reading the demonstrations once."""
    alone = with_overrides(spec, {"selection.grid": {}})
    seen = {obs.name: obs for obs in spec.observations}
    for path, values in spec.selection.grid.items():
        if path.partition(".")[0] == "observations":
            for value in values:
                seen |= {obs.name: obs for obs in with_overrides(alone, {path: value}).observations}
    return alone.model_copy(update={"observations": tuple(seen.values())})


def candidates(spec: Spec, dimensions: Dimensions) -> list[Candidate]:
    """The Cartesian product of the grid's values, the last key path changing fastest.

    :raises SpecError: the grid is empty or touches the data, a candidate is not valid, or candidates model a
        control dimension as different kinds; one line for each problem.
    """
    grid = spec.selection.grid
    if not grid:
        example = "{hierarchy.levels.0.count: [1, 2, 3, 4]}"
        raise SpecError(f"selection.grid: is empty; name what to try, such as selection.grid: {example}")
    shared = [path for path in grid if path.partition(".")[0] in DATA]
    if shared:
        why = "candidates are compared on the same data; remove it"
        raise SpecError(*(f"selection.grid.{path}: {why}" for path in shared))
    alone: dict[str, Any] = {"selection.grid": {}, "compare_with": []}  # baselines are compared, not selected
    valid, problems = [], []
    for number, values in enumerate(product(*grid.values())):
        try:
            point = dict(zip(grid, values, strict=True))
            own = with_overrides(spec, alone | point)
            valid.append(Candidate(number, point, own, parameters(check_networks(own, dimensions))))
        except SpecError as error:
            where = ", ".join(f"{path}={show(value)}" for path, value in zip(grid, values, strict=True))
            problems += [f"selection.grid: {where}: {problem}" for problem in error.problems]
    if problems:
        raise SpecError(*problems)
    first, *others = valid
    for candidate in others:
        ours, theirs = (control_parts(one.spec.control, dimensions.control) for one in (first, candidate))
        if different := difference(ours, theirs):
            raise SpecError(
                f"selection.grid: {first.name} and {candidate.name} measure different things: {different}; "
                "densities and probabilities cannot be ranked, so give all candidates the same control.kind"
            )
    return valid


# --- folds --------------------------------------------------------------------------------------------------


def divide(demos: Demonstrations, folds: int, seed: int) -> tuple[Demonstrations, ...]:
    """The demonstrations for each fold, with the masks ``train`` and ``valid``, which is held out.

    Folds are over all demonstrations, or over the training ones where the file has masks for that. Each fold
    has all demonstrations: their dimensions decide the networks, which are the same in every fold. Of several
    tasks each is spread over the folds.

    :raises BadInput: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    used = demos.split(0.5, seed)[0].names if demos.masks.keys() & {"train", "valid"} else demos.names
    held_out = [[used[row] for row in rows] for rows in assign(demos.select(used).tasks, folds, seed)]
    return tuple(
        replace(demos, masks={"train": tuple(name for name in used if name not in out), "valid": tuple(out)})
        for out in held_out
    )


def assign(tasks: Sequence[str], folds: int, seed: int) -> list[list[int]]:
    """The numbers of the demonstrations held out in each fold: a partition, even within each task, too.

    :param tasks: of each demonstration.
    :raises BadInput: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    from sklearn.model_selection import KFold

    count = len(tasks)
    if folds > count:
        raise BadInput(f"selection.folds: {folds} folds of {count} demonstrations; use at most {count}")
    if count - -(-count // folds) < 2:
        known = f"{folds} folds of {count} demonstrations"
        raise BadInput(f"selection.folds: {known} leave less than 2 to train with")
    if are_several(tasks):  # dealt to the folds in turn, task by task
        dealt = sorted(np.random.default_rng(seed).permutation(count).tolist(), key=lambda row: tasks[row])
        return [sorted(dealt[fold::folds]) for fold in range(folds)]
    shuffled = KFold(folds, shuffle=True, random_state=seed).split(np.zeros(count))
    return [sorted(int(row) for row in held_out) for _, held_out in shuffled]
