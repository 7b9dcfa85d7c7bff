"""Segments that people made in other tools, as labels of demonstrations; to add a tool, write its reader and a row."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np

from ddco_pyro.data.hdf5 import Attribute
from ddco_pyro.data.sources import Recording, Source
from ddco_pyro.data.sources.recording import BOUNDARY, LABEL_NAMES, UNKNOWN, label_names, of_array
from ddco_pyro.errors import BadInput, nearest


class Span(NamedTuple):
    """A segment.

    :param labels: the name of the labels that it belongs to, such as that of a tier.
    :param name: what it is; empty where that is left open.
    :param start: in steps, which are rounded; ``stop`` is exclusive.
    """

    demo: str
    labels: str
    name: str
    start: float
    stop: float


@dataclass
class Annotations:
    """What a file says.

    :param names: for labels by name, what its segments can be, in the order of their numbers; others follow.
    :param notes: a line for each thing in the file that is left out.
    """

    spans: list[Span] = field(default_factory=list)
    names: dict[str, Sequence[str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


Read = Callable[[Path, Collection[str], float], Annotations]
"""Reads a file, given the demonstrations' names and their steps per second; damage is any error."""


class Reader(NamedTuple):
    """A tool.

    :param read: ``module:function`` in :mod:`ddco_pyro.segmenting.formats`, a :data:`Read`.
    :param files: ends of the names of its files.
    :param text: in words.
    """

    read: str
    files: tuple[str, ...]
    text: str


READERS = {
    "ELAN": Reader("elan:read", (".eaf",), "ELAN's .eaf of a demonstration, or a folder of them"),
    "Label Studio": Reader("label_studio:read", (".json",), "Label Studio's JSON export"),
    "BORIS": Reader("boris:read", (".boris", ".tsv", ".csv"), "a project of BORIS or its exported events (.tsv, .csv)"),
}


def read(path: Path, demos: Collection[str], rate: float) -> tuple[Annotations, list[Path]]:
    """The segments of a file or of all files in a folder that one tool made, and these files.

    :raises BadInput: it is no such file, or is damaged.
    """
    if path.is_dir():
        inside = sorted(one for one in path.iterdir() if one.is_file())
    else:
        inside = [path] if path.exists() else []
    for reader in READERS.values():
        files = [one for one in inside if one.suffix.lower() in reader.files]
        if files:
            break
    else:
        known = "; ".join(reader.text for reader in READERS.values())
        raise BadInput(f"--labels {path}: {'is nothing that can be read' if path.exists() else 'is missing'}; {known}")
    found: Read = resolve_name(f"ddco_pyro.segmenting.formats.{reader.read}")
    every = Annotations()
    for file in files:
        try:
            one = found(file, demos, rate)
        except BadInput as error:
            raise BadInput(f"{file}: {error}") from None
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, SyntaxError, RecursionError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            raise BadInput(f"{file}: cannot be read as {reader.text}, or is damaged: {why}") from None
        every.spans += one.spans
        every.notes += [f"{file}: {note}" for note in one.notes]
        every.names = {**one.names, **every.names}
    return every, files


class Labelled:
    """A source whose recordings have the labels that a file says; those of the same name are replaced.

    Steps of which it says nothing are -1. Labels keep the numbers that names have in the source.

    :ivar counts: for labels by name, the demonstrations in which a step is named.
    :ivar notes: a line for each thing in the file that is left out.

    :param rate: steps per second; None for those of the source, or one where it does not say.
    :raises BadInput: the file cannot be read, or does not fit the demonstrations.
    """

    def __init__(self, source: Source, path: Path, rate: float | None = None) -> None:
        self._source = source
        self.format, self.names, self.masks = source.format, source.names, source.masks
        self.frequency = rate or source.frequency
        annotations, files = read(path, source.names, self.frequency or 1.0)
        self.files = (*source.files, *files)
        self.notes = annotations.notes
        known = label_names(source.attributes)
        listed = {span.labels: list[str]() for span in annotations.spans if span.name}
        if not listed:
            raise BadInput(f"--labels {path}: names no segment")
        for labels, names in listed.items():
            if labels in ("", ".", "..") or "/" in labels:
                raise BadInput(f"--labels {path}: {labels!r} cannot be a name of labels; give it another one")
            found = (span.name for span in annotations.spans if span.name and span.labels == labels)
            for name in (*known.get(labels, ()), *annotations.names.get(labels, ()), *found):
                if name not in names or len(names) < len(known.get(labels, ())):
                    names.append(name)
        self._labels: dict[str, dict[str, np.ndarray]] = {labels: {} for labels in listed}
        for span in annotations.spans:
            if span.demo not in self.names:
                raise BadInput(
                    f"--labels {path}: there is no demonstration {span.demo!r}{nearest(span.demo, self.names)}"
                )
            if span.name:
                try:
                    self._paint(span, listed[span.labels].index(span.name))
                except BadInput as error:
                    raise BadInput(f"--labels {path}: {span.demo}: {span.labels}: {error}") from None
        self.counts = {labels: len(each) for labels, each in self._labels.items()}
        self.attributes: Mapping[str, Attribute] = {**source.attributes, LABEL_NAMES: json.dumps(known | listed)}

    def _paint(self, span: Span, label: int) -> None:
        steps = self._source.recording(span.demo).actions.shape[0]
        labels = self._labels[span.labels].setdefault(span.demo, np.full(steps, UNKNOWN, np.int16))
        start, stop = round(span.start), round(span.stop)
        seconds = "" if self.frequency else "; without --fps a step is one second"
        if not 0 <= start <= stop <= steps:
            raise BadInput(f"{span.name} lasts from step {start} to {stop}, but there are {steps} steps{seconds}")
        if start == stop:
            raise BadInput(f"{span.name} at step {start} is shorter than a step; remove or lengthen it{seconds}")
        if (labels[start:stop] != UNKNOWN).any():
            at = start + int((labels[start:stop] != UNKNOWN).argmax())
            raise BadInput(
                f"{span.name} and another segment overlap at step {at}; a step has one label: end one of them"
            )
        labels[start:stop] = label

    def recording(self, name: str) -> Recording:
        """One recording, with its labels."""
        recording = self._source.recording(name)
        unknown = np.full(recording.actions.shape[0], UNKNOWN, np.int16)
        stale = {f"{labels}{end}" for labels in self._labels for end in ("", BOUNDARY)}
        kept = {key: column for key, column in recording.labels.items() if key not in stale}
        given = {labels: of_array(each.get(name, unknown)) for labels, each in self._labels.items()}
        return replace(recording, labels={**kept, **given})


def parsed(path: Path) -> Any:
    """The contents of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8-sig"))
