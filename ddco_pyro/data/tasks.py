"""The task of a demonstration by its attributes, demonstrations by an attribute's value, a one-hot vector."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from ddco_pyro.data.demonstration import Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.labels import BOUNDARY, SOURCE, UNKNOWN
from ddco_pyro.errors import nearest
from ddco_pyro.spec import TASK

NAMES = (TASK, "language_instruction", "task_description", "task_name", "instruction")
"""Attributes of a demonstration that name its task, the first ones before the others."""

Where = Mapping[str, Sequence[str]]
"""Attributes of demonstrations and their values, of which one is to be that of a demonstration."""

Known = Mapping[str, Mapping[str, Attribute]]
"""The attributes of each demonstration by its name."""


def task_of(attributes: Mapping[str, Attribute]) -> str:
    """The task that the attributes of a demonstration name; empty where they name none.

    >>> task_of({"language_instruction": "open the drawer", "seed": 3})
    'open the drawer'
    """
    return next((str(attributes[name]) for name in NAMES if attributes.get(name) not in (None, "")), "")


def by_task(known: Known) -> dict[str, list[str]]:
    """The names of the demonstrations of each task, in order."""
    found: dict[str, list[str]] = {}
    for name, attributes in known.items():
        found.setdefault(task_of(attributes), []).append(name)
    return found


def by_value(attribute: str, known: Known) -> dict[str, list[str]]:
    """The names of the demonstrations with each value of an attribute; ``task`` is :func:`task_of`.

    :raises DemonstrationsError: a demonstration lacks the attribute.
    """
    found: dict[str, list[str]] = {}
    for name, attributes in known.items():
        value = task_of(attributes) if attribute == TASK else str(attributes.get(attribute, ""))
        if not value and attribute not in attributes:
            there = ", ".join(dict.fromkeys(key for one in known.values() for key in one)) or "none"
            close = nearest(attribute, attributes)
            raise DemonstrationsError(f"{name} has no attribute {attribute!r}{close}; there is: {there}")
        found.setdefault(value, []).append(name)
    return found


def chosen(known: Known, where: Where) -> list[str]:
    """The names of the demonstrations with one of the values of each attribute.

    :raises DemonstrationsError: an attribute or a value is unknown, or no demonstration has all of them.
    """
    names = list(known)
    for attribute, values in where.items():
        there = by_value(attribute, known)
        for value in values:
            if value not in there:
                asked = f"no demonstration has {attribute}={value}{nearest(value, there)}"
                raise DemonstrationsError(f"{asked}; there is: {', '.join(there)}")
        members = {name for value in values for name in there[value]}
        names = [name for name in names if name in members]
    if not names:
        asked = " and ".join(f"{attribute}={' or '.join(values)}" for attribute, values in where.items())
        raise DemonstrationsError(f"no demonstration has {asked} at once; ask for less")
    return names


def are_several(tasks: Sequence[str]) -> bool:
    """Whether demonstrations of these tasks are of several, with two demonstrations and more in the mean."""
    return 1 < len({*tasks}) <= len(tasks) / 2


def of_tasks(
    tasks: Sequence[str], labels: Sequence[Mapping[str, np.ndarray]], known: Mapping[str, Sequence[str]]
) -> tuple[list[dict[str, np.ndarray]], dict[str, list[str]]]:
    """Labels [T] by name, numbered so that they differ between tasks unless the file names them; all names.

    >>> of_tasks(["push", "push", "reach", "reach"], [{"phase": np.array([0, 2])}] * 4, {})[1]
    {'phase': ['push: 0', 'push: 2', 'reach: 0', 'reach: 2']}

    :param tasks: of each demonstration.
    :param known: by name of labels, the names of labels 0, 1, ... that the file has.
    """
    numbered, names = [dict(own) for own in labels], {key: [*own] for key, own in known.items()}
    every = dict.fromkeys(key for own in labels for key in own if not key.endswith((BOUNDARY, SOURCE)))
    for key in (key for key in every if key not in known and are_several(tasks)):
        having = [(task, own) for task, own in zip(tasks, numbered, strict=True) if key in own]
        pairs = {(task, value) for task, own in having for value in own[key].tolist()}
        values = sorted((task, value) for task, value in pairs if value != UNKNOWN)
        number = {value: place for place, value in enumerate(values)}
        for task, own in having:
            own[key] = np.array([number.get((task, value), UNKNOWN) for value in own[key].tolist()], int)
        names[key] = [f"{task}: {value}" for task, value in values]
    return numbered, names


TASKS = "tasks"
"""Attribute of demonstrations with the observation ``task``: JSON, the task of each of its numbers."""


def known_tasks(attributes: Mapping[str, Attribute]) -> tuple[str, ...]:
    """The task of each number of the observation ``task`` of demonstrations; empty where they have none."""
    return tuple(json.loads(str(attributes.get(TASKS, "[]"))))


def one_hot(task: str, tasks: Sequence[str]) -> np.ndarray:
    """1 for a task, 0 for the others of ``tasks`` [n]; of another task each is 1 / n, the mean of known ones.

    >>> one_hot("push", ["push", "reach"]).tolist(), one_hot("open", ["push", "reach"]).tolist()
    ([1.0, 0.0], [0.5, 0.5])
    """
    row = np.array([float(name == task) for name in tasks])
    return row if row.any() else np.full(len(tasks), 1 / len(tasks))


def with_task(demo: Demonstration, tasks: Sequence[str]) -> Demonstration:
    """A demonstration with the observation ``task`` [T, n], :func:`one_hot` at each step."""
    row = one_hot(task_of(demo.attributes), tasks)
    observations = {**demo.observations, TASK: np.tile(row, (len(demo), 1))}
    return Demonstration.stored(**{**vars(demo), "observations": observations})
