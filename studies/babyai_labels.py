"""What a BabyAI bot is about, told by its stack of subgoals and its mission. Needs no package.

A mission is a tree of instructions (``BeforeInstr``, ``AfterInstr``, ``AndInstr`` with ``instr_a`` and ``instr_b``)
whose leaves the bot follows one after another. Its stack begins with the subgoals of all leaves, the first leaf's on
top.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

SUBGOALS = ("GoNextTo", "GoNextTo PutNext", "GoNextTo Open", "Explore", "Open", "Close", "Pickup", "Drop")
"""Kinds of subgoals; the reason of going somewhere is part of the kind."""

INSTRUCTIONS = ("GoTo", "Pickup", "Open", "PutNext")

MOST = 4
"""Leaves of BabyAI's largest mission."""

NONE = -1

_PUSHED = {"GoTo": 1, "Open": 2, "Pickup": 3, "PutNext": 4}
"""Subgoals with which the bot begins, for each kind of leaf."""


def leaves(mission: Any) -> list[Any]:
    """The instructions of a mission in the order in which the bot follows them."""
    parts = {"BeforeInstr": "ab", "AndInstr": "ab", "AfterInstr": "ba"}.get(type(mission).__name__)
    return [leaf for part in parts for leaf in leaves(getattr(mission, f"instr_{part}"))] if parts else [mission]


def kind(leaf: Any) -> str:
    """What an instruction asks for, of :data:`INSTRUCTIONS`."""
    return type(leaf).__name__.removesuffix("Instr")


def done(mission: Any, whole: bool = False) -> list[bool]:
    """Which leaves the environment has seen fulfilled, in the order of :func:`leaves`.

    :param whole: whether all of the mission is known to be.
    """
    parts = {"BeforeInstr": "ab", "AndInstr": "ab", "AfterInstr": "ba"}.get(type(mission).__name__, "")
    found = [
        done(getattr(mission, f"instr_{part}"), whole or getattr(mission, f"{part}_done") == "success")
        for part in parts
    ]
    return [one for own in found for one in own] if parts else [whole]


class Stack(list[Any]):
    """A bot's stack of subgoals, which knows for each of them the leaf that it serves.

    The bot looks at the top one and lets it act; what that one pushes, perhaps in its own place, serves the same leaf.

    :param subgoals: those with which the bot begins.
    :param mission: what it begins with.
    :raises ValueError: they are not as many as the mission's leaves push.
    """

    def __init__(self, subgoals: Iterable[Any], mission: Any) -> None:
        super().__init__(subgoals)
        pushed = [_PUSHED[kind(leaf)] for leaf in leaves(mission)]
        if sum(pushed) != len(self):
            raise ValueError(f"the bot begins with {len(self)} subgoals, not {sum(pushed)}")
        self._leaf = [number for number, count in reversed(list(enumerate(pushed))) for _ in range(count)]
        self._acting = NONE

    def __getitem__(self, place: Any) -> Any:
        self._acting = self._leaf[place]
        return super().__getitem__(place)

    def append(self, subgoal: Any) -> None:
        """Push what the acting subgoal wants first."""
        super().append(subgoal)
        self._leaf.append(self._acting)

    def pop(self, place: Any = -1) -> Any:
        """Take off the top one."""
        self._leaf.pop(place)
        return super().pop(place)

    @property
    def instruction(self) -> int:
        """The number of the leaf that the top one serves; :data:`NONE` once nothing is left to do."""
        return self._leaf[-1] if self._leaf else NONE


def subgoal(stack: Sequence[Any]) -> int:
    """The kind of the subgoal on top, as its number in :data:`SUBGOALS`; :data:`NONE` for an empty stack.

    :raises ValueError: it is of no known kind.
    """
    if not stack:
        return NONE
    name, reason = type(stack[-1]).__name__.removesuffix("Subgoal"), stack[-1].reason
    if name == "GoNextTo" and reason == "Explore":
        name = reason
    elif name == "GoNextTo" and reason:
        name = f"{name} {reason}"
    if name not in SUBGOALS:
        raise ValueError(f"there is no kind of subgoal {name!r}")
    return SUBGOALS.index(name)
