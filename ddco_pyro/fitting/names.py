"""Names of options: ``names.yaml`` in a run folder, and the names of the labels that options stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.labels import label_names
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import confusion
from ddco_pyro.metrics import NamedByLabel, TrainedLabels
from ddco_pyro.names import choice_names, label_name, option_name
from ddco_pyro.spec import Spec
from ddco_pyro.spec.yaml import dump_yaml, read_yaml

FILE = "names.yaml"

AGREED = 0.6
"""The agreement with a label from which on its option has its name; below, the name is proposed."""

Named = dict[str, tuple[str, ...]]
"""The names of options 1 to k, by level."""


def checked(spec: Spec, given: Any) -> Named:
    """Names of options that fit a spec.

    :param given: for each level to name, a list of the names of options 1 to k.
    :raises BadInput: there is no such level, or the names are not k different texts.
    """
    counts = {level.name: level.count for level in spec.levels}
    if not counts:
        raise BadInput("there are no options to name; name a run that has options")
    if not isinstance(given, Mapping):
        raise BadInput("is no mapping; write a line for each level, such as: option: [reach, grasp]")
    named = {}
    for level, names in given.items():
        if level not in counts:
            missing = f"there is no level {level!r}{nearest(level, counts)}"
            raise BadInput(f"{missing}; there is: {', '.join(counts)}")
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise BadInput(f"level {level!r}: give a list of texts; quote a number")
        if len(names) != counts[level]:
            raise BadInput(
                f"level {level!r}: {len(names)} names for {counts[level]} options; name each, in the order "
                f"of options 1 to {counts[level]}"
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


def proposed_by_library(spec: Spec) -> Named:
    """The names that the run of a spec's library has now; empty without a library, its run or names.

    :raises BadInput: the names do not fit the spec.
    """
    library = spec.training.library
    return (read_names(Path(library.run), spec) or {}) if library else {}


def write_names(folder: Path, named: Named) -> None:
    """Write ``names.yaml``."""
    text = "# The names of options 1 to k of each level, to be edited by hand; ddco-pyro report shows them.\n"
    write_text(folder / FILE, text + dump_yaml({level: list(names) for level, names in named.items()}))


def matched(
    spec: Spec,
    train: Demonstrations,
    segments: Sequence[Sequence[np.ndarray]],
    trained: TrainedLabels | None = None,
) -> list[NamedByLabel]:
    """The options that stand for labels of the demonstrations that they were trained with.

    An option of a level with ``training.labels`` stands for its own label. Elsewhere options are matched with
    labels so that as many steps as possible agree (Hungarian assignment). An option then stands for its label
    where more than half of its labelled steps have it, and more than half of the label's steps are in it.

    :param segments: the most likely choices of each level, of each demonstration [T].
    """
    levels, known = spec.levels, label_names(train.attributes)
    sources = spec.demonstrations.labels_by_level(len(levels))
    labels = dict(zip((level.name for level in levels), sources, strict=False))
    found: list[NamedByLabel] = []
    for level, choices in zip(levels, segments, strict=True):
        own = trained if trained and trained.level == level.name else None
        label = own.labels if own else labels.get(level.name, "")
        labelled = [row for row, demo in enumerate(train) if label in demo.labels]
        if not labelled or not (own or len(labelled) == len(train)):
            continue
        table = confusion([choices[row] for row in labelled], [train[row].labels[label] for row in labelled])
        steps = np.array(table.steps)  # [labels, options]
        pairs = zip(table.options, table.matched, strict=True)
        for option, value in enumerate(own.values, start=1) if own else pairs:
            if not option or value is None:
                continue
            here = np.equal(table.labels, value)[:, None] & np.equal(table.options, option)
            both = int(steps[here].sum())
            # of the option, of the label
            each = (int(steps[:, here.any(0)].sum()), int(steps[here.any(1)].sum()))
            name = label_name(label, value, known.get(label, ()), level.name)
            taken = name in (option_name(0), *(one.name for one in found if one.level == level.name))
            if not taken and (own or 2 * both > max(each)):
                share = both / (sum(each) - both) if both else 0.0
                found.append(
                    NamedByLabel(level=level.name, option=option, labels=label, name=name, agreement=share)
                )
    return found


def accepted(spec: Spec, found: Sequence[NamedByLabel]) -> Named:
    """The names with an agreement of :data:`AGREED` or more, and those that ``training.labels`` gives.

    Levels without any are left out.
    """
    named: Named = {}
    for level in spec.levels:
        given = spec.training.labels is not None and spec.training.labels.level == level.name
        here = [one for one in found if one.level == level.name]
        own = {one.option: one.name for one in here if given or one.agreement >= AGREED}
        if own:
            options = range(1, 1 + level.count)
            named[level.name] = tuple(own.get(option, option_name(option)) for option in options)
    return named
