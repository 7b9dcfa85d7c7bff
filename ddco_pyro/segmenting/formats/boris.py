"""Events of BORIS, read from a project or from the tables that it exports."""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting.formats.reading import Annotations, Span, parsed

BEHAVIOUR, NO_SUBJECT = "behavior", "No focal subject"
"""The name of labels of events without a subject, and what BORIS' tables say then."""


class Event(NamedTuple):
    """The beginning or the end of a state, in seconds; ``modifier`` tells states of the same name apart."""

    observation: str
    subject: str
    behaviour: str
    modifier: str
    time: float


def read(path: Path, demos: Collection[str], rate: float) -> Annotations:
    """State events as segments of the demonstration that their observation is called after.

    Labels are called as the subject, or ``behavior`` without one. In a project, names are numbered as behaviours are
    listed. Point events are left out.

    :raises BadInput: a state has no end, or a table has other columns.
    """
    found, (events, listed, points) = Annotations(), (_project if path.suffix == ".boris" else _table)(path)
    for begin, end in _states(events):
        labels = begin.subject if begin.subject not in ("", NO_SUBJECT) else BEHAVIOUR
        found.names[labels] = listed
        found.spans.append(Span(begin.observation, labels, begin.behaviour, begin.time * rate, end.time * rate))
    if points:
        found.notes.append(f"left out {points} point events, which last no step")
    return found


def _states(events: Iterable[Event]) -> Iterator[tuple[Event, Event]]:
    """The beginning and the end of each state: a state that is going on ends when it is coded again."""
    going: dict[tuple[str, ...], Event] = {}
    for event in sorted(events, key=lambda event: event.time):
        if begin := going.pop(event[:-1], None):
            yield begin, event
        else:
            going[event[:-1]] = event
    for event in going.values():
        raise BadInput(f"{event.observation}: {event.behaviour} at {event.time:g} s has no end; code it in BORIS")


def _project(path: Path) -> tuple[list[Event], list[str], int]:
    """State events, the names of state behaviours, and the number of point events."""
    project = parsed(path)
    lasts = {own["code"]: own["type"].startswith("State") for own in project["behaviors_conf"].values()}
    events = list[Event]()
    for name, observation in project["observations"].items():
        before = float(observation.get("time offset") or 0)
        for time, subject, behaviour, modifier, *_ in observation["events"]:
            events.append(Event(name, subject, behaviour, modifier, float(time) - before))
    states = [event for event in events if lasts[event.behaviour]]
    return states, [code for code, state in lasts.items() if state], len(events) - len(states)


START, STOP, TIME, OFFSET = "Start (s)", "Stop (s)", "Time", "Time offset (s)"


def _table(path: Path) -> tuple[list[Event], list[str], int]:
    """The same of a table of events or of aggregated events, which lists no behaviours."""
    text = path.read_text(encoding="utf-8-sig")
    rows = list(csv.DictReader(text.splitlines(), delimiter="\t" if "\t" in text.partition("\n")[0] else ","))
    needed = {"Observation id", "Subject", "Behavior", "Behavior type"}
    known = set(rows[0]) if rows else set()
    ends = (START, STOP) if {START, STOP} <= known else (TIME,)
    if missing := ({*needed, *ends} - known):
        raise BadInput(f"has no column {', '.join(sorted(missing))}; export events or aggregated events from BORIS")
    events, points = list[Event](), 0
    for row in rows:
        if row["Behavior type"] == "POINT":
            points += 1
            continue
        before = float(row.get(OFFSET) or 0)
        modifier = "|".join(value for key, value in row.items() if key.startswith("Modifier"))
        named = row["Observation id"], row["Subject"], row["Behavior"], modifier
        events += [Event(*named, float(row[end]) - before) for end in ends]
    return events, [], points
