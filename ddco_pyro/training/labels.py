"""Labels that say which option of a level is active in some demonstrations (``training.labels``)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.spec import Spec, SpecError
from ddco_pyro.training.data import train_and_valid, tuning_split
from ddco_pyro.training.networks import Dimensions


@dataclass(frozen=True)
class Labels:
    """Labels of the options of a level.

    :param level: 1 is the lowest.
    :param values: the labels that the options 1, 2, ... stand for.
    :param demonstrations: the names of the demonstrations that have labels, those to train with first.
    :param train: the option of each step of the demonstrations to train with, [N, T]; -1 where it is free.
    :param tune: the same of the demonstrations to tune with.
    :param evidence: what a recogniser says of each choice at steps without labels, [N, T, 1 + k], of both.
    :param starts: the options that the recogniser finds likeliest, [N, T], of both.
    """

    level: int
    values: tuple[int, ...]
    demonstrations: tuple[str, ...]
    train: Tensor
    tune: Tensor
    evidence: tuple[Tensor, Tensor] | None = None
    starts: tuple[Tensor, Tensor] | None = None

    @classmethod
    def of(cls, spec: Spec, train: Demonstrations, tune: Demonstrations) -> Labels | None:
        """The labels that training uses; None where the spec names none.

        :raises SpecError: the demonstrations to train with lack labels, or have more labels than options.
        """
        labels = spec.training.labels
        if labels is None or spec.hierarchy is None:
            return None
        levels = enumerate(spec.hierarchy.levels, 1)
        number, level = next(item for item in levels if item[1].name == labels.level)
        each = (*train, *(() if tune is train else tune))
        used = [demo for demo in each if (demo.labels[labels.source] >= 0).any()]
        values = _distinct(demo.labels[labels.source] for demo in used)
        if not _distinct(demo.labels[labels.source] for demo in train):
            raise SpecError(
                f"training.labels: labels/{labels.source} is -1 at every step of the demonstrations to train "
                "with; leave training.labels out"
            )
        if len(values) > level.count:
            raise SpecError(
                f"training.labels: labels/{labels.source} has {len(values)} labels from 0 on "
                f"({', '.join(map(str, values))}), but level {level.name!r} has {level.count} options; raise "
                f"hierarchy.levels.{number - 1}.count, or say -1 for labels that are no option"
            )
        names = tuple(demo.name for demo in used)
        ours, theirs = (choices(part, labels.source, values, names) for part in (train, tune))
        return cls(number, values, names, ours, theirs)


def used(spec: Spec, demos: Demonstrations) -> Labels | None:
    """The labels that a fit to these demonstrations uses; None where the spec names none.

    :raises SpecError: as :meth:`Labels.of`.
    """
    if spec.training.labels is None:
        return None
    train = train_and_valid(spec, demos)["train"]
    return Labels.of(spec, *tuning_split(spec, Dimensions.of(demos, spec.control.relative_to), train))


def _distinct(labels: Iterable[np.ndarray]) -> tuple[int, ...]:
    """The distinct labels, sorted, without -1."""
    return tuple(sorted({int(value) for array in labels for value in np.unique(array) if value >= 0}))


def choices(demos: Demonstrations, name: str, values: tuple[int, ...], labelled: tuple[str, ...]) -> Tensor:
    """The option of each step, [N, T]; -1 where it is free, and past a demonstration's end."""
    options = []
    for demo in demos:
        labels = demo.labels[name] if demo.name in labelled else np.full(len(demo), -1)
        options.append(torch.as_tensor(np.where(labels >= 0, np.searchsorted(values, labels) + 1, -1)))
    return pad_sequence(options, batch_first=True, padding_value=-1)
