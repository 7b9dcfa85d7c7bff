"""A person's labels with a model: what is shown, what a command changes, and the fits in the background."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import sklearn.linear_model
import sklearn.metrics  # noqa: F401  (the first edit does not wait for these)

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import SOURCE
from ddco_pyro.data.likeness import Likeness
from ddco_pyro.data.sources import open_source
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.timeline import text
from ddco_pyro.errors import BadInput, reason
from ddco_pyro.evaluation.inferred import Inferred, runs, within
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.commands import Segment, View, whole
from ddco_pyro.labelling.document import FREE, SUFFIX, Document, Journal, digest, version
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
from ddco_pyro.names import option_name
from ddco_pyro.segmenting.formats import FORMATS, check_format, write_format
from ddco_pyro.segmenting.formats.asked import Asked
from ddco_pyro.segmenting.formats.labels import check_copy, check_labels, has_labels, write_labels

NEAREST = 5
"""Segments elsewhere that are shown for one."""

UNCERTAIN = 20
"""Boundaries that are named as the most uncertain ones."""


class Session:
    """Labels of one level of a run's options, which people correct.

    Every method may be called from any thread. Steps are counted from 0, and ``stop`` is the step after the last.

    :param fit: has options.
    :param path: an HDF5 file of demonstrations.
    :param out: the file of labels; the same as ``path`` to write into it.
    :param level: the lowest one by default.
    :raises BadInput: the run has no options or no such level, ``out`` is something else, or another process labels it.
    """

    def __init__(
        self,
        fit: Fit,
        path: Path,
        out: Path,
        level: str | None = None,
    ) -> None:
        fit.refuse_flat()
        self.run, self.fit, self.path, self.out = fit, fit, path, out
        self.level = level or next(iter(fit.names))
        if self.level not in fit.names:
            raise BadInput(f"--level: there is no level {self.level!r} (there is: {', '.join(fit.names)})")
        self.demos = Demonstrations.read(path)
        if out.exists() and out.samefile(path):
            check_labels(path, [self.level, self.level + SOURCE], self.demos.names)
        else:
            check_copy(path, out)
        self.version, self.frequency = version(path), self.demos.frequency
        self.document = Document({demo.name: len(demo) for demo in self.demos}, fit.names[self.level][1:])
        self.journal = Journal(out.with_name(out.name + SUFFIX), self.document, digest(self.demos, self.level))
        if not (self.document.done or self.document.undone) and (
            known := said_in(Demonstrations.read(out) if out.exists() else self.demos, self.level, self.document.names)
        ):
            self.journal.edit(known)
        self.lock, self.revision, self.edits, self.changed = threading.RLock(), 0, 0, set[int]()
        self.saved = self.edits - self._is_unsaved()
        self.behind, self.inferring, self.inferred = False, False, dict.fromkeys(self.demos.names, 0)
        self.refits, self.again = 0, False
        self.background = Background(self.lock, self._ended, "ddco_pyro.labelling.refitting", "sklearn.linear_model")
        self.first, self.shown, self.wrong, self.sure = dict[str, Shown](), dict[str, Shown](), dict[str, float](), 0.0
        self.rows, self.recent = dict[str, list[list[Any]]](), dict[str, Inferred]()
        self.following = Following(path, self.demos, fit.spec.report.trajectory)
        self.error = ""
        self._prepare(fit)()
        self.unlike = self._unlike()
        self.proposed = self.proposals
        """By the run."""

    def begin(self) -> None:
        """Refit where something is labelled already; else have the process ready for it."""
        if self._is_labelled():
            self.refit()
        else:
            self.background.ready()

    def _is_unsaved(self) -> bool:
        """Whether the journal has labels that the file of labels lacks."""
        if not self.out.exists() or not (self.document.done or self.document.undone):
            return bool(self.document.done)
        with open_source(self.path) as source:
            said = said_segments(self.document, self.level, source, self.frequency)
        return not has_labels(self.out, said)

    # --- the model ----------------------------------------------------------------------------------------------------

    def _prepare(self, fit: Fit) -> Callable[[], None]:
        """Infer by another model; what is given shows its proposals.

        Its options get the numbers that named steps and what is shown give them.
        """
        with self.lock:
            before, count, edits = self._shown_now(), len(self.document.names), self.edits
            labels = self._labels()
            accepted = [*self.document.accepted]
        proposals = Proposals(fit, self.demos, [*fit.names].index(self.level) + 1, labels, count, before)
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

    def _labels(self) -> dict[str, np.ndarray]:
        return {name: own.copy() for name, own in self.document.labels.items()}

    def _shown_now(self) -> dict[str, np.ndarray]:
        return {name: shown.options for name, shown in self.shown.items()}

    def _show(self, names: Iterable[str], edited: str | None = None) -> None:
        """Show what is known of demonstrations, and mark those in which it differs from what was shown before."""
        for name in names:
            before, labels = self.shown.get(name), self.document.labels[name]
            shown = self.shown[name] = self.proposals.shown(name, labels)
            self.rows[name] = [[own.start, own.option, own.source] for own in self.segments(name)]
            if (labels == FREE).all():
                self.first[name] = shown
            if before is not None and name != edited and not np.array_equal(before.options, shown.options):
                self.changed.add(self.demos.names.index(name))
            self.wrong[name] = expected_wrong(shown, labels, self.sure)

    def _weigh(self) -> None:
        """Expect wrong steps anew, by what accepted demonstrations tell."""
        lengths, accepted = self.document.lengths, self.document.accepted
        first = [(wrong - expected) / lengths[name] for name, (expected, wrong) in accepted.items()]
        self.sure = unforeseen(first, [own for name, own in self.excess.items() if name in accepted])
        self.wrong = {
            name: expected_wrong(own, self.document.labels[name], self.sure) for name, own in self.shown.items()
        }

    def _infer(self, name: str) -> None:
        """Infer one demonstration at once, by what is learned so far."""
        (piece,) = self.proposals.infer([name], self.document.labels)
        self.proposals.paths |= self.proposals.found(piece)
        self.recent = {name: piece}

    # Edits change what is learned, and with it all demonstrations. A thread learns and infers them anew, those first
    # that wait longest. Another edit makes it begin with what that edit tells.

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
            edits, current, labels = self.edits, self.proposals, self._labels()
            recent = [*self.recent]
            names = sorted(self.demos.names, key=lambda name: (name not in recent, self.inferred[name]))
            ours = copy(current)
        ours.learned = ours.learn(labels)
        for piece in ours.infer(names, labels):
            found = ours.found(piece)
            with self.lock:
                if self.proposals is not current or not self.behind:
                    return True
                still = [name for name in piece.names if np.array_equal(labels[name], self.document.labels[name])]
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
        wrong, steps = np.array([self.wrong[name] for name in lengths]), np.array([*lengths.values()])
        edits = 1 + np.array([len(self.rows[name]) for name in lengths]) * wrong / steps
        self.order, self.farthest = ranking(
            wrong, edits, self.proposals.whole, np.array([name in accepted for name in lengths])
        )
        found = [
            (float(self.shown[name].probability[max(start - 1, 0) : start + 1].min()), place, start)
            for place, name in enumerate(self.demos.names)
            for start, _, _ in self.rows[name][1:]
            if self.document.labels[name][start - 1 : start + 1].min() == FREE
        ]
        self.uncertain = [{"demo": place, "step": step} for _, place, step in sorted(found)[:UNCERTAIN]]
        self.revision += 1

    @property
    def view(self) -> View:
        """The labels, and what is shown."""
        return View(self.document, self.shown, self.first)

    # --- what is shown ------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything but the demonstrations themselves."""
        with self.lock:
            document, names = self.document, self.demos.names
            demos = [
                {
                    "name": name,
                    "steps": document.lengths[name],
                    "accepted": name in document.accepted,
                    "labelled": int(document.said(name).sum()),
                    "expected_wrong": round(self.wrong[name], 2),
                    "changed": place in self.changed,
                    "held_out": name in self.run.held_out,
                    "reason": f"{self.wrong[name]:.0f} of {document.lengths[name]} steps expected wrong"
                    + "; the least like those you labelled" * (place == self.farthest),
                    "strip": self.rows[name],
                }
                for place, name in enumerate(names)
            ]
            return {
                "title": self.path.name,
                "formats": [*self.formats],
                "uncertain": self.uncertain,
                "level": self.level,
                "levels": [*self.fit.names],
                "names": list(document.names),
                "colours": [option_colour(option + 1) for option in range(len(document.names))],
                "frequency": self.frequency,
                "demos": demos,
                "order": self.order,
                "summary": self.summary(),
                "can_undo": bool(document.done),
                "can_redo": bool(document.undone),
                "out": str(self.out),
                **self.progress(),
            }

    def progress(self) -> dict[str, Any]:
        """What changes by itself.

        ``revision`` is larger after each change of what is shown. While it is ``behind``, edits have effects on other
        demonstrations that are not shown yet. ``dirty`` says that the journal has labels that the file lacks.
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
                "warnings": self.warnings(),
                "dirty": self.edits != self.saved,
            }

    def summary(self) -> dict[str, Any]:
        """The expected share of wrong steps, how much of it is in the demonstration to label next, and labelled ones.

        Both shares are None before anything is accepted.
        """
        steps, labelled = sum(self.document.lengths.values()), len(self.document.accepted)
        following = self.demos.names[self.order[0]]
        return {
            "expected_wrong": sum(self.wrong.values()) / steps if labelled else None,
            "one_more": self.wrong[following] / steps if labelled else None,
            "labelled": labelled,
        }

    def warnings(self) -> list[str]:
        """What a person should know: a changed file, a failure, demonstrations unlike those of the fit."""
        changed = f"{self.path} changed while it was labelled; start again to go on with it"
        return [*([] if self._unchanged() else [changed]), *filter(None, [self.error]), *self.unlike]

    def _unlike(self) -> list[str]:
        likeness, nats = Likeness(), dict[str, float]()
        for demo in self.demos:
            likeness.add_all(demo, self.fit.hierarchy.encoder.shapes)
        for piece in self.proposals.pieces:
            nats |= dict(zip(piece.names, (piece.log_likelihood / piece.lengths).tolist(), strict=True))
        return [
            f"unlike the demonstrations of the fit: {line}" for line in self.fit.unlike(likeness, nats, self.frequency)
        ]

    def _unchanged(self) -> bool:
        return self.path.exists() and version(self.path) == self.version

    def segments(self, name: str) -> list[Segment]:
        """The segments of a demonstration that are shown."""
        return self.view.segments(name)

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
            row, lasts = piece.names.index(name), self.proposals.lasts
            shown, drawn, own = self.shown[name], piece.drawn(row, lasts)[number - 1], self.segments(name)
            boundaries = [
                {
                    **_band(segment.start, drawn.get(segment.start, np.array([], int))),
                    "probability": round(float(shown.probability[segment.start]), 4),
                    "said": bool(self.document.labels[name][segment.start - 1 : segment.start + 1].min() > 0),
                }
                for segment in own[1:]
            ]
            levels = [*self.fit.names]
            upper = [
                {
                    "level": levels[number - 1],
                    "names": list(self.fit.names[levels[number - 1]][1:]),
                    "colours": [option_colour(n) for n in range(1, len(self.fit.names[levels[number - 1]]))],
                    "segments": [{"start": start, "stop": stop, "option": option} for option, start, stop in every],
                }
                for number, every in enumerate((runs(*one) for one in piece.segmented(row, lasts)), start=1)
                if number != self.proposals.level
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
                **self.following.shown(index),
            }

    def picture(self, index: int, step: int) -> bytes:
        """The picture of a step as JPEG.

        :raises BadInput: there is none.
        """
        with self.lock:
            self._name(index)
            return self.following.picture(index, step)

    def nearest(self, index: int, step: int) -> list[dict[str, Any]]:
        """The segments of other demonstrations that are most like the one at a step."""
        with self.lock:
            name = self._name(index)
            here, rows, proposals = self.view.at(name, step), dict(self.rows), self.proposals
        found, mine = list[tuple[float, int, int]](), np.zeros(0)
        starts = {other: [start for start, _, _ in own] for other, own in rows.items()}
        mine = proposals.centres(name, starts[name])[starts[name].index(here.start)]
        for place, other in enumerate(self.demos.names):
            if other != name:
                away = np.linalg.norm(proposals.centres(other, starts[other]) - mine, axis=1)
                found += zip(away.tolist(), repeat(place), range(len(away)))
        nearest = []
        for _, place, own in sorted(found)[:NEAREST]:
            (start, option, _), ends = rows[self.demos.names[place]][own], starts[self.demos.names[place]]
            stop = [*ends, self.document.lengths[self.demos.names[place]]][own + 1]
            nearest.append({"index": place, "start": start, "stop": stop, "option": option})
        return nearest

    # --- what a person says -------------------------------------------------------------------------------------------

    def edit(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a person asks, on disk before this returns.

        :raises BadInput: the command is none, or cannot be done here.
        """
        with self.lock:
            do, document = command.get("do"), self.document
            index = whole(command, "demo") if "demo" in command else None
            name = None if index is None else self._name(index)
            if do in ("undo", "redo"):
                getattr(self.journal, do)()
                changes = list((document.undone if do == "undo" else document.done)[-1])
            else:
                changes = [one for one in self.view.changes(str(do), name, command) if document.alters(*one)]
                if changes:
                    self.journal.edit(changes)
            touched = list(dict.fromkeys(change[1] for change in changes if change[0] != "names"))
            if do in ("undo", "redo"):
                index = self.demos.names.index(touched[0]) if touched else None
            if changes:
                self.edits += 1
                self._follow(touched, None if index is None else self.demos.names[index])
                if do == "accept":
                    self.refit()
            return {"revision": self.revision, "demo": index, "done": bool(changes)}

    def _follow(self, touched: Sequence[str], edited: str | None) -> None:
        """Show what follows from an edit at once: the demonstration at hand, and the numbers of options everywhere."""
        labels = {name: self.document.labels[name] for name in touched}
        if self.proposed is not self.proposals:
            self.proposed.number(labels)
        renumbered = self.proposals.number(labels)
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
        names = tuple(
            option_name(own) if ours[other - 1] == option_name(other) else ours[other - 1]
            for own, other in enumerate(stand.tolist(), start=1)
        )
        if names != known and len({*names}) == len(names):
            self.run.name_options(self.level, names)

    # --- in the background --------------------------------------------------------------------------------------------

    def refit(self) -> None:
        """Fit again in another process, with the labels and a recogniser of them; what comes of it is shown then.

        A refit that is asked for meanwhile begins when this one has ended.
        """
        with self.lock:
            if not self._is_labelled():
                raise BadInput("refit: nothing is labelled yet")
            self.again = self.background.running
            if not self.again:
                self.background.begin(self._refitting(), self._refitted)

    def _refitted(self, fit: Fit) -> Callable[[], None]:
        take = self._prepare(fit)

        def counted() -> None:
            self.refits += 1
            take()

        return counted

    def _ended(self) -> None:
        self.revision += 1
        if self.again and self._is_labelled():
            self.refit()

    def _is_labelled(self) -> bool:
        return any(bool(self.document.said(name).any()) for name in self.demos.names)

    def _refitting(self) -> Callable[..., Fit]:
        """The call that fits to what is said so far."""
        with self.lock:
            labels = {name: self.document.in_file(name) for name in self.demos.names}
            waiting = self.proposals.waiting(labels)
            kept = {name: np.where(np.isin(own, waiting), own, FREE) for name, own in self._shown_now().items()}
            trained, count = replace(self.fit, given=None), len(self.document.names)
        return partial(refit, trained, self.level, count, self._observed, labels, kept)

    @cached_property
    def _observed(self) -> Demonstrations:
        """The demonstrations with what the run's networks observe alone."""
        keys = self.run.spec.observed
        return Demonstrations(
            tuple(replace(demo, observations={key: demo.observations[key] for key in keys}) for demo in self.demos),
            attributes=self.demos.attributes,
        )

    def cancel(self) -> None:
        """End a refit at once; what is shown stays."""
        with self.lock:
            self.again = False
            self.background.cancel()
            self.revision += 1

    # --- files --------------------------------------------------------------------------------------------------------

    def save(self) -> str:
        """Write ``labels/<level>``, -1 where nothing is said, whole or not at all.

        :returns: what was written, in words.
        :raises BadInput: the demonstrations changed underneath.
        """
        with self.lock:
            if not self._unchanged():
                raise BadInput(self.warnings()[0])
            with open_source(self.path) as source:
                labels = said_segments(self.document, self.level, source, self.frequency)
            write_labels(self.path, self.out, labels)
            if self.out.exists() and self.out.samefile(self.path):
                self.version = version(self.path)
            self.saved = self.edits
            steps = sum(int(self.document.said(name).sum()) for name in self.demos.names)
            return f"{self.out}: labels/{self.level}, {steps} of {sum(self.document.lengths.values())} steps"

    @cached_property
    def formats(self) -> list[str]:
        """Those of ``segment`` that the page offers: all that take the demonstrations, without the copy with labels."""
        takes = ("", "robomimic")
        return [option[2:] for option, form in FORMATS.items() if form.takes in takes and option != "--out"]

    def export(self, form: str, folder: Path) -> Path:
        """Write the shown segments in one of :attr:`formats` into a folder.

        :returns: the file or folder that was written.
        :raises BadInput: there is no such format, or it does not fit the demonstrations.
        """
        if form not in self.formats:
            raise BadInput(f"there is no format {form!r}; there is: {', '.join(self.formats)}")
        about = FORMATS[f"--{form}"]
        place = folder / f"segments{'' if about.kind == 'folder' else about.suffix or f'.{form}'}"
        with open_source(self.path) as source:
            with self.lock:
                named = replace(self.fit, named={**self.fit.named, self.level: self.document.names})
                segmented = shown_segments(self.fit, source, self.level, self.shown, self.document)
            asked = Asked(f"--{form}", place, named, self.run.folder or Path(), self.path, source, self.level)
            check_format(asked)
            write_format(asked, segmented)
        return place

    def close(self) -> None:
        """Save, end what is under way, and leave the labels to other processes."""
        self.behind = False
        if self.inferring:
            self.thread.join()
        with self.lock:
            self.background.close()
            if self.edits != self.saved and self._unchanged():
                self.save()
            self.following.close()
            self.journal.close()


def _band(step: int, drawn: np.ndarray) -> dict[str, Any]:
    """A boundary with its 90 % interval and, within it, how often draws have each step, beside the most frequent."""
    low, high = within(drawn, step)
    often = np.bincount(drawn[(drawn >= low) & (drawn <= high)] - low, minlength=high - low + 1)
    return {"step": step, "low": low, "high": high, "density": text(np.rint(255 * often / max(often.max(), 1)))}
