"""Compact observations of a BabyAI world, [D] each: what has been seen so far, from where the agent stands.

Directions are the agent's: ahead, right, behind, left. Distances are in cells. A thing that has not been in view is
unknown: zeros. Nothing here asks a plan, nor what has been fulfilled, but for ``done``. Needs numpy
alone.

- ``body`` [14]: what is in front (nothing, wall or unseen, open, closed, locked door, key, ball, box); whether a key,
  ball or box is carried; free cells ahead, right and left.
- ``ways`` [24]: for each side of the room: whether a way out is known, whether a closed, a locked door is in it, where
  it is (ahead, right), and which part of the room beyond has not been seen.
- ``instruction_1`` to ``instruction_4`` [26] in the order in which they are to be followed: kind (go to, pick up, open,
  put next), and for its thing, and the one to put it next to: whether it is known, where it is (ahead, right, and the
  signs of these), whether it is in this room, carried, in front, next to the cell in front, open, locked. Of several
  things that fit the description it is what is carried, else the nearest.
- ``done`` [4]: which instructions the environment has seen fulfilled. A pilot who has only eyes has to remember that.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from babyai_labels import INSTRUCTIONS, MOST, done, kind, leaves

AHEAD = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""MiniGrid's directions: right, down, left, up, as (x, y)."""

THING, WAY = 11, 6
KEPT = ("key", "ball", "box")

Observation = dict[str, np.ndarray]


class View:
    """A world as the agent has seen it.

    :param world: MiniGrid's, or anything with ``grid``, ``agent_pos``, ``agent_dir``, ``carrying``, ``room_size``.
    :param seen: which cells have been in view, [width, height].
    """

    def __init__(self, world: Any, seen: np.ndarray) -> None:
        self.grid, self.seen, self.size = world.grid, seen, world.room_size
        self.carried = world.carrying
        self.place = np.array(world.agent_pos)
        self.axes = np.array([AHEAD[(world.agent_dir + turn) % 4] for turn in range(4)])
        self.front = self.place + self.axes[0]
        self.room = self._room()

    def _room(self) -> np.ndarray:
        """The lower corner of the room; a doorway belongs to the room that is ahead, or else on the right."""
        inner = self.size - 1
        number, within = np.divmod(self.place, inner)
        toward = self.axes[0] + self.axes[1]
        return np.asarray((number - ((within == 0) & (toward < 0))) * inner)

    def known(self, place: np.ndarray) -> bool:
        """Whether a cell is in the world and has been seen."""
        return bool((place >= 0).all() and (place < self.seen.shape).all() and self.seen[tuple(place)])

    def cell(self, place: np.ndarray) -> str:
        """What is in a cell: a type of thing, ``nothing`` or ``unseen``; of a door ``open``, ``closed``, ``locked``."""
        if not self.known(place):
            return "unseen"
        thing = self.grid.get(*map(int, place))
        if thing is None:
            return "nothing"
        return _door(thing) if thing.type == "door" else str(thing.type)

    def body(self) -> list[float]:
        """The agent itself, and what is around it."""
        kinds = ("nothing", "wall", "open", "closed", "locked", *KEPT)
        front = self.cell(self.front).replace("unseen", "wall")
        carried = self.carried.type if self.carried else ""
        free = [self._free(self.axes[turn]) for turn in (0, 1, 3)]
        return [*(front == one for one in kinds), *(carried == one for one in KEPT), *free]

    def _free(self, direction: np.ndarray) -> int:
        steps = 1
        while self.cell(self.place + steps * direction) in ("nothing", "open"):
            steps += 1
        return steps - 1

    def ways(self) -> list[float]:
        """The sides of the room in turn, from the one ahead on."""
        return [value for axis in self.axes for value in self._way(axis)]

    def _way(self, axis: np.ndarray) -> list[float]:
        along = np.abs(axis[::-1])
        start = self.room + along + np.where(axis > 0, self.size - 1, 0)
        wall = [start + step * along for step in range(self.size - 2)]
        out = [place for place in wall if self.cell(place) in ("nothing", "open", "closed", "locked")]
        dark = self._dark(self.room + axis * (self.size - 1))
        if not out:
            return [0] * (WAY - 1) + [dark]
        nearest = min(out, key=self._distance)
        now = self.cell(nearest)
        return [1, now == "closed", now == "locked", *self._seen_from_here(nearest), dark]

    def _dark(self, room: np.ndarray) -> float:
        """Which part of the room with this lower corner has not been seen; 0 where there is none."""
        if (room < 0).any() or (room + self.size > self.seen.shape).any():
            return 0.0
        (x, y), inner = room + 1, self.size - 2
        return float(1 - self.seen[x : x + inner, y : y + inner].mean())

    def thing(self, fitting: Iterable[Any]) -> list[float]:
        """One of the things that fit a description, [THING]."""
        ids = {id(one) for one in fitting}
        if self.carried is not None and id(self.carried) in ids:
            return [1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0]
        places = [np.array(place) for place in np.argwhere(self.seen) if id(self.grid.get(*map(int, place))) in ids]
        if not places:
            return [0] * THING
        nearest = min(places, key=self._distance)
        where, now = self._seen_from_here(nearest), self.cell(nearest)
        inside = bool(((nearest > self.room) & (nearest < self.room + self.size - 1)).all())
        to_front = int(np.abs(nearest - self.front).sum())
        near = [inside, False, to_front == 0, to_front == 1, now == "open", now == "locked"]
        return [1, *where, *np.sign(where), *near]

    def instruction(self, leaf: Any) -> list[float]:
        """An instruction, and the things it is about."""
        described = [getattr(leaf, name) for name in ("desc", "desc_move", "desc_fixed") if hasattr(leaf, name)]
        things = [self.thing(one.obj_set) for one in described] + [[0.0] * THING]
        return [*(kind(leaf) == one for one in INSTRUCTIONS), *things[0], *things[1]]

    def _distance(self, place: np.ndarray) -> int:
        return int(np.abs(place - self.place).sum())

    def _seen_from_here(self, place: np.ndarray) -> list[int]:
        """How far ahead and how far to the right."""
        return [int((place - self.place) @ axis) for axis in self.axes[:2]]


def _door(thing: Any) -> str:
    return "open" if thing.is_open else "locked" if thing.is_locked else "closed"


def observation(world: Any, seen: np.ndarray, mission: Any) -> Observation:
    """All observations of now."""
    view, own = View(world, seen), leaves(mission)
    empty = [0.0] * (len(INSTRUCTIONS) + 2 * THING)
    told = [view.instruction(leaf) for leaf in own] + [empty] * (MOST - len(own))
    values = {
        "body": view.body(),
        "ways": view.ways(),
        **{f"instruction_{number}": one for number, one in enumerate(told, start=1)},
        "done": done(mission) + [False] * (MOST - len(own)),
    }
    return {key: np.array(value, np.float32) for key, value in values.items()}
