"""A person's labels with a model: what is shown, what a command changes, and the fits in the background."""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import sklearn.linear_model
import sklearn.metrics  # noqa: F401  (the first edit does not wait for these)

from ddco_pyro.data.arrays import is_picture
from ddco_pyro.data.demonstration import NOTHING
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.labels import EXCLUDE, SOURCE
from ddco_pyro.data.likeness import traits
from ddco_pyro.data.sources import Source, format_of, open_source
from ddco_pyro.data.sources.metadata import FREQUENCY
from ddco_pyro.data.tasks import Where, with_task
from ddco_pyro.drawing.timeline import text
from ddco_pyro.errors import BadInput, reason, refuse_unknown
from ddco_pyro.evaluation.inferred import Inferred, runs, within
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.commands import Segment, View, whole
from ddco_pyro.labelling.document import FREE, SAVED, SUFFIX, Change, Document, Journal, digest, version
from ddco_pyro.labelling.features import Features
from ddco_pyro.labelling.following import Following
from ddco_pyro.labelling.proposals import (
    Proposals,
    Shown,
    excess,
    expected_wrong,
    ranking,
    said_in,
    said_segments,
    shown_segments,
    unforeseen,
)
from ddco_pyro.labelling.refitting import refit
from ddco_pyro.labelling.team import Team, agreement, taken
from ddco_pyro.names import option_colour, option_name
from ddco_pyro.segmenting.formats import FORMATS, Asked, check_copy, check_format, write_format
from ddco_pyro.segmenting.formats.labels import check_labels
from ddco_pyro.segmenting.segments import Segmented

NEAREST = 5
"""Segments elsewhere that are shown for one."""

TENTH = 10
"""The part of a demonstration that has to be named before names from the cursor are offered, as a divisor."""

UNCERTAIN = 20
"""Boundaries that are named as the most uncertain ones."""


def read(path: Path, needed: Iterable[str] = (), where: Where = NOTHING) -> Demonstrations:
    """The demonstrations of a file or data set as they are; pictures and videos are read when they are shown.

    :param needed: the pictures that a model reads.
    :param where: attributes and values of the demonstrations that are read; all if empty.
    """
    if format_of(path) == "robomimic":
        return Demonstrations.read(path, where=where)
    with open_source(path, where=where) as source:
        each = []
        for demo in map(source.read, source.names):
            every = demo.observations.items()
            seen = {key: own for key, own in every if key in needed or not is_picture(own)}
            each.append(Demonstration(demo.name, seen, demo.actions, demo.labels, demo.attributes))
        rate = {FREQUENCY: source.frequency} if source.frequency else {}
        return Demonstrations(tuple(each), source.masks, {**source.attributes, **rate})


class Session:
    """Labels of one level of a run's options, which people correct.

    Every method may be called from any thread. Steps count from 0; ``stop`` is the step after the last.

    :param fit: has options.
    :param path: an HDF5 file of demonstrations, or a LeRobot dataset.
    :param out: the file or dataset of labels; the same as ``path`` to write into it.
    :param level: the lowest one by default.
    :param skills: names of the options 1, 2, ... where nothing is labelled yet; further ones are new options.
    :param team: who labels, and who labels what.
    :param first: the session of another level, whose demonstrations and marks are those of this one.
    :param where: attributes and values of the demonstrations to label; all if empty.
    :param features: of pictures, which recognisers of all levels read once computed; of the first session.
    :ivar beside: the sessions of the other levels.
    :raises BadInput: the run has no options or no such level, ``out`` is something else, or another process
        labels it.
    """

    proposals: Proposals

    def __init__(
        self,
        fit: Fit,
        path: Path,
        out: Path,
        level: str | None = None,
        skills: Sequence[str] = (),
        team: Team | None = None,
        first: Session | None = None,
        where: Where = NOTHING,
        features: Features | None = None,
    ) -> None:
        fit.refuse_flat()
        self.where = where
        self.run, self.fit, self.path, self.out = fit, fit, path, out
        self.level, self.team, self.first = level or next(iter(fit.names)), team or Team(), first or self
        refuse_unknown("level", self.level, fit.names, place="--level: ")
        self.beside = list[Session]()
        self.demos: Demonstrations = first.demos if first else read(path, fit.hierarchy.encoder.shapes, where)
        if (tasks := fit.hierarchy.encoder.tasks) and not first:
            each = tuple(with_task(demo, tasks) for demo in self.demos)
            self.demos = replace(self.demos, demonstrations=each)
        self.form, self.in_place = format_of(path), out.exists() and out.samefile(path)
        self._check_out()
        self.files = [file for file in (path, *path.rglob("*")) if file.is_file()]
        self.version, self.frequency = version(self.files), self.demos.frequency
        known = [*skills, *fit.names[self.level][1 + len(skills) :]]
        self.document = Document({demo.name: len(demo) for demo in self.demos}, tuple(known))
        place = out.with_name(f"{out.name}{f'.{self.level}' if first else ''}{SUFFIX}")
        self.journal = Journal(place, self.document, digest(self.demos, self.level), self.team.me)
        self.shares = self.team.shares(self.demos.names)
        if not (self.document.done or self.document.undone):
            there = read(out, where=where) if out.exists() and not self.in_place else self.demos
            if said := said_in(there, self.level, self.document.names, self.form == "lerobot", first is None):
                self.journal.write(said)
                self.journal.write(SAVED)
        self.lock: threading.RLock = first.lock if first else threading.RLock()
        self.revision, self.edits, self.changed = 0, 0, set[int]()
        self.behind, self.inferring, self.inferred = False, False, dict.fromkeys(self.demos.names, 0)
        self.refits, self.again = 0, False
        self.features, self.seen = features, dict[str, np.ndarray]()
        self.encoding: Background = first.encoding if first else Background(self.lock, lambda: None)
        modules = ("ddco_pyro.labelling.refitting", "sklearn.linear_model")
        self.background = Background(self.lock, self._ended, *modules)
        self.shown, self.untouched, self.sure = dict[str, Shown](), dict[str, Shown](), 0.0
        self.view = View(self.document, self.shown, self.untouched)
        self.segments, self.recent = dict[str, list[Segment]](), dict[str, Inferred]()
        trajectory = fit.spec.report.trajectory
        self.following: Following = first.following if first else Following(path, self.demos, trajectory)
        self.error = ""
        self._prepare(fit)()
        self.unlike = [] if first else self._unlike()
        self.proposed = self.proposals
        """By the run."""

    def _check_out(self) -> None:
        """Refuse a place of something else."""
        if not self.in_place:
            check_copy(self.form, self.out, self.path)
        elif self.form == "robomimic":
            check_labels(self.path, [self.level, self.level + SOURCE], self.demos.names)

    def begin(self) -> None:
        """Compute features of pictures, and refit if something is labelled; else have the process ready."""
        if self.features:
            self.encoding.begin(self.features.computed, self._look)
        if self._is_labelled():
            self.refit()
        elif self.first is self:
            self.background.ready()

    @property
    def excluded(self) -> set[str]:
        """The demonstrations that a person leaves out."""
        return {name for name, marks in self.first.document.marks.items() if EXCLUDE in marks}

    @property
    def dirty(self) -> bool:
        """Whether the journals hold more than the file of labels."""
        return any(not own.journal.saved for own in (self, *self.beside)) or bool(
            self.document.done and not self.out.exists()
        )

    # --- the model ------------------------------------------------------------------------------------------

    def _prepare(self, fit: Fit) -> Callable[[], None]:
        """Infer by another model; what is given shows its proposals.

        Its options get the numbers that named steps and what is shown give them.
        """
        with self.lock:
            before, count, edits = self._shown_now(), len(self.document.names), self.edits
            labels, accepted = dict(self.document.labels), [*self.document.accepted]
        number = [*fit.names].index(self.level) + 1
        proposals = Proposals(fit, self.demos, number, labels, count, before, self.first.seen)
        held_out = proposals.held_out(labels, accepted if len(accepted) > 1 else ())

        def take() -> None:
            self.fit, self.proposals = fit, proposals
            self.excess = {name: excess(own, labels[name]) for name, own in held_out.items()}
            self.inferred, self.recent = dict.fromkeys(self.demos.names, edits), {}
            proposals.number(self.document.labels)
            self._show(self.demos.names)
            self._weigh()
            self._rank()
            self._catch_up(self.edits != edits)

        return take

    def _shown_now(self) -> dict[str, np.ndarray]:
        return {name: shown.options for name, shown in self.shown.items()}

    def _show(self, names: Iterable[str], edited: str | None = None) -> None:
        """Show what is known of demonstrations, and mark those where it differs from what was shown."""
        for name in names:
            before, labels = self.shown.get(name), self.document.labels[name]
            shown = self.shown[name] = self.proposals.shown(name, labels)
            self.segments[name] = self.view.segments(name)
            if (labels == FREE).all():
                self.untouched[name] = shown
            if before is not None and name != edited and not np.array_equal(before.options, shown.options):
                self.changed.add(self.demos.names.index(name))

    def _weigh(self) -> None:
        """Expect wrong steps anew (ε), by what accepted demonstrations tell."""
        lengths, accepted = self.document.lengths, self.document.accepted
        first = [(wrong - expected) / lengths[name] for name, (expected, wrong) in accepted.items()]
        self.sure = unforeseen(first, [own for name, own in self.excess.items() if name in accepted])

    def _wrong(self) -> dict[str, float]:
        """The expected number of wrong steps of each demonstration."""
        labels = self.document.labels
        return {name: expected_wrong(self.shown[name], labels[name], self.sure) for name in self.demos.names}

    def _infer(self, name: str) -> None:
        """Infer one demonstration at once, by what is learned so far."""
        (piece,) = self.proposals.infer([name], self.document.labels)
        self.proposals.paths |= self.proposals.found(piece)
        self.recent = {name: piece}

    # Edits change what is learned, and with it all demonstrations. A thread learns and infers them anew,
    # those first that wait longest. Another edit makes it begin with what that edit tells.

    def _catch_up(self, needed: bool = True) -> None:
        self.behind = self.behind or needed
        if self.behind and not self.inferring:
            self.inferring, self.thread = True, threading.Thread(target=self._infer_all, daemon=True)
            self.thread.start()

    def _infer_all(self) -> None:
        try:
            while self._infer_each():
                pass
        except Exception as error:  # the page says what has failed, and labelling goes on
            with self.lock:
                self.behind = self.inferring = False
                self.error = f"the proposals are not up to date: {reason(error)}"
                self.revision += 1

    def _infer_each(self) -> bool:
        """Infer demonstrations until all are, or until there is another edit; whether any is left."""
        with self.lock:
            if not self.behind:
                self.inferring = False
                return False
            edits, current, labels = self.edits, self.proposals, dict(self.document.labels)
            recent = [*self.recent]
            names = sorted(self.demos.names, key=lambda name: (name not in recent, self.inferred[name]))
            ours = copy(current)
        ours.learned = ours.learn(labels)
        for piece in ours.infer(names, labels):
            found = ours.found(piece)
            with self.lock:
                if self.proposals is not current or not self.behind:
                    return True
                still = [name for name in piece.names if labels[name] is self.document.labels[name]]
                current.learned = ours.learned
                current.paths |= {name: found[name] for name in still}
                self.inferred |= dict.fromkeys(still, edits)
                self._show(still)
                if self.recent.keys() & {*still}:
                    self.recent = {}
                    self.revision += 1
                if self.edits != edits:
                    return True
        with self.lock:
            self.behind = self.behind and (self.edits != edits or self.proposals is not current)
            self._rank()
        return True

    def _rank(self) -> None:
        """Rank demonstrations by the worth of labelling them, and boundaries by how uncertain they are."""
        lengths, accepted = self.document.lengths, self.document.accepted
        wrong, steps = np.array([*self._wrong().values()]), np.array([*lengths.values()])
        edits = 1 + np.array([len(self.segments[name]) for name in lengths]) * wrong / steps
        done = np.array([name in accepted for name in lengths])
        self.order, self.farthest = ranking(wrong, edits, self.proposals.whole, done)
        left_out, names = self.excluded, self.demos.names
        others = {name for name, people in self.shares.items() if people and self.team.me not in people}
        self.order.sort(key=lambda place: [names[place] in last for last in (left_out, accepted, others)])
        found = [
            (float(self.shown[name].probability[own.start - 1 : own.start + 1].min()), place, own.start)
            for place, name in enumerate(self.demos.names)
            for own in self.segments[name][1:]
            if self.document.labels[name][own.start - 1 : own.start + 1].min() == FREE
        ]
        self.uncertain = [{"demo": place, "step": step} for _, place, step in sorted(found)[:UNCERTAIN]]
        self.revision += 1

    # --- what is shown --------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything but the demonstrations themselves."""
        with self.lock:
            document, names = self.document, self.demos.names
            others, wrong = self.journal.others(), self._wrong()
            demos = [
                {
                    "name": name,
                    "task": task,
                    "steps": document.lengths[name],
                    "accepted": name in document.accepted,
                    "labelled": int(document.said(name).sum()),
                    "expected_wrong": round(wrong[name], 2),
                    "changed": place in self.changed,
                    "held_out": name in self.run.held_out,
                    "reason": f"{wrong[name]:.0f} of {document.lengths[name]} steps expected wrong"
                    + "; the least like those you labelled" * (place == self.farthest),
                    "marks": self.first.document.marks[name],
                    "people": [*self.shares[name]],
                    "done_by": [other for other, own in others.items() if name in own.accepted],
                    "strip": [[own.start, own.option, own.source] for own in self.segments[name]],
                }
                for place, (name, task) in enumerate(zip(names, self.demos.tasks, strict=True))
            ]
            return {
                "title": self.path.name,
                "formats": self.formats,
                "uncertain": self.uncertain,
                "level": self.level,
                "levels": [own.level for own in (self.first, *self.first.beside)],
                "names": list(document.names),
                "colours": self.colours,
                "frequency": self.frequency,
                "demos": demos,
                "order": self.order,
                "summary": self.summary(),
                "annotator": self.team.me,
                "team": self._team(others),
                "scratch": self._scratch(),
                "can_undo": bool(document.done),
                "can_redo": bool(document.undone),
                **self.progress(),
            }

    @property
    def colours(self) -> list[str]:
        """Of the options 1 to k: those that a person chose, else the usual ones."""
        own, names = self.document.colours, self.document.names
        return [own.get(name, option_colour(option)) for option, name in enumerate(names, start=1)]

    def _team(self, others: Mapping[str, Document]) -> list[dict[str, Any]]:
        """How far each annotator is, and how the others agree with this one."""
        found = []
        for name, document in {self.team.me: self.document, **others}.items() if self.team.me else ():
            turn = [demo for demo, people in self.shares.items() if name in people] or list(self.demos.names)
            done = sum(demo in document.accepted for demo in turn)
            both = None if document is self.document else agreement(self.document, document, self.demos.names)
            found.append({"name": name, "done": done, "of": len(turn), "agreement": both})
        return found

    def _scratch(self) -> bool:
        """Whether a first demonstration likely takes fewer edits where names go from the cursor on.

        That is so where most of the steps that a person named were proposed wrong. The posterior says nothing
        of it: the model may be sure of segments that are none of the person's.
        """
        labels = self.document.labels
        if self.document.accepted:
            return False
        named = {name: own > 0 for name, own in labels.items() if name in self.untouched}
        differ = {name: self.untouched[name].options != labels[name] for name in named}
        wrong = sum(int(differ[name][said].sum()) for name, said in named.items())
        total = sum(int(said.sum()) for said in named.values())
        return total * TENTH >= min(self.document.lengths.values()) and wrong > total / 2

    def progress(self) -> dict[str, Any]:
        """What changes by itself.

        ``revision`` is larger after each change of what is shown. While it is ``behind``, edits have effects
        on other demonstrations that are not shown yet. ``dirty``: the journal has labels that the file lacks.
        """
        with self.lock:
            return {
                "revision": self.revision,
                "behind": self.behind,
                "refit": {
                    "running": self.background.running,
                    "progress": self.background.progress,
                    "done": self.refits,
                    "error": self.background.error and f"fitting the labels failed: {self.background.error}",
                },
                "features": self._features_said(),
                "warnings": self.warnings(),
                "dirty": self.dirty,
            }

    def summary(self) -> dict[str, Any]:
        """The expected share of wrong steps, its part in the demonstration to label next, and labelled ones.

        Both shares are None before anything is accepted.
        """
        names = [name for name in self.demos.names if name not in self.excluded]
        steps, wrong = max(1, sum(self.document.lengths[name] for name in names)), self._wrong()
        labelled, following = len(self.document.accepted), self.demos.names[self.order[0]]
        return {
            "expected_wrong": sum(wrong[name] for name in names) / steps if labelled else None,
            "one_more": wrong[following] / steps if labelled else None,
            "labelled": labelled,
        }

    def warnings(self) -> list[str]:
        """What a person should know: a changed file, a failure, demonstrations unlike those of the fit."""
        changed = f"{self.path} changed while it was labelled; start again to go on with it"
        failed = self.encoding.error
        features = failed and f"features of pictures: {failed}; proposals go on without them"
        known = ["" if self._unchanged() else changed, self.error, features]
        return [*filter(None, known), *self.unlike]

    def _features_said(self) -> str:
        """How far features of pictures are, in words."""
        if self.encoding.running:
            share = self.encoding.progress
            return f"features of pictures: {'begun' if share is None else f'{share:.0%}'}"
        return "proposals read the pictures" if self.first.seen else ""

    def _unlike(self) -> list[str]:
        known = [traits(demo, self.fit.hierarchy.encoder.shapes) for demo in self.demos]
        nats = dict[str, float]()
        for piece in self.proposals.pieces:
            nats |= dict(zip(piece.names, (piece.log_likelihood / piece.lengths).tolist(), strict=True))
        lines = self.fit.unlike(known, nats, self.frequency)
        return [f"unlike the demonstrations of the fit: {line}" for line in lines]

    def _unchanged(self) -> bool:
        return self.path.exists() and self.version == version(self.files)

    def demo(self, index: int) -> dict[str, Any]:
        """One demonstration with its segments, boundaries, and what follows the cursor."""
        with self.lock:
            name = self._name(index)
            if name not in self.recent:
                before = self.shown[name]
                self._infer(name)
                self._show([name], name)
                self.revision += not np.array_equal(before.options, self.shown[name].options)
            piece, number = self.recent[name], self.proposals.level
            drawn = piece.drawn(piece.names.index(name))[number - 1]
            shown, own = self.shown[name], self.segments[name]
            boundaries = [
                {
                    **_band(segment.start, drawn.get(segment.start, np.array([], int))),
                    "said": bool(self.document.labels[name][segment.start - 1 : segment.start + 1].min() > 0),
                }
                for segment in own[1:]
            ]
            levels, others = (self.first, *self.first.beside), self.journal.others()
            upper = [
                {
                    "level": levels.index(own),
                    "above": [*self.run.names].index(own.level) > [*self.run.names].index(self.level),
                    "name": own.level,
                    "names": list(own.document.names),
                    "colours": own.colours,
                    "segments": [vars(segment) for segment in own.segments[name]],
                }
                for own in self.beside
            ]
            self.changed.discard(index)
            return {
                "index": index,
                "name": name,
                "steps": len(shown.options),
                "revision": self.revision,
                "segments": [vars(segment) for segment in own],
                "boundaries": boundaries,
                "probability": text(np.rint(255 * shown.probability)),
                "upper": upper,
                "others": [self._other(other, own, name) for other, own in others.items()],
                "task": str(self.demos[index].attributes.get("task", "")),
                **self.following.shown(index),
            }

    def _other(self, other: str, own: Document, name: str) -> dict[str, Any]:
        """What another annotator says of a demonstration, and how that agrees with this one."""
        labels, ours = own.labels[name], self.document.names
        colour = dict(zip(ours, self.colours, strict=True))
        segments = []
        for value, start, stop in runs(labels, np.diff(labels, prepend=-9)):
            said = {"option": max(value, 0), "source": "open" if value < 0 else "given"}
            segments.append({"start": start, "stop": stop, **said})
        return {
            "annotator": other,
            "names": list(own.names),
            "colours": [colour.get(text, option_colour(n)) for n, text in enumerate(own.names, start=1)],
            "segments": segments,
            "accepted": name in own.accepted,
            "agreement": agreement(self.document, own, [name]),
        }

    def picture(self, index: int, camera: int, step: int) -> bytes:
        """The picture of a step as JPEG.

        :raises BadInput: there is none.
        """
        self._name(index)
        return self.following.picture(index, camera, step)

    def nearest(self, index: int, step: int) -> list[dict[str, Any]]:
        """The segments of other demonstrations that are most like the one at a step."""
        with self.lock:
            name = self._name(index)
            here, segments, proposals = self.view.at(name, step), dict(self.segments), self.proposals
        starts = {other: [one.start for one in own] for other, own in segments.items()}
        centres = {other: proposals.centres(other, own) for other, own in starts.items()}
        mine, found = centres[name][segments[name].index(here)], []
        for place, other in enumerate(self.demos.names):
            if other != name:
                away = np.linalg.norm(centres[other] - mine, axis=1).tolist()
                found += [(distance, place, own) for distance, own in zip(away, segments[other], strict=True)]
        return [
            {"index": place, "start": own.start, "stop": own.stop, "option": own.option}
            for _, place, own in heapq.nsmallest(NEAREST, found, key=itemgetter(0))
        ]

    # --- what a person says ---------------------------------------------------------------------------------

    def edit(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a person asks, on disk before this returns.

        :raises BadInput: the command is none, or cannot be done here.
        """
        with self.lock:
            do, document = command.get("do"), self.document
            index = whole(command, "demo") if "demo" in command else None
            name = None if index is None else self._name(index)
            names, shown = document.names, self._shown_now()
            if do == "mark" and self.first is not self:
                return self.first.edit(command)
            if do in ("undo", "redo"):
                self.journal.write(str(do))
            else:
                took = do == "take"
                asked = self._taken(name, command) if took else self.view.changes(str(do), name, command)
                changes = list(filter(document.alters, asked))
                if not changes:
                    return {"revision": self.revision, "demo": index, "done": False}
                self.journal.write(changes)
            touched = document.touched((document.undone if do == "undo" else document.done)[-1])
            if do in ("undo", "redo"):
                index = self.demos.names.index(touched[0]) if touched else None
            self.edits += 1
            if len(names) != len(document.names) and do != "new":
                self._renumber(names, shown, command.get("into", 0) if do == "drop" else 0)
            self._follow(touched, None if index is None else self.demos.names[index])
            if do == "accept":
                self.refit()
            return {"revision": self.revision, "demo": index, "done": True}

    def _taken(self, name: str | None, command: Mapping[str, Any]) -> list[Change]:
        """The changes by which another annotator's labels of a demonstration become one's own."""
        others = self.journal.others()
        if name is None or command.get("annotator") not in others:
            raise BadInput(f"take: name a demonstration and one of the annotators {', '.join(others)}")
        return taken(self.document, others[command["annotator"]], name)

    def _renumber(self, names: Sequence[str], shown: Mapping[str, np.ndarray], into: int) -> None:
        """Number the options of the model anew after options of the person were dropped, or are back.

        :param names: the person's options before.
        :param shown: of each step, before.
        :param into: the earlier number of the option that a dropped one is merged into; 0 for none.
        """
        now = self.document.names
        numbers = np.array([0, *(now.index(name) + 1 if name in now else 0 for name in names)])
        numbers[numbers == 0] = numbers[into]
        before, labels = {name: numbers[own] for name, own in shown.items()}, self.document.labels
        self.proposals.renumber(labels, len(now), before)
        self.proposals.learned = self.proposals.learn(labels)
        self.proposed.renumber(labels, len(now), before)
        self.untouched.clear()
        self.recent = {}
        self._show(self.demos.names)

    def _follow(self, touched: Sequence[str], edited: str | None) -> None:
        """Show what follows from an edit at once: the demonstration at hand, and numbers of all options."""
        renumbered = self.proposals.number(self.document.labels)
        self.proposed.number(self.document.labels)
        if edited is not None:
            self._infer(edited)
        self._show(self.demos.names if renumbered else touched, edited)
        self._weigh()
        self._name_options()
        self.revision += 1
        self._catch_up(bool(touched))

    def _name(self, index: int) -> str:
        if not 0 <= index < len(self.demos):
            raise BadInput(f"there is no demonstration {index}; there are 0 to {len(self.demos) - 1}")
        return self.demos.names[index]

    def _name_options(self) -> None:
        """Give the run's options the names of the options that they stand for."""
        ours, known = self.document.names, self.run.names[self.level][1:]
        stand = self.proposed.options[1:]
        if stand.min() < 1:
            return
        names = tuple(
            option_name(own) if ours[other - 1] == option_name(other) else ours[other - 1]
            for own, other in enumerate(stand.tolist(), start=1)
        )
        if names != known and len({*names}) == len(names):
            self.run.name_options(self.level, names)

    # --- in the background ----------------------------------------------------------------------------------

    def refit(self) -> None:
        """Fit again in another process, with the labels and a recogniser of them; then the result is shown.

        A refit that is asked for meanwhile begins when this one has ended.
        """
        with self.lock:
            if not self._is_labelled():
                raise BadInput("refit: nothing is labelled yet")
            self.again = self.background.running
            if self.again:
                return
            names = [name for name in self.demos.names if name not in self.excluded]
            labels = {name: self.document.in_file(name) for name in names}
            shown, waiting = self._shown_now(), self.proposals.waiting(labels)
            kept = {name: np.where(np.isin(shown[name], waiting), shown[name], FREE) for name in names}
            trained, count = replace(self.fit, given=None), len(self.document.names)
            demos, seen = self._observed.select(names), self.first.seen
            call = partial(refit, trained, self.level, count, demos, labels, kept, seen)
            self.background.begin(call, self._refitted)

    def _refitted(self, fit: Fit) -> Callable[[], None]:
        take = self._prepare(fit)

        def counted() -> None:
            self.refits += 1
            take()

        return counted

    def _look(self, seen: dict[str, np.ndarray]) -> Callable[[], None]:
        """Have the recognisers of all levels read features of pictures."""
        self.seen = seen
        prepared = [(own, own.fit, own._prepare(own.fit)) for own in (self, *self.beside)]

        def take() -> None:
            for own, fit, show in prepared:
                if own.fit is fit:
                    show()
                if own._is_labelled():
                    own.refit()

        return take

    def _ended(self) -> None:
        self.revision += 1
        if self.again and self._is_labelled():
            self.refit()

    def _is_labelled(self) -> bool:
        return any(bool(self.document.said(name).any()) for name in self.demos.names)

    @cached_property
    def _observed(self) -> Demonstrations:
        """The demonstrations with what the run's networks observe alone."""
        keys = self.run.hierarchy.encoder.shapes
        seen = [{key: demo.observations[key] for key in keys} for demo in self.demos]
        pairs = zip(self.demos, seen, strict=True)
        each = tuple(replace(demo, observations=own) for demo, own in pairs)
        return Demonstrations(each, attributes=self.demos.attributes)

    def cancel(self) -> None:
        """End a refit at once; what is shown stays."""
        with self.lock:
            self.again = False
            self.background.cancel()
            self.revision += 1

    # --- files ----------------------------------------------------------------------------------------------

    def save(self) -> str:
        """Write the labels of all levels and the marks, -1 where nothing is said, whole or not at all.

        :returns: what was written, in words.
        :raises BadInput: the demonstrations changed underneath.
        """
        every = (self, *self.beside)
        with self.lock:
            if not self._unchanged():
                raise BadInput(self.warnings()[0])
            documents = {own.level: own.document for own in every}
            with open_source(self.path, where=self.where) as source:
                labels = said_segments(documents, source, self.frequency, self.first.document.marks)
                option = "--out" if self.form == "robomimic" else "--lerobot"
                self._write(option, self.out, source, labels, self.first.level)
            if self.in_place:
                for own in every:
                    own.version = version(self.files)
            for own in every:
                own.journal.write(SAVED)
            steps = sum(int(self.document.said(name).sum()) for name in self.demos.names)
            what = f"labels/{self.level}" if self.form == "robomimic" else "subtasks"
            return f"{self.out}: {what}, {steps} of {sum(self.document.lengths.values())} steps"

    def _write(self, option: str, place: Path, source: Source, segmented: Segmented, level: str) -> str:
        names = {own.level: own.document.names for own in (self, *self.beside)}
        named = replace(self.fit, named={**self.fit.named, **names}, folder=self.run.folder)
        asked = Asked(option, place, named, source, level, annotator=self.journal.annotator)
        if place != self.out:
            check_format(asked)
        return write_format(asked, segmented)

    @property
    def formats(self) -> list[str]:
        """Those of ``segment`` that the page offers: all that take the demonstrations, except ``--out``."""
        taking = [option for option, form in FORMATS.items() if form.takes in ("", self.form)]
        return [option[2:] for option in taking if option != "--out"]

    def export(self, form: str, folder: Path) -> Path:
        """Write the shown segments in one of :attr:`formats` into a folder, without excluded demonstrations.

        :returns: the file or folder that was written.
        :raises BadInput: there is no such format, or it does not fit the demonstrations.
        """
        refuse_unknown("format", form, self.formats)
        about = FORMATS[f"--{form}"]
        end = "" if about.kind == "folder" else ".hdf5" if about.takes == "robomimic" else f".{form}"
        place = folder / f"segments{end}"
        with open_source(self.path, where=self.where) as source:
            with self.lock:
                segmented = shown_segments(self.fit, source, self.level, self.shown, self.document)
            marks, whole = self.first.document.marks, about.takes == "lerobot"
            kept = tuple(demo for demo in segmented.segments if whole or demo.name not in self.excluded)
            segmented = replace(segmented, segments=kept, marks=marks)
            self._write(f"--{form}", place, source, segmented, self.level)
        return place

    def close(self) -> None:
        """Save, end what is under way, and leave the labels to other processes."""
        self.behind = False
        if self.inferring:
            self.thread.join()
        with self.lock:
            self.background.close()
            self.encoding.close()
            if not self.journal.saved and self._unchanged():
                self.save()
            self.following.close()
            self.journal.close()


def _band(step: int, drawn: np.ndarray) -> dict[str, Any]:
    """A boundary with its 90 % interval, and how often draws have its steps, beside the most frequent one."""
    low, high = within(drawn, step)
    often = np.bincount(drawn[(drawn >= low) & (drawn <= high)] - low, minlength=high - low + 1)
    density = text(np.rint(255 * often / max(often.max(), 1)))
    return {"step": step, "low": low, "high": high, "density": density}
