"""Several annotators of the same demonstrations: whose turn each demonstration is, and how they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddco_pyro.data.labels import UNKNOWN
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import compared
from ddco_pyro.evaluation.inferred import runs
from ddco_pyro.labelling.document import FREE, OPEN, PAINT, Change, Document

TOLERANCE = 5
"""Steps between boundaries that match."""


@dataclass(frozen=True)
class Team:
    """Annotators who share the same demonstrations out.

    :param me: who labels here; empty for a single annotator.
    :param members: all annotators; empty where nothing is shared out.
    :param twice: the share of demonstrations that two annotators label.
    :raises BadInput: a name is no part of a file name, is there twice, or ``me`` is no member.
    """

    me: str = ""
    members: tuple[str, ...] = ()
    twice: float = 0.0

    def __post_init__(self) -> None:
        for name in (self.me, *self.members):
            if name and not name.replace("-", "").replace("_", "").isalnum():
                raise BadInput(f"--annotator {name}: use letters, digits, - and _")
        if self.members and (self.me not in self.members or len({*self.members}) < len(self.members)):
            wanted = "name each annotator once, and yourself with --annotator"
            raise BadInput(f"--team {','.join(self.members)}: {wanted}")
        if self.twice and len(self.members) < 2:
            raise BadInput("--twice: two annotators share demonstrations; name them with --team")

    def shares(self, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """Who labels each demonstration: everyone as many, to one; the same for each of the annotators.

        The order in which demonstrations are dealt depends on their number alone.
        """
        if not self.members:
            return dict.fromkeys(names, ())
        members, found, at = sorted(self.members), dict[str, tuple[str, ...]](), 0
        doubled = round(self.twice * len(names))
        for place, index in enumerate(np.random.default_rng(len(names)).permutation(len(names)).tolist()):
            count = 2 if place < doubled else 1
            found[names[index]] = tuple(members[(at + n) % len(members)] for n in range(count))
            at += count
        return {name: found[name] for name in names}


def agreement(mine: Document, theirs: Document, names: Sequence[str]) -> dict[str, Any] | None:
    """How two annotators agree on demonstrations; None where they said nothing of the same steps.

    :returns: Cohen's κ (None where there is one name alone), F1 of boundaries within :data:`TOLERANCE`, and
        the share of the steps that both said in which the names are the same.
    """
    pairs = [(mine.in_file(name), theirs.in_file(name)) for name in names]
    known = [["", *mine.names], ["", *theirs.names]]
    if not any(((a != UNKNOWN) & (b != UNKNOWN)).any() for a, b in pairs):
        return None
    found = compared("option", pairs, known, TOLERANCE)
    return {"kappa": found.kappa, "boundary_f1": found.boundary_f1, "same": found.same / found.both}


def taken(mine: Document, theirs: Document, name: str) -> list[Change]:
    """The changes that make one's labels of a demonstration those of another annotator, by names."""
    new = [text for text in theirs.names if text not in mine.names]
    names = [*mine.names, *new]
    numbers = {n: names.index(text) + 1 for n, text in enumerate(theirs.names, start=1)}
    numbers |= {FREE: FREE, OPEN: OPEN}
    labels = theirs.labels[name]
    segments = runs(labels, np.diff(labels, prepend=-9))
    painted = [(PAINT, name, start, stop, numbers[value]) for value, start, stop in segments]
    cuts = [("cut", name, step, True) for step in sorted(theirs.cuts[name])]
    gone = [("cut", name, step, False) for step in sorted(mine.cuts[name] - theirs.cuts[name])]
    return [("names", names), *painted, *cuts, *gone]
