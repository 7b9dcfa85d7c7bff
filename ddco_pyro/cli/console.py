"""What the command line shows: progress with the time left on a terminal, plain lines elsewhere, and small tables."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich import progress as rich_progress
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ddco_pyro.data.controls import described, notes
from ddco_pyro.drawing import words
from ddco_pyro.events import (
    CandidateGivenUp,
    DemonstrationsDone,
    EpisodeEnded,
    EpochEnded,
    Event,
    FoldScored,
    RestartDiverged,
    RestartStopped,
    SeedFitted,
    SelectionBegan,
    TrainingBegan,
    TrainingEnded,
    UpdatesDone,
)
from ddco_pyro.training.stages import effort

if TYPE_CHECKING:
    from ddco_pyro.fitting.merging import Pair
    from ddco_pyro.model.hierarchy import Hierarchy
    from ddco_pyro.selection import Choice
    from ddco_pyro.spec import Spec
    from ddco_pyro.training.labels import Labels
    from ddco_pyro.training.networks import Dimensions

PLAIN_SECONDS = 10.0
"""Time between two plain lines of progress."""


class _Bar:
    """A progress bar on a terminal; elsewhere a plain line now and then, with the time left."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
        self._progress = rich_progress.Progress(
            *columns, TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=self.console
        )
        self._task: TaskID | None = None
        self._label, self._done = "", 0
        self._total: int | None = 0
        self._start = self._said = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self._progress.stop()

    def begin(self, label: str, total: int | None) -> None:
        """Begin to count up to ``total``; None where nobody knows how far it goes."""
        self.end()
        if self.console.is_terminal:
            self._progress.start()  # once: what is refused before leaves the terminal alone
        self._label, self._total, self._done = label, total, 0
        self._start = self._said = time.monotonic()
        self._task = self._progress.add_task(label, total=total, note="")

    def advance(self, done: int, note: str = "") -> None:
        """So much is done."""
        self._done = done
        if self._task is not None:
            self._progress.update(self._task, completed=done, note=note)
        now = time.monotonic()
        if not self.console.is_terminal and (now - self._said > PLAIN_SECONDS or done == self._total):
            self._said = now
            self._say(f"{self._place(now)}  {note}".rstrip())

    def _place(self, now: float) -> str:
        """How far it has come, and the time left; that does not follow from a late first, which waited for a start."""
        if self._total is None:
            return str(self._done)
        if self._done == 1 < self._total and now - self._start > PLAIN_SECONDS:
            return f"1/{self._total}"
        left = (now - self._start) / max(self._done, 1) * (self._total - self._done)
        return f"{self._done}/{self._total}, at most {left:.0f} s left"

    def end(self) -> None:
        """Whatever was counted is over, however far it came."""
        if self._task is not None:
            self._progress.update(self._task, total=max(self._done, 1), completed=max(self._done, 1))
            if not self.console.is_terminal and self._done != self._total:
                self._say(f"done after {self._done}, {time.monotonic() - self._start:.0f} s")
        self._task = None

    def _say(self, text: str) -> None:
        self.console.print(f"{self._label}: {text}", markup=False, highlight=False, soft_wrap=True)


class Progress(_Bar):
    """Shows events as they happen.

    :param label: what is done with demonstrations one by one.
    """

    def __init__(self, label: str = "collecting demonstrations") -> None:
        super().__init__()
        self._what = label

    def __call__(self, event: Event) -> None:
        """Show an event."""
        match event:
            case DemonstrationsDone(done, total):
                self._begun(self._what, total)
                self.advance(done)
            case TrainingBegan(model, epochs):
                self.begin(f"training {model}", epochs)
            case EpochEnded():
                note = f"{event.stage}: training {event.train:.3f}, tuning {event.tune:.3f} nats/step"
                self.advance(self._done + 1, note)
            case UpdatesDone(done, loss):
                self.advance(done, f"loss {loss:.2g}")
            case RestartStopped(restart, epochs):
                self._say(f"restart {restart} stopped after {epochs} epochs of its last stage: others are better")
            case RestartDiverged(restart, why):
                self._say(f"restart {restart} diverged: {why}")
            case TrainingEnded():
                self.end()
            case SelectionBegan(total, kept):
                note = f" ({kept} of {total} kept from before)" if kept else ""
                self.begin(f"cross-validation{note}", total - kept)
            case FoldScored(candidate, fold, failed):
                if failed:
                    self._say(f"{candidate}, fold {fold} failed: {failed}")
                self.advance(self._done + 1, f"{candidate}, fold {fold}")
            case CandidateGivenUp(candidate, folds):
                self._say(f"{candidate}: stopped early, {folds} folds less")
                self.advance(self._done + folds)
            case SeedFitted(total):
                self._begun("fitting with other training seeds", total)
                self.advance(self._done + 1)
            case EpisodeEnded(method, total):
                self._begun("rolling out", total)
                self.advance(self._done + 1, method)

    def _begun(self, label: str, total: int) -> None:
        """Begin to count, unless that was begun already."""
        if self._task is None:
            self.begin(label, total)


def dimensions(spec: Spec, size: Dimensions, hierarchy: Hierarchy, baselines: Sequence[tuple[Spec, Hierarchy]]) -> None:
    """Shapes of observations and control, and the parameters of each network and of each baseline."""
    from ddco_pyro.training.networks import parameters

    table = Table("", "shape or parameters", show_edge=False)
    for key in spec.observed:
        table.add_row(f"observation {key}", str(list(size.shapes[key])))
    table.add_row("features", str(len(hierarchy.encoder.mean)))
    table.add_row("control", str([size.control_size]))
    for name, network in hierarchy.named_networks():
        table.add_row(name, str(parameters(network)))
    table.add_row("all networks", str(parameters(hierarchy)))
    for number, (other, policy) in enumerate(baselines):
        table.add_row(f"compare_with.{number}: {_baseline(other)}", str(parameters(policy)))
    _show(table)


def _baseline(spec: Spec) -> str:
    """A baseline's name and, of a policy without options, the sizes of its hidden layers."""
    from ddco_pyro.training.networks import model_name

    if spec.baseline is None:
        return model_name(spec)
    hidden = list(spec.baseline.policy.hidden_sizes)
    return f"{spec.baseline.kind}, {f'hidden: {hidden}' if hidden else spec.baseline.policy.network}"


def control(size: Dimensions, hierarchy: Hierarchy) -> None:
    """What is odd about dimensions of the control, and how each is modelled, a line each."""
    unknown = ["control: its kinds are decided once demonstrations have been collected (ddco-pyro collect)"]
    for note in (*notes(size.control), *(described(hierarchy.scaling.parts) if size.control else unknown)):
        Console().print(Text(note), soft_wrap=True)


def device(spec: Spec) -> None:
    """Where networks live, where the spec leaves that open or names a GPU."""
    from ddco_pyro.training.devices import described, device_of

    if spec.training.device != "cpu":
        where = f"networks: on {described(device_of(spec.training))}, {spec.training.precision} in gradient steps"
        Console().print(Text(where), soft_wrap=True)


def labels(spec: Spec, used: Labels | None) -> None:
    """For which label each option stands, where training uses labels."""
    from ddco_pyro.drawing.words import option_name

    own = spec.training.labels
    if used is None or own is None:
        return
    names = ", ".join(f"{value} is {option_name(option)}" for option, value in enumerate(used.values, start=1))
    text = f"labels/{own.source}, level {own.level!r}: {names}; used of {len(used.demonstrations)} demonstrations"
    Console().print(Text(text), soft_wrap=True)


ONE_FIT = (
    "± is one standard error over the held-out demonstrations of one fit; other training seeds give other fits: "
    "repeat them with --seeds 5."
)


def log_likelihoods(metrics: Mapping[str, Any]) -> None:
    """Log-likelihood of the model and of what it is compared with, in training and on what was held out."""
    head = ("model", "training", "validation (held out)", "ours - this, validation", "gradient steps")
    table = Table(*head, title="log-likelihood, nats per step", show_edge=False)
    rows = {metrics["model"]: metrics, **metrics["comparison"]}
    for name, row in rows.items():
        values, difference = row["log_likelihood_per_step"], row.get("difference")
        shown = _difference(difference) if difference else ""
        numbers = [_number(values[part]) for part in ("train", "valid")]
        table.add_row(name, *numbers, shown, effort(row.get("training")))
    _show(table)
    if "worth" in metrics:
        said = words.worth(metrics["worth"], words.method(metrics["model"]), len(metrics["valid"]))
        Console().print(Text(f"{said} {ONE_FIT if 'seeds' not in metrics else ''}".rstrip()), soft_wrap=True)
    for name, training in words.trainings(metrics).items():
        if beside := words.restarts(training):
            Console().print(Text(f"{name}: {beside}"), soft_wrap=True)


def seeds(metrics: Mapping[str, Any]) -> None:
    """How much the models of a run vary with the training seed; nothing where the fit was not repeated."""
    if "seeds" not in metrics:
        return
    found = metrics["seeds"]
    rows = [[name, *words.spread(values)] for name, values in found["held_out"].items()]
    title = f"held-out nats per step over training seeds {words.listed(map(str, found['training_seeds']))}"
    comparison(("model", "mean", "95 % interval", "range"), rows, title)
    Console().print(Text(words.over_seeds(found, words.method(metrics["model"]))), soft_wrap=True)


def merged(pair: Pair, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Which options are one now, and what that does to the likelihood of what was held out."""
    first, second = pair.options
    apart = "" if pair.divergence is None else f", {pair.divergence:.2f} nats per step apart"
    values = [_number(metrics["log_likelihood_per_step"]["valid"]) for metrics in (before, after)]
    text = f"options {first} and {second}{apart}, are one: held out {values[0]} before, {values[1]} now"
    Console().print(Text(text), soft_wrap=True)


def _difference(paired: Mapping[str, Any]) -> str:
    error = paired["standard_error"]
    shown = "unknown (one held out)" if error is None else f"{error:.3f}"
    return f"{paired['nats_per_step']:+.3f} ± {shown}"


def selection(choice: Choice, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """The candidates of a selection, with what has to be known to read the numbers."""
    comparison(head, rows, "held-out log-likelihood by cross-validation, nats per step")
    for note in choice.notes:
        Console().print(Text(f"note: {note}"), soft_wrap=True)


def comparison(head: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> None:
    """What is compared, a row for each, the best first where there is a best."""
    table = Table(*head, title=title, show_edge=False)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    _show(table)


WIDE = 200
"""Columns of a file or a pipe, which have no width of their own."""


def _show(table: Table) -> None:
    """Nothing is cut: what is too long for a terminal goes on in the next line."""
    for column in table.columns:
        column.overflow = "fold"
    Console(width=None if Console().is_terminal else WIDE).print(table)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def warnings(signs: Sequence[tuple[str, str]]) -> None:
    """Signs of a degenerate solution, each in words and with what usually helps."""
    console = Console()
    for what, advice in signs:
        console.print(Text(f"warning: {what} {advice}"), soft_wrap=True)


def successes(results: Mapping[str, Any], ours: str) -> None:
    """What came of each method's rollouts, and what the hierarchy is worth by them.

    :param ours: the model's name.
    """
    methods: Mapping[str, Any] = results["methods"]
    measures = list(dict.fromkeys(name for result in methods.values() for name in result["measures"]))
    table = Table("method", *measures, title=f"{results['episodes']} episodes each", show_edge=False)
    for name, result in methods.items():
        table.add_row(name, *(_measure(result["measures"].get(measure)) for measure in measures))
    _show(table)
    if said := words.success_worth(results, words.method(ours)):
        Console().print(Text(said), soft_wrap=True)


def _measure(summary: Mapping[str, Any] | None) -> str:
    if summary is None or summary["trials"] == 0:
        return "-"
    if "successes" in summary:
        low, high = summary["interval"]
        return f"{summary['successes']}/{summary['trials']} [{low:.0%}, {high:.0%}]"
    return f"{summary['mean']:.2f}" + (f" ± {summary['std']:.2f}" if summary["std"] is not None else "")
