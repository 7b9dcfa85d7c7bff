"""Output of the command line: progress, tables and lines of text."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Self

import numpy as np
from rich import progress as rich_progress
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.text import Text

from ddco_pyro.data.controls import described, few, notes
from ddco_pyro.data.errors import printable
from ddco_pyro.drawing import words
from ddco_pyro.drawing.page import Table
from ddco_pyro.evaluation import verdicts
from ddco_pyro.events import (
    CellDone,
    CellsBegan,
    Counted,
    EpochEnded,
    Event,
    RestartDiverged,
    RestartStopped,
    TrainingBegan,
    TrainingEnded,
)
from ddco_pyro.names import label_name, method, option_name

if TYPE_CHECKING:
    from ddco_pyro.data.inspection import Field, Inspection
    from ddco_pyro.evaluation.agreement import Annotators
    from ddco_pyro.fitting.fitted import Fit
    from ddco_pyro.metrics import Metrics
    from ddco_pyro.model.hierarchy import Hierarchy
    from ddco_pyro.spec import Spec
    from ddco_pyro.training.labels import Labels
    from ddco_pyro.training.networks import Dimensions

PLAIN_SECONDS = 10.0
"""Time between two plain lines of progress."""

WIDE = 200
"""Columns of a file or a pipe."""


class Progress:
    """Shows events: a bar with the time left on a terminal, elsewhere a plain line every ten seconds.

    >>> with ddco_pyro.Progress() as progress:
    ...     fit = ddco_pyro.fit("mine.yaml", demos, on_event=progress)
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._terminal = self._console.is_terminal
        self._rich = rich_progress.Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
            get_time=time.monotonic,
            speed_estimate_period=float("inf"),  # an epoch may take longer than any period
            disable=not self._terminal,
        )
        self._task: rich_progress.Task | None = None
        self._last = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._terminal:
            self._rich.stop()

    def __call__(self, event: Event) -> None:
        """Show an event."""
        match event:
            case TrainingBegan(model, epochs):
                name, _, further = model.partition(" ")
                self._begin(f"training {method(name)} {further}".rstrip(), epochs)
            case EpochEnded():
                values = f"training {event.train:.3f}, tuning {event.tune:.3f} nats/step"
                self._advance(note=f"{event.stage}: {values}")
            case RestartStopped(restart, epochs):
                self._say(f"restart {restart}: stopped at epoch {epochs} (far behind the likeliest)")
            case RestartDiverged(restart, why):
                self._say(f"restart {restart}: diverged: {why}")
            case TrainingEnded():
                self.end()
            case CellsBegan(work, total, kept):
                self._begin(f"{work}{f' ({kept} of {total} kept)' if kept else ''}", total - kept)
            case CellDone(cell, failed):
                if failed:
                    self._say(f"{cell} failed: {failed}")
                self._advance(note=cell)
            case Counted(work, total, note, done):
                self._advance(work, total, done, note)

    def _begin(self, label: str, total: int | None) -> None:
        """Begin to count up to ``total``, or without an end for None."""
        self.end()
        self._rich.start()
        self._rich.add_task(label, total=total, note="")
        self._task, self._last = self._rich.tasks[-1], time.monotonic()

    def _advance(
        self, label: str = "", total: int | None = None, done: int | None = None, note: str = ""
    ) -> None:
        """Count one more, or ``done`` in all; begin with this label and total where no count is open."""
        if self._task is None or (label and self._task.finished):
            self._begin(label, total)
        assert self._task is not None
        task, advance = self._task, 1 if done is None else None
        if task.finished and done is None:  # more comes than was likely
            self._rich.update(task.id, total=2 * task.completed)
        self._rich.update(task.id, completed=done, advance=advance, note=note)
        if not self._terminal and (task.finished or time.monotonic() - self._last > PLAIN_SECONDS):
            self._last = time.monotonic()
            of = "" if task.total is None else f"/{task.total:.0f}"
            left = "" if task.time_remaining is None else f", {task.time_remaining:.0f} s left"
            self._say(f"{task.completed:.0f}{of}{left}  {note}".rstrip())

    def end(self) -> None:
        """End the count, complete or not."""
        if self._task is not None and not self._task.finished:
            done = self._task.completed
            if not self._terminal:
                self._say(f"done after {done:.0f}, {self._task.elapsed or 0:.0f} s")
            self._rich.update(self._task.id, total=max(done, 1), completed=max(done, 1))
        self._task = None

    def _say(self, text: str) -> None:
        label = f"{self._task.description}: " if self._task else ""
        self._console.print(Text(label + text), soft_wrap=True)


def say(text: str) -> None:
    """Print a line that is not wrapped and has no markup."""
    Console().print(Text(text), soft_wrap=True)


def show(table: Table) -> None:
    """Print a table; cells are never cut."""
    Console(width=None if Console().is_terminal else WIDE).print(table.console())


# --- check --------------------------------------------------------------------------------------------------


def model(
    spec: Spec, size: Dimensions, hierarchy: Hierarchy, baselines: Sequence[tuple[Spec, Hierarchy]]
) -> None:
    """Shapes, parameters of each network and baseline, the kinds of the control, a device that is no CPU."""
    from ddco_pyro.training.networks import parameters
    from ddco_pyro.training.processes import described as device_in_words
    from ddco_pyro.training.processes import device_of

    rows = [[f"observation {key}", str(list(size.shapes[key]))] for key in spec.observed]
    rows += [["features", str(len(hierarchy.encoder.mean))], ["control", str([size.control_size])]]
    for place in hierarchy.networks():  # each with the σ of its control
        name = f"hierarchy.{place}" if hierarchy.depth else "baseline.policy"
        rows.append([name, str(parameters(hierarchy.get_submodule(place)))])
    rows += [["all networks", str(parameters(hierarchy))]]
    for number, (other, policy) in enumerate(baselines):
        rows.append([f"compare_with.{number}: {_baseline(other)}", str(parameters(policy))])
    show(Table(["", "shape or parameters"], rows))
    unknown = ["control: its kinds are decided once demonstrations have been collected (ddco-pyro collect)"]
    for note in (*notes(size.control), *(described(hierarchy.scaling.parts) if size.control else unknown)):
        say(note)
    if spec.training.device != "cpu":
        say(f"networks: on {device_in_words(device_of(spec.training))}")


def _baseline(spec: Spec) -> str:
    """A baseline's name and, of a policy without options, the sizes of its hidden layers."""
    from ddco_pyro.training.networks import model_name

    if spec.baseline is None:
        return model_name(spec)
    hidden = list(spec.baseline.policy.hidden_sizes)
    return f"{spec.baseline.kind}, {f'hidden: {hidden}' if hidden else spec.baseline.policy.network}"


def labels(spec: Spec, used: Labels | None, known: Mapping[str, Sequence[str]]) -> None:
    """The label of each option, where training uses labels, and a warning where its start does not.

    :param known: the names of labels 0, 1, ... by name of labels.
    """
    own = spec.training.labels
    if used is not None and own is not None:
        names = (label_name(own.source, value, known.get(own.source, ()), own.level) for value in used.values)
        each = ", ".join(f"{name} is {option_name(option)}" for option, name in enumerate(names, start=1))
        used_of = f"used of {len(used.demonstrations)} demonstrations"
        say(f"labels/{own.source}, level {own.level!r}: {each}; {used_of}")
        from ddco_pyro.evaluation.options import unlabelled_start

        for what, advice in unlabelled_start(spec.training):
            say(f"warning: {what} {advice}")


# --- fit, select, rollout -----------------------------------------------------------------------------------


def skills(fit: Fit) -> None:
    """How each option is used, how long segments are, and how they agree with labels."""
    from ddco_pyro.evaluation.options import beside_equal_parts
    from ddco_pyro.report.options import use_table

    if fit.spec.hierarchy:
        show(use_table(fit))
        say(verdicts.twitches(fit.metrics.segments, fit.metrics.control_frequency))
        for text, worse in beside_equal_parts(fit.metrics):
            if not worse:
                say(text)


def warnings(fit: Fit) -> None:
    """What is doubtful about the model, and what to do."""
    from ddco_pyro.report.training import doubts

    for what, advice in doubts(fit):
        say(f"warning: {what} {advice}")


def log_likelihoods(fit: Fit) -> None:
    """Log-likelihood of the model and its baselines, the test against the mixture, and what is doubtful."""
    from ddco_pyro.report.likelihood import parts, stds, table

    metrics = fit.metrics
    if said := verdicts.tested(metrics):
        say(said)
    if found := parts(metrics):
        show(found)
    show(table(metrics, 3, "log-likelihood, nats per step (higher is better)"))
    others = {name: one.training for name, one in metrics.comparison.items()}
    for what, advice in (*verdicts.faults(metrics), *verdicts.unconverged(others)):
        say(f"warning: {what} {advice}")
    if differ := stds(fit):
        say(differ)
    for name, training in metrics.trainings.items():
        if restarts := verdicts.restarts(training):
            say(f"{name}: {restarts}")


def seeds(metrics: Metrics) -> None:
    """Variation of the models of a run over training seeds; nothing where the fit was not repeated."""
    if found := metrics.seeds:
        rows = [[method(name), *words.spread(values)] for name, values in found.held_out.items()]
        title = f"held-out nats per step over training seeds {words.listed(map(str, found.training_seeds))}"
        show(Table(["Method", "mean", "95 % interval", "range"], rows, title=title))


def library(fitted: Fit) -> None:
    """Say how strong a prior the library of a fit is, and who chose that."""
    given, ridge = fitted.spec.training.library, fitted.metrics.training.raised_ridge
    if given is not None and ridge is not None:
        chosen = ", which its own tasks chose" if given.ridge is None else ""
        say(f"the weights begin at {given.run} and are drawn towards it by a ridge of {ridge:g}{chosen}")


def names(fit: Fit) -> None:
    """The names in ``names.yaml``, their agreement with labels, and the line that takes proposed ones."""
    found = {(one.level, one.option): one for one in fit.metrics.named_by_labels}
    each = {
        level: [(name, found.get((level, option))) for option, name in enumerate(own[1:], start=1)]
        for level, own in fit.names.items()
    }
    if told := verdicts.recogniser(fit.metrics.training):
        say(f"labels: {told}")
    for row, (accuracy, edit) in verdicts.contributions(fit.metrics.training).items():
        say(f"  left out, {row}: accuracy {words.number(accuracy)}, edit score {words.number(edit)}")
    file = fit.run_folder / "names.yaml"
    written = [
        f"{name} {words.number(one.agreement)}" if one and one.name == name else name
        for level in fit.named
        for name, one in each[level]
    ]
    if written:
        say(f"names: {file}: {', '.join(written)}")
    for level, pairs in each.items():
        proposed = {name: one for name, one in pairs if one and name == option_name(one.option)}
        if proposed:
            said = [f"{name} as {one.name} {words.number(one.agreement)}" for name, one in proposed.items()]
            taken = [proposed[name].name if name in proposed else name for name, _ in pairs]
            line = json.dumps({level: taken}, ensure_ascii=False)[1:-1]
            say(f"names proposed, not written: {words.listed(said)}; to take them, write into {file}: {line}")
    if found:
        labels = words.listed(dict.fromkeys(f"labels/{one.labels}" for one in found.values()))
        share = "the steps with both an option and its label, divided by the steps with either."
        say(f"Agreement with {labels}: {share}")


def successes(metrics: Metrics) -> None:
    """The measures of each method's rollouts, and what the hierarchy is worth by them."""
    from ddco_pyro.report.rollouts import measures_table

    assert metrics.rollouts is not None  # it has been rolled out
    show(measures_table(metrics.rollouts.methods, title=f"{metrics.rollouts.episodes} episodes each"))
    say(verdicts.success(metrics))


# --- inspect ------------------------------------------------------------------------------------------------


UNKNOWN_FREQUENCY = (
    'not in the file; with h5py, file.attrs["control_frequency"] = 20 says 20 steps per second, '
    "and pages have seconds"
)


def inspection(facts: Inspection) -> None:
    """The contents of a file of demonstrations."""
    steps = np.array(list(facts.lengths.values()) or [0])
    lengths = f"{steps.min()} to {steps.max()} steps (median {np.median(steps):g}, {steps.sum()} in all)"
    lines = [
        f"{facts.path}: {facts.format}, {len(facts.lengths)} demonstrations of {lengths}",
        f"control frequency: {f'{facts.frequency:g} Hz' if facts.frequency else UNKNOWN_FREQUENCY}",
        *(f"mask/{name}: {len(names)} demonstrations" for name, names in facts.masks.items()),
    ]
    for line in lines:
        say(printable(line))
    if facts.several:
        _tasks(facts)
    elif facts.tasks:
        tasks = few([*facts.tasks]) if len(facts.tasks) < 4 else len(facts.tasks)
        say(printable(f"tasks: {tasks}"))
    fields = facts.fields.values()
    rows = [[own.place, str(list(own.shape)), str(own.dtype), _range(own), _notes(own)] for own in fields]
    printed = [list(map(printable, row)) for row in rows]
    show(Table(["", "a step", "type", "range", "notes"], printed, range(5)))
    for line in (*facts.notes, *(f"problem: {problem}" for problem in facts.problems)):
        say(printable(line))


def _tasks(facts: Inspection) -> None:
    """A row for each task: its demonstrations, their steps, and the arrays that only some tasks have."""
    partial = [field for field in facts.fields.values() if field.demonstrations < len(facts.lengths)]
    rows = []
    for task, names in facts.tasks.items():
        steps = [facts.lengths[name] for name in names]
        has = [field.place for field in partial if {*names} <= {*field.having}]
        lengths = [str(len(names)), f"{min(steps)} to {max(steps)}", f"{np.median(steps):g}"]
        rows.append([printable(task or "none"), *lengths, printable(", ".join(has))])
    head = ["task", "demonstrations", "steps", "median", "only some have"]
    show(Table(head, rows, {0, 4}))


def annotators(found: Mapping[str, Annotators], tolerance: int) -> None:
    """How two annotators agree on each name of labels, and what the second calls the first one's segments."""
    head = ["labels", "demonstrations", "steps", "said by both", "same name", "Cohen's κ", "boundaries"]
    rows = []
    for name, own in found.items():
        middle = float(np.median(own.distances)) if own.distances else None
        same = own.same / own.both if own.both else None
        said = [words.percent(own.both / own.steps), words.percent(same), words.number(own.kappa)]
        boundaries = " and ".join(map(str, own.boundaries))
        matched = [boundaries, words.number(own.boundary_f1), words.number(middle, 1)]
        rows.append([name, str(own.demonstrations), str(own.steps), *said, *matched])
    show(Table([*head, f"F1 ±{tolerance}", "median distance"], rows))
    for name, own in found.items():
        rows = []
        for called, counts in zip(own.names, own.counts, strict=True):
            if any(counts):
                shares = [words.percent(count / sum(counts)) if count else "" for count in counts]
                rows.append([called, str(sum(counts)), *shares])
        show(Table([name, "steps", *own.names], rows, title="Names of the first file (rows) in the second"))


def _range(field: Field) -> str:
    low, high = field.minimum[np.isfinite(field.minimum)], field.maximum[np.isfinite(field.maximum)]
    if not len(low) or not len(high):
        return "-"
    return f"{float(low.min()) + 0.0:.4g} to {float(high.max()) + 0.0:.4g}"  # + 0.0: no minus zero


def _notes(field: Field) -> str:
    notes = ["video" if field.video else "image"] if field.image else []
    notes += [field.unusable] if field.unusable else []
    if field.names:
        notes.append(", ".join(f"{value}: {name}" for value, name in enumerate(field.names)))
    if field.unknown:
        notes.append(f"{field.unknown} steps unknown (-1)")
    constant, rounding = field.constant, field.rounding
    if constant + rounding and len(constant + rounding) == len(field.minimum):
        notes.append("constant up to rounding" if rounding else "constant")
    elif constant + rounding and not field.image:
        listed = {"constant": constant, "constant up to rounding": rounding}
        notes += [f"{what}: {', '.join(map(str, dims))}" for what, dims in listed.items() if dims]
    elif field.still and not field.video:
        notes.append("one value per demonstration")
    return "; ".join(notes)
