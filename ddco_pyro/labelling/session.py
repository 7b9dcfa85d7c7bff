"""A person's labels with a model: what is shown, what a command changes, and the fits in the background."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.timeline import text
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.inferred import within
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
    said_segments,
    shown_segments,
    unforeseen,
)
from ddco_pyro.labelling.refitting import labelled, refit
from ddco_pyro.names import option_name
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.formats.labels import check_copy, check_labels, write_labels

NEAREST = 5
"""Segments elsewhere that are shown for one."""

UNCERTAIN = 20
"""Boundaries that are named as the most uncertain ones."""

Exporter = Callable[[Segmented, Fit, Path, str], Path]
"""Writes segments in a format: gets them, the model, a folder and the level; gives the file or folder."""


class Session:
    """Labels of one level of a run's options, which people correct.

    Every method may be called from any thread. Steps are counted from 0, and ``stop`` is the step after the last.

    :param fit: has options.
    :param path: an HDF5 file of demonstrations.
    :param out: the file of labels; the same as ``path`` to write into it.
    :param level: the lowest one by default.
    :param exporters: what writes each format, by its name.
    :raises BadInput: the run has no options or no such level, ``out`` is something else, or another process labels it.
    """

    def __init__(
        self,
        fit: Fit,
        path: Path,
        out: Path,
        level: str | None = None,
        exporters: Mapping[str, Exporter] | None = None,
    ) -> None:
        fit.refuse_flat()
        self.exporters = exporters or {}
        self.run, self.fit, self.path, self.out = fit, fit, path, out
        self.level = level or next(iter(fit.names))
        if self.level not in fit.names:
            raise BadInput(f"--level: there is no level {self.level!r} (there is: {', '.join(fit.names)})")
        if not (out.exists() and out.samefile(path)):
            check_copy(path, out)
        self.demos = Demonstrations.read(path)
        check_labels(path, [self.level], self.demos.names)
        self.version, self.frequency = version(path), self.demos.frequency
        self.document = Document({demo.name: len(demo) for demo in self.demos}, fit.names[self.level][1:])
        self.journal = Journal(out.with_name(out.name + SUFFIX), self.document, digest(self.demos, self.level))
        self.lock, self.revision, self.edits, self.saved, self.changed = threading.RLock(), 0, 0, 0, set[int]()
        self.refits, self.again = 0, False
        self.background = Background(self.lock, self._ended, "ddco_pyro.labelling.refitting", "sklearn.linear_model")
        self.first, self.shown = dict[str, Shown](), dict[str, Shown]()
        self.following = Following(path, self.demos, fit.spec.report.trajectory)
        self._prepare(fit)()
        self.proposed = self.proposals
        """By the run."""

    # --- the model ----------------------------------------------------------------------------------------------------

    def _prepare(self, fit: Fit) -> Callable[[], None]:
        """Infer by another model; what is given shows its proposals.

        Its options get the numbers that named steps and what is shown give them.
        """
        with self.lock:
            before, count = self._shown_now(), len(self.document.names)
            labels = {name: own.copy() for name, own in self.document.labels.items()}
            accepted = [*self.document.accepted]
        proposals = Proposals(fit, self.demos, [*fit.names].index(self.level) + 1, count, before)
        held_out = proposals.held_out(labels, accepted if len(accepted) > 1 else ())

        def take() -> None:
            self.fit, self.proposals = fit, proposals
            self.excess = {name: excess(own, labels[name]) for name, own in held_out.items()}
            self._update(before)

        return take

    def _shown_now(self) -> dict[str, np.ndarray]:
        return {name: shown.options for name, shown in self.shown.items()}

    def _update(self, before: Mapping[str, np.ndarray], edited: str | None = None) -> None:
        """Infer again what is shown, and mark demonstrations in which it differs from what was shown before."""
        self.proposals.update(self.document.labels)
        labels = self.document.labels
        self.shown = {name: self.proposals.shown(name, labels[name]) for name in self.demos.names}
        self.first |= {name: self.shown[name] for name, own in labels.items() if (own == FREE).all()}
        self.changed = {
            place
            for place, name in enumerate(self.demos.names)
            if name in before and name != edited and not np.array_equal(before[name], self.shown[name].options)
        }
        lengths, accepted = self.document.lengths, self.document.accepted
        first = [(wrong - expected) / lengths[name] for name, (expected, wrong) in accepted.items()]
        sure = unforeseen(first, [own for name, own in self.excess.items() if name in accepted])
        self.wrong = {name: expected_wrong(shown, labels[name], sure) for name, shown in self.shown.items()}
        self.order = self._order()
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
            ranked, reasons = self.order
            demos = [
                {
                    "name": name,
                    "steps": document.lengths[name],
                    "accepted": name in document.accepted,
                    "labelled": int(document.said(name).sum()),
                    "expected_wrong": round(self.wrong[name], 2),
                    "changed": place in self.changed,
                    "held_out": name in self.run.held_out,
                    "reason": reasons[name],
                    "strip": [[own.start, own.option, own.said] for own in self.segments(name)],
                }
                for place, name in enumerate(names)
            ]
            return {
                "title": self.path.name,
                "formats": [*self.exporters],
                "uncertain": self._uncertain(),
                "revision": self.revision,
                "level": self.level,
                "levels": [*self.fit.names],
                "names": list(document.names),
                "colours": [option_colour(option + 1) for option in range(len(document.names))],
                "frequency": self.frequency,
                "demos": demos,
                "order": ranked,
                "summary": self.summary(),
                "can_undo": bool(document.done),
                "can_redo": bool(document.undone),
                "refit": {
                    "running": self.background.running,
                    "progress": self.background.progress,
                    "done": self.refits,
                    "error": self.background.error,
                },
                "warnings": self.warnings(),
                "out": str(self.out),
                "dirty": self.edits != self.saved,
            }

    def summary(self) -> dict[str, Any]:
        """The expected share of wrong steps, how much of it is in the demonstration to label next, and labelled ones.

        Both shares are None before anything is accepted.
        """
        steps, labelled = sum(self.document.lengths.values()), len(self.document.accepted)
        following = self.demos.names[self.order[0][0]]
        return {
            "expected_wrong": sum(self.wrong.values()) / steps if labelled else None,
            "one_more": self.wrong[following] / steps if labelled else None,
            "labelled": labelled,
        }

    def warnings(self) -> list[str]:
        """What a person should know: the file of demonstrations that changed underneath."""
        return [] if self._unchanged() else [f"{self.path} changed while it was labelled; start again to go on with it"]

    def _unchanged(self) -> bool:
        return self.path.exists() and version(self.path) == self.version

    def _order(self) -> tuple[list[int], dict[str, str]]:
        """Demonstrations that are not accepted, the one most worth labelling first, and why; then the others."""
        lengths, accepted = self.document.lengths, self.document.accepted
        wrong, steps = np.array([self.wrong[name] for name in lengths]), np.array([*lengths.values()])
        edits = 1 + np.array([len(self.segments(name)) for name in lengths]) * wrong / steps
        centres = np.stack([self.proposals.centre(name, 0, own) for name, own in lengths.items()])
        ranked, farthest = ranking(wrong, edits, centres, np.array([name in accepted for name in lengths]))
        reasons = {name: f"{self.wrong[name]:.0f} of {own} steps expected wrong" for name, own in lengths.items()}
        if farthest is not None:
            reasons[[*lengths][farthest]] += "; the least like those you labelled"
        return ranked, reasons

    def _uncertain(self) -> list[dict[str, int]]:
        """The boundaries at which the shown option is least likely, the least likely first."""
        found = [
            (float(self.shown[name].probability[max(own.start - 1, 0) : own.start + 1].min()), place, own.start)
            for place, name in enumerate(self.demos.names)
            for own in self.segments(name)[1:]
            if self.document.labels[name][own.start - 1 : own.start + 1].min() == FREE
        ]
        return [{"demo": place, "step": step} for _, place, step in sorted(found)[:UNCERTAIN]]

    def segments(self, name: str) -> list[Segment]:
        """The segments of a demonstration that are shown."""
        return self.view.segments(name)

    def demo(self, index: int) -> dict[str, Any]:
        """One demonstration with its segments, boundaries, and what follows the cursor."""
        with self.lock:
            name = self._name(index)
            shown, drawn, own = self.shown[name], self.proposals.drawn(name), self.segments(name)
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
                for number, every in self.proposals.upper(name)
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
            here = self.view.at(name, step)
            centre, found = self.proposals.centre(name, here.start, here.stop), []
            for place, other in enumerate(self.demos.names):
                if other != name:
                    for own in self.segments(other):
                        away = float(np.linalg.norm(self.proposals.centre(other, own.start, own.stop) - centre))
                        found.append((away, place, own))
            found.sort(key=lambda one: one[0])
            return [
                {"index": place, "start": own.start, "stop": own.stop, "option": own.option}
                for _, place, own in found[:NEAREST]
            ]

    # --- what a person says -------------------------------------------------------------------------------------------

    def edit(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a person asks, on disk before this returns.

        :raises BadInput: the command is none, or cannot be done here.
        """
        with self.lock:
            before, do = self._shown_now(), command.get("do")
            index = whole(command, "demo") if "demo" in command else None
            name = None if index is None else self._name(index)
            if do in ("undo", "redo"):
                getattr(self.journal, do)()
                last = (self.document.undone if do == "undo" else self.document.done)[-1]
                touched = next((change[1] for change in last if change[0] != "names"), None)
                index = None if touched is None else self.demos.names.index(touched)
            else:
                self.journal.edit(self.view.changes(str(do), name, command))
            self.edits += 1
            self._update(before, None if index is None else self.demos.names[index])
            self._name_options()
            if do == "accept":
                self.refit()
            return {
                "revision": self.revision,
                "demo": index,
                "changed": sorted(self.changed),
                "summary": self.summary(),
                "can_undo": bool(self.document.done),
                "can_redo": bool(self.document.undone),
            }

    def _name(self, index: int) -> str:
        if not 0 <= index < len(self.demos):
            raise BadInput(f"there is no demonstration {index}; there are 0 to {len(self.demos) - 1}")
        return self.demos.names[index]

    def _name_options(self) -> None:
        """Give the run's options the names of the options that they stand for."""
        ours, known = self.document.names, self.run.names[self.level][1:]
        stand = self.proposed.aligned(self.document.labels)[1:]
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
            waiting = self.proposals.waiting
            kept = {name: np.where(np.isin(own, waiting), own, FREE) for name, own in self._shown_now().items()}
            trained, count = replace(self.fit, given=None), len(self.document.names)
        keys = trained.spec.observed
        demos = Demonstrations(
            tuple(replace(demo, observations={key: demo.observations[key] for key in keys}) for demo in self.demos),
            attributes=self.demos.attributes,
        )
        return partial(refit, trained, self.level, count, labelled(demos, labels), kept)

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

    def export(self, form: str, folder: Path) -> Path:
        """Write the shown segments in one of ``segment``'s formats into a folder.

        :returns: the file or folder that was written.
        :raises BadInput: there is no such format, or it does not fit the demonstrations.
        """
        if form not in self.exporters:
            raise BadInput(f"there is no format {form!r}; there is: {', '.join(self.exporters)}")
        with self.lock, open_source(self.path) as source:
            named = replace(self.fit, named={**self.fit.named, self.level: self.document.names})
            segmented = shown_segments(self.fit, source, self.level, self.shown, self.document.names)
        return self.exporters[form](segmented, named, folder, self.level)

    def close(self) -> None:
        """Save, end what is under way, and leave the labels to other processes."""
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
