"""Folds of a cross-validation, the same for every candidate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput


class FoldError(BadInput):
    """Demonstrations that cannot be divided into so many folds."""


def divide(demos: Demonstrations, folds: int, seed: int) -> tuple[Demonstrations, ...]:
    """The demonstrations for each fold, with the masks ``train`` and ``valid``, which is held out.

    Folds are over all demonstrations, or over the training ones where the file has masks for that. Each fold has all
    demonstrations: their dimensions decide the networks, which are the same in every fold.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    used = demos.split(0.5, seed)[0].names if demos.masks.keys() & {"train", "valid"} else demos.names
    held_out = [[used[row] for row in rows] for rows in assign(len(used), folds, seed)]
    return tuple(
        replace(demos, masks={"train": tuple(name for name in used if name not in out), "valid": tuple(out)})
        for out in held_out
    )


def assign(count: int, folds: int, seed: int) -> list[list[int]]:
    """The numbers of the demonstrations held out in each fold: a partition of 0 to count - 1, as even as possible.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    from sklearn.model_selection import KFold

    if folds > count:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations; use at most {count}")
    if count - -(-count // folds) < 2:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations leave less than 2 to train with")
    shuffled = KFold(folds, shuffle=True, random_state=seed).split(np.zeros(count))
    return [sorted(int(row) for row in held_out) for _, held_out in shuffled]
