"""What became of the trials in a bin: one attempt to grasp after another, and how the bin ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from .objects import ACCEPTED

MOST_STEPS = 20  # control steps of a trial; the supervisor takes 10
MOST_MISSES = 4  # attempts in a row that bring nothing into a cup


def most_attempts(objects: int) -> int:
    """How many attempts a bin with so many objects has: every fourth at least has to bring one into a cup."""
    return MOST_MISSES * objects


class End(Enum):
    """How a bin ended."""

    CLEARED = "cleared"  # all objects are in cups
    # four attempts in a row brought not exactly one object into a cup, or too many were made
    MISSED = "missed"
    LOST = "lost"  # an object lies outside of bin and cups
    UNSEEN = "unseen"  # objects are left, and none is seen
    FOAM = "foam"  # the jaws were pressed further into the foam than it gives way
    UNSTABLE = "unstable"  # the simulation broke down, or a control was not finite


@dataclass(frozen=True)
class Attempt:
    """A grasp, from where the jaws closed to where they opened.

    :param before: how many objects were in the bin.
    :param lifted: the objects that the jaws first lifted.
    :param carried: those that they held when they opened.
    :param places: where the latter then were, or where the gripper was that held none; empty where the jaws
        did not open before the trial's time was over.
    :param steps: how many control steps it took.
    """

    before: int
    lifted: frozenset[int]
    carried: frozenset[int]
    places: tuple[str, ...]
    steps: int

    @property
    def single(self) -> bool:
        """Whether exactly one object was lifted."""
        return len(self.lifted) == 1

    @property
    def returned(self) -> bool:
        """Whether the load, or nothing, was let go over the bin."""
        return bool(self.places) and all(place == "bin" for place in self.places)

    @property
    def delivered(self) -> bool:
        """Whether exactly one object was brought into a cup."""
        return len(self.carried) == 1 and self.places[:1] in (("accept",), ("reject",))


@dataclass
class Trials:
    """The attempts in a bin with objects of these kinds, how many control steps the trial at hand has had,
    and how the bin ended.
    """

    kinds: Sequence[str]
    attempts: list[Attempt] = field(default_factory=list)
    steps: int = 0
    end: End | None = None

    def add(self, attempt: Attempt) -> None:
        """A trial is over."""
        self.attempts.append(attempt)
        self.steps = 0

    def missed(self) -> bool:
        """Whether the last four attempts brought nothing into a cup, or there were four for each object: so a
        bin ends even where objects come back.
        """
        last = self.attempts[-MOST_MISSES:]
        if len(self.attempts) >= most_attempts(len(self.kinds)):
            return True
        return len(last) == MOST_MISSES and not any(attempt.delivered for attempt in last)

    def measures(self) -> dict[str, float]:
        """Counts over the bin, and how it ended.

        ``success``: it was cleared, and every object into its own cup; ``cleared``: into either. Of attempts:
        ``single``, ``empty`` and ``several`` by how many objects were first lifted, ``slipped`` where fewer
        were left when the jaws opened. One that holds one object when the jaws open is to be delivered
        (``due_cups``, of them ``kept`` not dropped into the bin, ``delivered`` into a cup and ``sorted`` into
        its own), another one is to be recovered from (``due_recoveries``, of them ``recovered``): opened over
        the bin. ``nothing`` and ``nothing_recovered`` are those of the latter two that hold nothing.
        """
        attempts = [attempt for attempt in self.attempts if attempt.places]
        loaded = [attempt for attempt in attempts if len(attempt.carried) == 1]
        others = [attempt for attempt in attempts if len(attempt.carried) != 1]
        nothing = [attempt for attempt in others if not attempt.carried]
        delivered = [attempt for attempt in loaded if attempt.delivered]
        in_own_cups = sum(self.own_cup(*attempt.carried) == attempt.places[0] for attempt in delivered)
        cleared = self.end is End.CLEARED
        counts = {
            "objects": len(self.kinds),
            "attempts": len(self.attempts),
            "single": sum(attempt.single for attempt in self.attempts),
            "empty": sum(not attempt.lifted for attempt in self.attempts),
            "several": sum(len(attempt.lifted) > 1 for attempt in self.attempts),
            "slipped": sum(len(attempt.carried) < len(attempt.lifted) for attempt in self.attempts),
            "due_cups": len(loaded),
            "kept": sum(not attempt.returned for attempt in loaded),
            "delivered": len(delivered),
            "sorted": in_own_cups,
            "due_recoveries": len(others),
            "recovered": sum(attempt.returned for attempt in others),
            "nothing": len(nothing),
            "nothing_recovered": sum(attempt.returned for attempt in nothing),
        }
        all_sorted = cleared and in_own_cups == len(self.kinds)
        ends = {f"ended_{end.value}": self.end is end for end in End if end is not End.CLEARED}
        rates = {"success": all_sorted, "cleared": cleared, **ends}
        return {name: float(value) for name, value in (rates | counts).items()}

    def own_cup(self, number: int) -> str:
        """The cup that an object belongs into."""
        return "accept" if self.kinds[number] == ACCEPTED else "reject"
