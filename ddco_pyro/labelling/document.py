"""What a person has said of the options of one level, with undo and redo without end, and the file of that.

A document knows no model, and the list of its edits is all of it. Edits are on disk before acknowledgement.
"""

from __future__ import annotations

import errno
import fcntl
import getpass
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import BadInput

FREE, OPEN = -1, -2
"""Steps of which nothing is said, and steps that are left open on purpose; both are -1 in files."""

PAINT, CONFIRM = "paint", "confirm"
"""A person gives steps a label, or accepts the one that is proposed."""

Change = tuple[Any, ...]
"""(:data:`PAINT` or :data:`CONFIRM`, demonstration, start, stop, option), ("cut", demonstration, step,
whether), ("accept", demonstration, whether, steps of it that were expected wrong, steps of it that were),
("mark", demonstration, one of :data:`MARKS`, its value), ("names", names of the options 1 to k) or ("colour",
name of an option, colour)."""

Edit = list[tuple[Any, str, Any]]
"""Values to put into tables of a document: (table, key, value), where None takes the key away."""

MARKS = ("exclude", "flag", "note")
"""What a person can say of a demonstration as a whole: leave it out, look at it again, and a text."""


class Document:
    """The labels of every demonstration.

    :param lengths: steps of each demonstration, by name.
    :param names: of the options 1 to k.
    :ivar labels: of each demonstration [T]: an option 1 to k, :data:`FREE` or :data:`OPEN`.
    :ivar given: whether a person gave each label, rather than accepted what was proposed, bool [T].
    :ivar cuts: steps at which a segment begins although the option stays.
    :ivar accepted: demonstrations that a person is done with: of each the steps whose first proposal was
        expected to be wrong, and the steps in which it was.
    :ivar marks: of each demonstration, the :data:`MARKS` that a person gave it.
    :ivar colours: that a person gave to options, by their names.
    :ivar undone: edits that can be done again, the next one last.
    """

    def __init__(self, lengths: Mapping[str, int], names: tuple[str, ...]) -> None:
        self.lengths, self.names = lengths, names
        self.labels = {name: np.full(length, FREE, np.int16) for name, length in lengths.items()}
        self.given = {name: np.ones(length, bool) for name, length in lengths.items()}
        self.cuts = dict.fromkeys(lengths, frozenset[int]())
        self.accepted, self.colours = dict[str, tuple[float, int]](), dict[str, str]()
        self.marks: dict[str, dict[str, Any]] = {name: {} for name in lengths}
        self.done, self.undone = list[Edit](), list[Edit]()

    def alters(self, change: Change) -> bool:
        """Whether a change makes a difference."""
        return any(not np.array_equal(table.get(key), value) for table, key, value in self._puts(*change))

    def edit(self, changes: Sequence[Change]) -> None:
        """Make an edit; what was undone can no longer be done again."""
        self.done.append(_put(put for change in changes for put in self._puts(*change)))
        self.undone.clear()

    def undo(self) -> None:
        """Take the last edit back."""
        self.undone.append(_put(self.done.pop()))

    def redo(self) -> None:
        """Make the edit again that was taken back last."""
        self.done.append(_put(self.undone.pop()))

    def touched(self, edit: Edit) -> list[str]:
        """The demonstrations of an edit."""
        tables = (self.labels, self.given, self.cuts, self.accepted, self.marks)
        return list(dict.fromkeys(key for table, key, _ in edit if any(table is own for own in tables)))

    def said(self, name: str) -> np.ndarray:
        """Whether a person has named each step, [T]."""
        return self.labels[name] > 0

    def in_file(self, name: str) -> np.ndarray:
        """The labels of a demonstration, [T]; -1 where nothing is said."""
        return np.where(self.said(name), self.labels[name], FREE).astype(np.int16)

    def _puts(self, kind: str, *of: Any) -> Edit:
        """The values that a change puts in place of others, which are never changed themselves."""
        if kind == "names":
            return [(vars(self), "names", tuple(of[0]))]
        if kind == "colour":
            return [(self.colours, *of)]
        name, *what = of
        if kind == "mark":
            mark, value = what
            others = {key: own for key, own in self.marks[name].items() if key != mark}
            return [(self.marks, name, others if value is None else {**others, mark: value})]
        if kind in (PAINT, CONFIRM):
            start, stop, option = what
            labels, given = self.labels[name].copy(), self.given[name].copy()
            labels[start:stop], given[start:stop] = option, kind == PAINT
            return [(self.labels, name, labels), (self.given, name, given)]
        if kind == "cut":
            step, whether = what
            return [(self.cuts, name, self.cuts[name] | {step} if whether else self.cuts[name] - {step})]
        whether, *wrong = what
        return [(self.accepted, name, tuple(wrong) if whether else None)]


def _put(edit: Iterable[tuple[Any, str, Any]]) -> Edit:
    """Put values where an edit says, and give the edit that takes that back."""
    back: Edit = []
    for table, key, value in edit:
        back.append((table, key, table.get(key)))
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return back[::-1]


# --- the file of edits --------------------------------------------------------------------------------------

SUFFIX = ".journal"
"""Of the file of edits, beside the file of labels."""

UNDO, REDO, SAVED = "undo", "redo", "saved"

HEADER = b'{"labels":'
"""What a journal begins with."""


def version(files: Iterable[Path]) -> list[tuple[int, int]]:
    """Size and time of change of files; none of those that are missing."""
    stats = [path.stat() for path in files if path.exists()]
    return [(stat.st_size, stat.st_mtime_ns) for stat in stats]


def digest(demos: Sequence[Demonstration], level: str) -> str:
    """What labels are for: the demonstrations by name, with their controls, and the level."""
    found = hashlib.sha256(json.dumps([level, [(demo.name, demo.actions.shape) for demo in demos]]).encode())
    for demo in demos:
        found.update(demo.actions.tobytes())
    return found.hexdigest()


def replay(path: Path, content: bytes, document: Document, labels: str) -> tuple[int, bool]:
    """Make the edits of a journal.

    :param labels: what the labels are for, as :func:`digest` gives it.
    :returns: the bytes of whole lines, and whether all edits are in the file of labels.
    :raises BadInput: the journal is of other demonstrations.
    :raises Damaged: a line is none of a journal.
    """
    *lines, _ = content.split(b"\n")
    number, saved = 1, True
    try:
        if not HEADER.startswith(content[: len(HEADER)]):
            raise ValueError
        if lines:
            known = json.loads(lines[0])
            if known["labels"] != labels:
                others = "has edits of other demonstrations or of another level"
                raise BadInput(f"{path}: {others}; give another --out")
            document.names = tuple(known["names"])
        for line in lines[1:]:
            number += 1
            entry = json.loads(line)
            saved = _apply(document, entry["edit"] if isinstance(entry, dict) else entry)
    except BadInput:
        raise
    except (ValueError, TypeError, LookupError):
        remedy = "move it away to begin anew, or give another --out"
        raise Damaged(path, f"line {number} is none of a journal of labels", remedy) from None
    return sum(len(line) + 1 for line in lines), saved


def _apply(document: Document, entry: Any) -> bool:
    """Make the edit of a line; whether all edits are in the file of labels then."""
    if entry == UNDO:
        document.undo()
    elif entry == REDO:
        document.redo()
    elif entry != SAVED:
        document.edit([tuple(change) for change in entry])
    return bool(entry == SAVED)


class Journal:
    """A file of edits that one process has open: a line for each, with who made it and when.

    :param path: of the file; it is made where it is missing.
    :param document: gets the edits of the file.
    :param labels: what the labels are for, as :func:`digest` gives it.
    :param annotator: who makes edits.
    :ivar saved: whether all edits are in the file of labels.
    :raises BadInput: another process has the file, or it is of other demonstrations.
    :raises Damaged: a line is none of a journal, which stays as it is.
    """

    def __init__(self, path: Path, document: Document, labels: str, annotator: str = "") -> None:
        self.path, self.document, self.labels = path, document, labels
        self.me, self.annotator = annotator, annotator or getpass.getuser()
        self.known = dict[Path, tuple[list[tuple[int, int]], Document | None]]()
        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = open(path, "a+b", buffering=0)  # noqa: SIM115  (open as long as this object)
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.file.close()
            holder = self._lock.read_text() if self._lock.exists() else "another process"
            raise BadInput(f"{path}: is open in {holder}; end it, or give another --out") from None
        self.file.seek(0)
        try:
            whole, self.saved = replay(path, self.file.read(), document, labels)
        except BadInput:
            self.close()
            raise
        self.file.truncate(whole)  # a torn last line was never acknowledged
        if not whole:
            self._append({"labels": labels, "names": list(document.names)})
        self.at()

    def write(self, entry: str | Sequence[Change]) -> None:
        """Edit the document, once that is on disk.

        :param entry: changes, :data:`UNDO`, :data:`REDO`, or :data:`SAVED` where the file has all edits.
        :raises BadInput: there is nothing to undo or to redo.
        """
        if entry in (UNDO, REDO) and not (self.document.done if entry == UNDO else self.document.undone):
            raise BadInput(f"nothing to {entry}")
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self._append({"by": self.annotator, "at": now, "edit": entry})
        self.saved = _apply(self.document, entry)

    def at(self, address: str = "") -> None:
        """Say who has the file, and where it can be edited, for processes that are refused."""
        where = address and f", at {address}"
        self._lock.write_text(f"a process of {getpass.getuser()}, {os.getpid()}{where}")

    def others(self) -> dict[str, Document]:
        """What each other annotator has said by now, by name; skips journals of other demonstrations.

        The journals of annotators lie side by side, as ``<start>_<annotator>.<end>``.
        """
        start, mine, end = self.path.name.partition(f"_{self.me}.")
        found = dict[str, Document]()
        for path in sorted(self.path.parent.glob(f"{start}_*.{end}")) if self.me and mine else ():
            now = version([path])
            if self.known.get(path, ([], None))[0] != now and path != self.path:
                document = Document(self.document.lengths, ())
                try:
                    replay(path, path.read_bytes(), document, self.labels)
                    self.known[path] = now, document
                except BadInput:
                    self.known[path] = now, None
            if own := self.known.get(path, ([], None))[1]:
                found[path.name.removeprefix(f"{start}_").removesuffix(f".{end}")] = own
        return found

    def close(self) -> None:
        """Leave the file to other processes."""
        self.file.close()
        self._lock.unlink(missing_ok=True)

    def _append(self, entry: Any) -> None:
        line = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        before = os.fstat(self.file.fileno()).st_size
        try:
            if self.file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            os.fsync(self.file.fileno())
        except OSError:
            self.file.truncate(before)  # no part of an edit that is not made
            raise

    @property
    def _lock(self) -> Path:
        return self.path.with_name(self.path.name + ".lock")
