"""What a person has said of the options of one level, with undo and redo without end.

A document knows no model. Every edit is a list of changes that undo each other, so a list of edits is the document.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

FREE, OPEN = -1, -2
"""Steps of which nothing is said, and steps that are left open on purpose; both are -1 in files."""

Change = tuple[Any, ...]
"""("paint", demonstration, start, stop, option), ("cut", demonstration, step, whether), ("accept", demonstration,
whether, steps of it that were expected wrong, steps of it that were) or ("names", names of the options 1 to k)."""


@dataclass
class Document:
    """The labels of every demonstration.

    :param lengths: steps of each demonstration, by name.
    :param names: of the options 1 to k.
    :ivar labels: of each demonstration [T]: an option 1 to k, :data:`FREE` or :data:`OPEN`.
    :ivar cuts: steps at which a segment begins although the option stays.
    :ivar accepted: demonstrations that a person is done with: of each the steps whose first proposal was expected to be
        wrong, and the steps in which it was.
    :ivar undone: edits that can be done again, the next one last.
    """

    lengths: Mapping[str, int]
    names: tuple[str, ...]
    labels: dict[str, np.ndarray] = field(init=False)
    cuts: dict[str, set[int]] = field(init=False)
    accepted: dict[str, tuple[float, int]] = field(init=False, default_factory=dict)
    done: list[tuple[Change, ...]] = field(init=False, default_factory=list)
    undone: list[tuple[Change, ...]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.labels = {name: np.full(length, FREE, np.int16) for name, length in self.lengths.items()}
        self.cuts = {name: set() for name in self.lengths}

    def edit(self, changes: Sequence[Change]) -> None:
        """Make an edit; what was undone can no longer be done again."""
        self.done.append(self._apply(changes))
        self.undone.clear()

    def undo(self) -> None:
        """Take the last edit back."""
        self.undone.append(self._apply(self.done.pop()))

    def redo(self) -> None:
        """Make the edit again that was taken back last."""
        self.done.append(self._apply(self.undone.pop()))

    def said(self, name: str) -> np.ndarray:
        """Whether a person has named each step, [T]."""
        return self.labels[name] > 0

    def in_file(self, name: str) -> np.ndarray:
        """The labels of a demonstration, [T]; -1 where nothing is said."""
        return np.where(self.said(name), self.labels[name], FREE).astype(np.int16)

    def _apply(self, changes: Sequence[Change]) -> tuple[Change, ...]:
        """Make changes, and give those that take them back."""
        return tuple(back for change in changes for back in self._change(*change))[::-1]

    def _change(self, kind: str, *of: Any) -> list[Change]:
        if kind == "names":
            back: Change = ("names", self.names)
            self.names = tuple(of[0])
            return [back]
        name = of[0]
        if kind == "paint":
            start, stop, option = of[1:]
            labels = self.labels[name]
            edges = [start, *(np.flatnonzero(np.diff(labels[start:stop])) + start + 1).tolist(), stop]
            backs: list[Change] = [("paint", name, one, after, int(labels[one])) for one, after in pairwise(edges)]
            labels[start:stop] = option
            return backs
        if kind == "cut":
            step, whether = of[1:]
            before = step in self.cuts[name]
            (self.cuts[name].add if whether else self.cuts[name].discard)(step)
            return [("cut", name, step, before)]
        known = self.accepted.pop(name, None)
        if of[1]:
            self.accepted[name] = (of[2], of[3])
        return [("accept", name, known is not None, *(known or (0.0, 0)))]
