"""Names of options: ``names.yaml`` in a run folder, and the names that labels propose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources.recording import LABEL_NAMES
from ddco_pyro.drawing.words import choice_names
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import confusion
from ddco_pyro.metrics import TrainedLabels
from ddco_pyro.spec import Spec
from ddco_pyro.spec.yaml import dump_yaml, read_yaml

FILE = "names.yaml"

Named = dict[str, tuple[str, ...]]
"""The names of options 1 to k, by level."""


def checked(spec: Spec, given: Any) -> Named:
    """Names of options that fit a spec.

    :param given: for each level to name, a list of the names of options 1 to k.
    :raises BadInput: there is no such level, or the names are not k different texts.
    """
    counts = {level.name: level.count for level in spec.hierarchy.levels} if spec.hierarchy else {}
    if not counts:
        raise BadInput("there are no options to name; name a run with a hierarchy")
    if not isinstance(given, Mapping):
        raise BadInput("is no mapping; write a line for each level, such as: option: [reach, grasp]")
    named = {}
    for level, names in given.items():
        if level not in counts:
            raise BadInput(f"there is no level {level!r}{nearest(level, counts)}; there is: {', '.join(counts)}")
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise BadInput(f"level {level!r}: give a list of texts; quote a number")
        if len(names) != counts[level]:
            raise BadInput(
                f"level {level!r}: {len(names)} names for {counts[level]} options; name each, in the order of options "
                f"1 to {counts[level]}"
            )
        named[level] = own = tuple(name.strip() for name in names)
        if bad := [option for option, name in enumerate(own, 1) if not (name and name.isprintable())]:
            raise BadInput(f"level {level!r}: the name of option {bad[0]} is empty or has a line break")
        if twice := [name for name in own if choice_names(len(own), own).count(name) > 1]:
            raise BadInput(f"level {level!r}: {twice[0]!r} names two choices; give each a name of its own")
    return {level: named[level] for level in counts if level in named}


def read_names(folder: Path, spec: Spec) -> Named | None:
    """The names in the ``names.yaml`` of a run; None without the file.

    :raises BadInput: the file is not YAML, or its names do not fit the spec.
    """
    path = folder / FILE
    if not path.exists():
        return None
    try:
        return checked(spec, read_yaml(path.read_bytes()) or {})
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None


def write_names(folder: Path, named: Named) -> None:
    """Write ``names.yaml``."""
    text = "# The names of options 1 to k of each level, to be edited by hand; ddco-pyro report shows them.\n"
    write_text(folder / FILE, text + dump_yaml({level: list(names) for level, names in named.items()}))


def label_names(demos: Demonstrations) -> dict[str, list[str]]:
    """The names of labels 0, 1, ... that a file of demonstrations gives (:data:`LABEL_NAMES`), by name of labels.

    :raises DemonstrationsError: the attribute is something else.
    """
    try:
        return TypeAdapter(dict[str, list[str]]).validate_json(str(demos.attributes.get(LABEL_NAMES, "{}")))
    except ValidationError:
        raise DemonstrationsError(
            f'attribute {LABEL_NAMES!r}: is no JSON such as {{"phase": ["reach", "grasp"]}}; correct or remove it'
        ) from None


def proposed(
    spec: Spec, train: Demonstrations, segments: Sequence[Sequence[np.ndarray]], trained: TrainedLabels | None = None
) -> Named:
    """Names of options from the labels of the demonstrations that they were trained with.

    An option that stands for a label of ``training.labels`` has that label's name. Elsewhere options are matched with
    labels so that as many steps as possible agree (Hungarian assignment). An option gets the name of its label where
    more than half of its labelled steps have that label, and more than half of the label's steps are in the option.
    Other options stay without a name, and so does a level without any match.

    :param segments: the most likely choices of each level, of each demonstration [T].
    """
    assert spec.hierarchy is not None  # or there are no segments
    levels, known = spec.hierarchy.levels, label_names(train)
    labels = dict(zip((level.name for level in levels), spec.demonstrations.labels_by_level(len(levels)), strict=False))
    named: Named = {}
    for level, choices in zip(levels, segments, strict=True):
        if trained and trained.level == level.name:
            label, matched = trained.labels, list(enumerate(trained.values, start=1))
        elif (label := labels.get(level.name, "")) and all(label in demo.labels for demo in train):
            matched = _clear_matches(choices, train, label)
        else:
            continue
        names = list(choice_names(level.count))
        for option, value in matched:
            name = _label_name(label, value, known.get(label), level.name).strip()
            if name and name not in names:
                names[option] = name
        if tuple(names) != choice_names(level.count):
            named[level.name] = tuple(names[1:])
    return named


def _clear_matches(choices: Sequence[np.ndarray], train: Demonstrations, label: str) -> list[tuple[int, int]]:
    """Options with their labels, where each is in most of the other's steps."""
    table = confusion(choices, [demo.labels[label] for demo in train])
    steps, found = np.array(table.steps), []
    for place, (option, value) in enumerate(zip(table.options, table.matched, strict=True)):
        if option and value is not None:
            row = table.labels.index(value)
            if 2 * steps[row, place] > max(steps[row].sum(), steps[:, place].sum()):
                found.append((option, value))
    return found


def _label_name(label: str, value: int, known: list[str] | None, level: str) -> str:
    """``grasp`` where the file names the label, else ``phase 2``; empty where it names others only."""
    if known is not None:
        return known[value] if 0 <= value < len(known) else ""
    return f"{'label' if label in (level, 'option') else label} {value}"
