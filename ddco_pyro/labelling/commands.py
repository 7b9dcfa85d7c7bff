"""What a person asks for on the page, as changes of the labels."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddco_pyro.data.labels import SOURCES
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.inferred import runs
from ddco_pyro.labelling.document import CONFIRM, FREE, MARKS, OPEN, PAINT, Change, Document
from ddco_pyro.labelling.proposals import Shown, first_wrong, labels_shown, sources_shown

LONGEST = 80
"""Characters of a name."""


@dataclass(frozen=True)
class Segment:
    """A segment that is shown: an option 0 to k from one step to before another.

    :param source: who says so, one of :data:`~ddco_pyro.data.labels.SOURCES`; an open segment's option is 0.
    """

    start: int
    stop: int
    option: int
    source: str


@dataclass(frozen=True)
class View:
    """What a person looks at: the labels, and what is shown of each demonstration.

    :param first: what was shown before anything was said of a demonstration.
    """

    document: Document
    shown: Mapping[str, Shown]
    first: Mapping[str, Shown]

    def segments(self, name: str) -> list[Segment]:
        """The segments of a demonstration that are shown."""
        level = labels_shown(self.document, name, self.shown[name])
        sources = sources_shown(self.document, name)
        return [
            Segment(start, stop, max(option, 0), SOURCES[sources[start:stop].min()])
            for option, start, stop in level.runs()
        ]

    def at(self, name: str, step: int) -> Segment:
        """The segment of a step.

        :raises BadInput: the demonstration has no such step.
        """
        for segment in self.segments(name):
            if segment.start <= step < segment.stop:
                return segment
        raise BadInput(f"{name}: has no step {step}; it has {self.document.lengths[name]}")

    def changes(self, do: str, name: str | None, command: Mapping[str, Any]) -> list[Change]:
        """The changes of the document that a command stands for.

        :param name: of the demonstration; None for commands that concern none.
        :raises BadInput: the command is none, or cannot be done here.
        """
        names, colours = self.document.names, self.document.colours
        if do == "new":
            return [("names", [*names, self._text(command, names)])]
        if do == "rename":
            option = self._option(command, 1)
            before, old, after = names[: option - 1], names[option - 1], names[option:]
            new = self._text(command, (*before, *after))
            colour_changes = [("colour", old, None), ("colour", new, colours.get(old))]
            return [("names", [*before, new, *after]), *colour_changes]
        if do == "drop":
            return self._drop(self._option(command, 1), self._option(command, 0, "into"))
        if do == "colour":
            colour = command.get("colour")
            if not isinstance(colour, str) or not re.fullmatch("#[0-9a-f]{6}", colour):
                raise BadInput("colour: write it as #rrggbb")
            return [("colour", names[self._option(command, 1) - 1], colour)]
        if name is None:
            raise BadInput(f"{do}: names no demonstration, or is no command")
        if do == "mark":
            mark, value = command.get("mark"), command.get("value")
            if mark not in MARKS or not isinstance(value, str if mark == "note" else bool):
                raise BadInput(f"mark: give one of {', '.join(MARKS)}, and a value")
            return [("mark", name, mark, value or None)]
        if do == "accept":
            return [] if name in self.document.accepted else self._accept(name, command.get("segments"))
        if do == "reopen":
            return [("accept", name, False, 0.0, 0)]
        if do == "paint":
            start, stop = (whole(command, key) for key in ("start", "stop"))
            if not 0 <= start < stop <= self.document.lengths[name]:
                has = self.document.lengths[name]
                raise BadInput(f"paint: steps {start} to {stop} are not in {name}, which has {has}")
            return [(PAINT, name, start, stop, self._option(command, 0) or OPEN)]
        if do == "move":
            return self._move(name, whole(command, "boundary"), whole(command, "to"))
        step = whole(command, "step")
        here = self.at(name, step)
        if do in ("name", "open"):
            reached = here.start, here.stop
            if command.get("from_here"):
                reached = step, self._said_until(name, step)
            return [(PAINT, name, *reached, OPEN if do == "open" else self._option(command, 1))]
        if do == "everywhere":
            option = self._option(command, 1)
            return [
                (PAINT, other, own.start, own.stop, option)
                for other in self.document.lengths
                if other == name or other not in self.document.accepted
                for own in self.segments(other)
                if own.option == here.option and own.source != "open"
            ]
        if do == "split":
            if here.source == "open":
                raise BadInput(f"split: the segment at step {step} of {name} is open; name it first")
            if step == here.start:
                raise BadInput(f"split: a segment of {name} begins at step {step} already")
            return [("cut", name, step, True)]
        if do == "merge":
            if here.stop == self.document.lengths[name]:
                last = f"the segment at step {step} is the last of {name}"
                raise BadInput(f"merge: {last}; it has none to merge with")
            following = self.at(name, here.stop)
            if not here.option:
                raise BadInput(f"merge: the segment at step {step} of {name} has no option; name it first")
            return [("cut", name, here.stop, False), (PAINT, name, here.start, following.stop, here.option)]
        raise BadInput(f"{do}: is no command")

    def _said_until(self, name: str, step: int) -> int:
        """The step before which what was said of a step ends, with all that is proposed alone behind it."""
        said = self.document.labels[name][step:]
        others = np.flatnonzero((said != FREE) & np.logical_or.accumulate(said != said[0]))
        return step + int(min(others, default=len(said)))

    def _drop(self, option: int, into: int) -> list[Change]:
        """An option is none any more: its labels are those of another one, or nothing where that is 0."""
        if option == into or len(self.document.names) == 1:
            raise BadInput("drop: name an option to merge into, and keep one at least")
        document, changes = self.document, list[Change]()
        numbers = np.arange(1 + len(document.names)) - (np.arange(1 + len(document.names)) > option)
        numbers[option] = numbers[into] if into else FREE
        for name, labels in document.labels.items():
            said, given = np.where(labels > 0, labels, 0), document.given[name]
            edges = (np.diff(said, prepend=-1) != 0) | (np.diff(given, prepend=not given[0]) != 0)
            changes += [
                (PAINT if given[start] else CONFIRM, name, start, stop, int(numbers[own]))
                for own, start, stop in runs(said, edges)
                if own and numbers[own] != own
            ]
        kept = [name for number, name in enumerate(document.names, start=1) if number != option]
        return [*changes, ("names", kept)]

    def _accept(self, name: str, seen: Any) -> list[Change]:
        """What a person sees becomes labels where nothing was said.

        :param seen: the first step and the option of each segment that the person sees.
        :raises BadInput: these are no segments of the demonstration.
        """
        labels, last = self.document.labels[name], self.document.lengths[name]
        try:
            starts, options = np.array(seen, np.int64).reshape(-1, 2).T
        except (TypeError, ValueError, OverflowError):
            raise BadInput("accept: segments are pairs of a first step and an option") from None
        lengths = np.diff(starts, append=last)
        if (
            not len(starts)
            or starts[0]
            or lengths.min() < 1
            or not 0 <= options.min() <= options.max() <= len(self.document.names)
        ):
            raise BadInput(f"accept: these are no segments of {name}")
        options = np.where(labels == FREE, np.repeat(options, lengths), 0)
        segments = runs(options, np.diff(options, prepend=-1) != 0)
        confirmed = [(CONFIRM, name, start, stop, option) for option, start, stop in segments if option]
        said = np.where(labels == FREE, options, labels)
        accepted = Shown(np.where(labels == OPEN, self.shown[name].options, said), np.ones(last))
        wrong = first_wrong(self.first.get(name, self.shown[name]), accepted)
        return [*confirmed, ("accept", name, True, *wrong)]

    def _move(self, name: str, boundary: int, to: int) -> list[Change]:
        """A boundary elsewhere: the steps between, and one on either side, are said."""
        own = self.segments(name)
        place = next((n for n, segment in enumerate(own) if n and segment.start == boundary), None)
        if place is None:
            raise BadInput(f"move: no segment of {name} begins at step {boundary}")
        left, right = own[place - 1], own[place]
        if not left.start < to < right.stop:
            beside = f"the segments at both sides of step {boundary} of {name}"
            raise BadInput(f"move: step {to} is not within {beside}")
        sides = [(segment, OPEN if segment.source == "open" else segment.option) for segment in (left, right)]
        low, high = min(boundary, to) - 1, max(boundary, to) + 1
        pairs = zip(sides, ((low, to), (to, high)), strict=True)
        changes: list[Change] = [(PAINT, name, *ends, option) for (_, option), ends in pairs if option]
        if boundary in self.document.cuts[name]:
            changes += [("cut", name, boundary, False), ("cut", name, to, True)]
        return changes

    def _option(self, command: Mapping[str, Any], least: int, key: str = "option") -> int:
        option = whole({"into": 0, **command}, key)
        if not least <= option <= len(self.document.names):
            raise BadInput(f"there is no option {option}; there are {least} to {len(self.document.names)}")
        return option

    def _text(self, command: Mapping[str, Any], others: Sequence[str]) -> str:
        text = command.get("text")
        name = text.strip() if isinstance(text, str) else ""
        if not name or len(name) > LONGEST or not name.isprintable() or name in ("control", *others):
            raise BadInput(f"a name is one line of at most {LONGEST} characters that no other option has")
        return name


def whole(command: Mapping[str, Any], key: str) -> int:
    """The whole number that a command gives.

    :raises BadInput: it gives none.
    """
    value = command.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise BadInput(f"{key}: give a whole number")
    return value
