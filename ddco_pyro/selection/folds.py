"""The folds of a cross-validation: the same for every candidate, and kept with the results."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from sklearn.model_selection import KFold

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.record_types import Record
from ddco_pyro.evaluation.schema import read_record
from ddco_pyro.training.networks import Dimensions


class FoldError(BadInput):
    """Demonstrations that cannot be divided as asked, or are divided otherwise in the folder."""


@dataclass(frozen=True)
class Folds:
    """Demonstrations ``demos`` and, for each fold, the names of those that are ``held_out``.

    :param dimensions: the dimensions of all the demonstrations, so that networks and what they score are the same in
        every fold, and in the fit that follows.
    """

    demos: Demonstrations
    held_out: tuple[tuple[str, ...], ...]
    dimensions: Dimensions

    def split(self, fold: int) -> tuple[Demonstrations, Demonstrations]:
        """The demonstrations to train with in a fold, and those to score on."""
        out = set(self.held_out[fold])
        train = [name for name in self.demos.names if name not in out]
        return self.demos.select(train), self.demos.select(self.held_out[fold])


def divide(demos: Demonstrations, folds: int, seed: int) -> Folds:
    """Folds over all demonstrations, or over those to train with where the file has masks: what its author set apart to
    validate with is not touched.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    used = demos.split(0.5, seed)[0] if demos.masks.keys() & {"train", "valid"} else demos
    held_out = tuple(tuple(used.names[row] for row in rows) for rows in assign(len(used), folds, seed))
    return Folds(used, held_out, replace(Dimensions.of(demos), steps=max(used.lengths)))


def assign(count: int, folds: int, seed: int) -> list[list[int]]:
    """The numbers of the demonstrations held out in each fold: a partition of 0 to count - 1, as even as can be.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    if folds > count:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations; use at most {count}")
    if count - -(-count // folds) < 2:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations leave less than 2 to train with")
    shuffled = KFold(folds, shuffle=True, random_state=seed).split(np.zeros(count))
    return [sorted(int(row) for row in held_out) for _, held_out in shuffled]


def keep(folds: Folds, path: Path) -> None:
    """Write the folds, or see that those already there are the same.

    :raises Damaged: they cannot be read.
    :raises FoldError: those are others.
    """
    text = json.dumps({"folds": folds.held_out}, indent=1) + "\n"
    if path.exists() and path.read_bytes() != text.encode():
        read_record(path, _Kept, "remove it and do the same again")
        raise FoldError(f"{path}: another version divided these demonstrations otherwise; choose another --out")
    if not path.exists():
        write_text(path, text)


class _Kept(Record):
    folds: list[list[str]]
