"""Merging two options of a run, and training again from the merged segments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources.recording import LABEL_NAMES, label_names
from ddco_pyro.data.tensors import digest_of
from ddco_pyro.errors import BadInput
from ddco_pyro.events import OnEvent, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.spec.base import nearest
from ddco_pyro.training.checkpoint import copy_of

LABELS = "merged"
"""Name of the labels with the option of each step, and of the attribute that describes the merge."""


class MergeError(BadInput):
    """Options that cannot be merged."""


@dataclass(frozen=True)
class Pair:
    """Two options of a level.

    :param level: 0 is the lowest.
    :param options: their numbers, 1 is the first; the second becomes the first.
    :param divergence: how differently they act, nats per step over the time that one of them is active; None where one
        of them is never active.
    """

    level: int
    options: tuple[int, int]
    divergence: float | None


def merge(run: Fit, pair: Pair, out: str | Path | None = None, on_event: OnEvent = ignore, jobs: int = 1) -> Fit:
    """Fit the run's spec with one option fewer, initialised by the run's segments with two options as one.

    The other levels are trained anew. The new run keeps a copy of the demonstrations with the labels of the merged
    segments, the pair, and the digest of the run's networks.

    :param out: the new run folder; None to write nothing.
    :raises MergeError: the level has one option or was trained from labels, or the folder is of another merge.
    """
    changed = merged_spec(run.spec, pair.level)
    level = changed.hierarchy.levels[pair.level].name if changed.hierarchy else ""
    origin = {"level": level, "options": pair.options, "networks": digest_of(copy_of(run.hierarchy), {})}
    if out is not None:
        _check_same(Path(out), json.loads(json.dumps(origin)))
    demos = merged_labels(run, pair)
    names = label_names(demos.attributes) | {LABELS: _merged_names(run, pair)}
    about = {LABELS: json.dumps(origin), LABEL_NAMES: json.dumps(names)}
    demos = replace(demos, attributes={**demos.attributes, **about})
    return fit(changed, demos, out=out, on_event=on_event, jobs=jobs)


def _merged_names(run: Fit, pair: Pair) -> list[str]:
    """The names of the merged labels; none where the level has none."""
    level, (first, second) = [*run.names][pair.level], pair.options
    names = list(run.named.get(level, ()))
    if names:
        names[first - 1] += f" + {names.pop(second - 1)}"
    return names


def _check_same(folder: Path, origin: Mapping[str, Any]) -> None:
    """Refuse a folder that holds another merged run.

    :raises MergeError: the folder is of another pair or of another run.
    """
    path = folder / "demonstrations.hdf5"
    if not path.exists():
        return
    told = json.loads(str(Demonstrations.read(path, []).attributes.get(LABELS, "null")))
    if told == origin:
        return
    if told is None:
        what = "does not say which options it merged"
    elif told["networks"] != origin["networks"]:
        what = "holds options of another run, merged"
    else:
        first, second = told["options"]
        what = f"holds options {first} and {second} of level {told['level']!r}, merged"
    raise MergeError(f"{folder}: {what}; choose another --out or remove it")


def chosen(run: Fit, level: str | None = None, options: tuple[int, int] | None = None) -> Pair:
    """The pair of options to merge: by default the pair of the level that acts most alike.

    :param level: the name of the level; by default the lowest.
    :raises MergeError: there is no such level, or there are no such options.
    """
    levels = run.spec.hierarchy.levels if run.spec.hierarchy else ()
    names = [one.name for one in levels]
    if not names:
        raise MergeError(f"{run.place}: is a policy without options; there are none to merge")
    if level is not None and level not in names:
        raise MergeError(f"there is no level {level!r}{nearest(level, names)}; there is: {', '.join(names)}")
    number = 0 if level is None else names.index(level)
    count, alike = levels[number].count, _divergences(run, number)
    if options is None:
        if not alike:
            raise MergeError(
                f"{run.place}: no two options of level {names[number]!r} are used; there are none to merge"
            )
        options = min(alike, key=alike.__getitem__)
    first, second = sorted(options)
    if not 1 <= first < second <= count:
        asked = f"{options[0]} and {options[1]}"
        raise MergeError(f"options {asked} of level {names[number]!r}: give two different ones from 1 to {count}")
    return Pair(number, (first, second), alike.get((first, second)))


def _divergences(run: Fit, level: int) -> dict[tuple[int, int], float]:
    """The divergence of each pair of used options of a level."""
    rows = run.metrics.divergences[level]
    return {row.options: row.divergence for row in rows if row.divergence is not None}


def merged_spec(spec: Spec, level: int) -> Spec:
    """The spec with one option fewer at a level (0 is the lowest), initialised by labels.

    :raises MergeError: the level has one option, or labels name its options already.
    """
    assert spec.hierarchy is not None  # or there would be no pair
    own = spec.hierarchy.levels[level]
    if own.count == 1:
        raise MergeError(f"level {own.name!r} has one option; there are none to merge")
    if spec.training.labels is not None and spec.training.labels.hold:
        raise MergeError("training.labels says which options there are; join two of the labels in the file instead")
    changes: dict[str, Any] = {
        f"hierarchy.levels.{level}.count": own.count - 1,
        "training.labels": {"level": own.name, "from": LABELS, "hold": False},
    }
    if "random" in spec.training.starts:  # which would not begin from anything
        changes["training.starts"] = ["vq"]
    return with_overrides(spec, changes)


def merged_labels(run: Fit, pair: Pair) -> Demonstrations:
    """The run's demonstrations, labelled by their most likely options from 0 on, with two options as one.

    The label is -1, unknown, where a caller emits the control itself (choice 0).
    """
    demos = run.demonstrations
    first, second = pair.options

    def renumbered(choices: np.ndarray) -> np.ndarray:
        joined = np.where(choices == second, first, choices)
        return np.where(joined > second, joined - 1, joined) - 1

    each = zip(demos, run.segment(demos)[pair.level], strict=True)
    labelled = (replace(demo, labels=dict(demo.labels) | {LABELS: renumbered(choices)}) for demo, choices in each)
    return replace(demos, demonstrations=tuple(labelled))
