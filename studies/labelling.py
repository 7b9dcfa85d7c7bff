"""What the page of ``ddco-pyro label`` saves a person, by simulated people who know the true labels.

    python -m studies.labelling [--tasks pick-place-v3 ...] [--data FOLDER] [--orders page random ...] [--seeds 4]
        [--fits 3] [--most 5] [--slack 1] [--jobs 2] [--runs DIR]

Tasks are nine of Meta-World, with fifty demonstrations, and ``Knot_Tying`` and ``Suturing`` in FOLDER, as
``people.py`` has them. A person opens a demonstration and does a few commands of the page that make every name
right, and every boundary within SLACK steps: the first of a plan, then that of a new plan for what the page shows next.
Then the person accepts and opens another one, until the target is reached and at least MOST are labelled. Each command
counts one, and so does the naming of an option. Adds its numbers to ``docs/results/labelling.csv``.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import only_one
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.evaluation.agreement import equal_lengths
from ddco_pyro.evaluation.inferred import runs
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.fitting.run import is_finished
from ddco_pyro.labelling import proposals, refitting
from ddco_pyro.labelling.document import OPEN
from ddco_pyro.labelling.session import Session
from ddco_pyro.selection.small import decide
from ddco_pyro.spec import parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from studies import study
from studies.apart import HELD_OUT, Apart
from studies.people import ALONE_WEIGHT, NOTHING, labelled_demonstrations
from studies.people import LABELS as GESTURES
from studies.study import Cell, Row, Settings, described

SURGEONS = ("Knot_Tying", "Suturing")
CHOSE = ("pick-place-v3", "hammer-v3", "stick-pull-v3")
"""Tasks by which settings of the page were chosen."""
TASKS = (*CHOSE, "assembly-v3", "shelf-place-v3", "disassemble-v3", "basketball-v3", "hand-insert-v3", "sweep-into-v3")
LABELS = "phase"
TRAINED = 50
ORDERS = ("page", "random", "longest", "recogniser", "equal parts", "from scratch")
DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1, "most": 5, "slack": 1}, Path("runs/arena"))
SHOWN = (0, 1, 2, 3, 5, 10)
"""Labelled demonstrations after which the table says what there is."""
UNKNOWN = -1
PATIENCE = 200
"""Commands in a demonstration after which a person paints what is wrong."""

Segments = Sequence[tuple[int, int, int]]
"""(option, first step, step after the last)."""
Command = dict[str, Any]


@dataclass(frozen=True)
class LabellingCell(Cell):
    """A task, in which order its demonstrations are labelled, how many random orders, and the first fit's seed."""

    data: str
    task: str
    order: str
    orders: int = 1
    seed: int = 0

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.task}-{self.order.replace(' ', '_')}-{self.orders}-{self.seed}"

    @property
    def target(self) -> float:
        """The share of right steps that is asked for."""
        return 0.85 if self.task in SURGEONS else 0.95

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """What there is before the first label and after each demonstration, and the edits at the target."""
        demos, key = self.demonstrations(settings)
        truth = [demo.labels[key] for demo in demos]
        scratch = reached(from_scratch(truth), self.target)
        if self.order == "from scratch":
            curve = from_scratch(truth)
            return {"curve": curve, "edits": scratch, "scratch": scratch}
        if self.order == "equal parts":
            curve = from_equal_parts(truth, int(settings.values["slack"]))
            return {"curve": curve, "edits": reached(curve, self.target), "scratch": scratch}
        alone = {"control.power": NOTHING} if self.order == "recogniser" else {}
        weight = (lambda power: ALONE_WEIGHT) if alone else proposals.weight
        path, people = settings.runs / "labelling" / self.task / "demos.hdf5", list[Person]()
        changes = alone | {"training.seed": self.seed}
        first = first_fit(path, replace(demos, masks={}), len(named(truth)), changes)
        for seed in range(self.orders):
            with tempfile.TemporaryDirectory() as own, weighted(weight):
                session = Patient(first, path, Path(own) / "labels.hdf5")
                people.append(Person(session, truth, int(settings.values["slack"])))
                self._label(people[-1], int(settings.values["most"]), seed)
                session.close()
        curve = [dict(pd.DataFrame(looks).mean()) for looks in zip(*(person.curve for person in people), strict=False)]
        edits = [found for person in people if (found := reached(person.curve, self.target)) is not None]
        spread = {"sd": float(np.std(edits, ddof=1))} if len(edits) == len(people) > 1 else {}
        mean = float(np.mean(edits)) if len(edits) == len(people) else None
        return {"curve": curve, "edits": mean, "scratch": scratch, **spread}

    def _label(self, person: Person, most: int, seed: int) -> None:
        """Label so many demonstrations in order, and more until the target is reached; not of the control."""
        longest = np.argsort([-len(own) for own in person.truth], kind="stable").tolist()
        random = np.random.default_rng((self.seed, seed)).permutation(len(longest)).tolist()
        given = {"longest": longest, "random": random}.get(self.order)
        for number in range(len(person.truth)):
            if number >= most and (self.order == "recogniser" or person.curve[-1]["right"] >= self.target):
                break
            person.label(person.session.state()["order"][0] if given is None else given[number])
            person.session.refitted()
            person.look()

    def demonstrations(self, settings: Settings) -> tuple[Demonstrations, str]:
        """Those that are labelled, and the name of their true labels."""
        if self.task in SURGEONS:
            return labelled_demonstrations(Path(self.data) / f"{self.task}.hdf5"), GESTURES
        own = settings.values
        options = {"number": own["demonstrations"], "held_out": HELD_OUT, "noise": own["noise"]}
        demos = Demonstrations.read(sawyer(settings).collected(self.task, **options), labels=[LABELS])
        return demos.select(demos.masks["train"][:TRAINED]), LABELS

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """What there is after some demonstrations, and the edits at the target beside those of labelling from scratch.

        A target that is never reached has no rows. Tasks of Meta-World that chose nothing are in another study, too.
        """
        found = dict[tuple[int | None, str], float]()
        for number in (number for number in SHOWN if number < len(results["curve"])):
            values = results["curve"][number]
            found |= {(number, measure): value for measure, value in values.items()}
            found[number, "wrong"] = wrong = 1 - values["right"]
            if "expected wrong" in values:
                found[number, "expected less wrong"] = values["expected wrong"] - wrong
        if results["edits"] is not None:
            found[None, "edits at target"] = results["edits"]
            found[None, "share of edits"] = results["edits"] / results["scratch"]
            if "sd" in results:
                found[None, "edits at target, sd"] = results["sd"]
        studies = ["surgeons"] if self.task in SURGEONS else ["Meta-World"]
        studies += [] if self.task in (*SURGEONS, *CHOSE) else ["kept aside"]
        for study_name, ((number, measure), value) in itertools.product(studies, found.items()):
            yield Row(study_name, self.task, self.order, number, self.seed, measure, value)


def sawyer(settings: Settings) -> Apart:
    """Meta-World in its environment."""
    return Apart("arena_metaworld.py", "arena_requirements.txt", settings.runs)


class Patient(Session):
    """A session that fits again only when it is told to, and here."""

    def refit(self) -> None:
        """Nothing; a person is not interrupted."""

    def refitted(self) -> None:
        """Fit to what is said, as the page does in the background."""
        self.take(self.refitting()())


class Person:
    """Knows the true labels, and makes the page show them.

    :ivar options: of the page, by label.
    :ivar curve: what there is before the first label, and after each demonstration.

    :param truth: the label of each step of each demonstration; -1 where there is none.
    :param slack: how far a boundary may be off.
    """

    def __init__(self, session: Session, truth: Sequence[np.ndarray], slack: int) -> None:
        self.session, self.truth, self.slack = session, truth, slack
        self.options: dict[int, int] = {}
        self.edits, self.curve = 0, list[dict[str, float]]()
        self.look()

    def look(self) -> None:
        """Keep what there is."""
        expected = self.session.summary()["expected_wrong"]
        said = {} if expected is None else {"expected wrong": expected}
        self.curve.append({"edits": self.edits, "right": self.right(), **said})

    def right(self) -> float:
        """The share of the labelled steps of all demonstrations that the page shows under the right name."""
        shown = [self.session.shown[name].options for name in self.session.demos.names]
        wanted = [self._wanted(label) for label in self.truth]
        right = sum(
            int((own == option)[label >= 0].sum()) for own, option, label in zip(shown, wanted, self.truth, strict=True)
        )
        return right / sum(int((label >= 0).sum()) for label in self.truth)

    def label(self, index: int) -> None:
        """Make a demonstration right, and accept it."""
        self._name(index)
        wanted = runs_of(self._wanted(self.truth[index]))
        for _ in range(PATIENCE):
            commands = plan(self._shown(index), wanted, self.slack)
            if not commands:
                break
            self._do({**commands[0], "demo": index})
        else:
            for option, start, stop in wanted:
                self._do({"do": "paint", "demo": index, "start": start, "stop": stop, "option": max(option, 0)})
        self._do({"do": "accept", "demo": index})

    def _do(self, command: Command) -> None:
        self.session.edit(command)
        self.edits += 1

    def _shown(self, index: int) -> Segments:
        own = self.session.segments(self.session.demos.names[index])
        return [(OPEN if one.said == "open" else one.option, one.start, one.stop) for one in own]

    def _wanted(self, labels: np.ndarray) -> np.ndarray:
        """The option of each step's label, 0 for one that has no option yet."""
        return np.array([OPEN if label == UNKNOWN else self.options.get(label, 0) for label in labels.tolist()])

    def _name(self, index: int) -> None:
        """Name options after the labels of a demonstration that have none: those that share most steps with them."""
        shown = self.session.shown[self.session.demos.names[index]].options
        labels = [label for label in named([self.truth[index]]) if label not in self.options]
        count = len(self.session.document.names)
        free = [option for option in range(1, count + 1) if option not in self.options.values()]
        common = [
            [int(((self.truth[index] == label) & (shown == option)).sum()) for option in free] for label in labels
        ]
        for row, column in zip(*linear_sum_assignment(-np.array(common).reshape(len(labels), len(free))), strict=True):
            self.options[labels[row]] = free[column]
            self.edits += 1


def plan(shown: Segments, wanted: Segments, slack: int) -> list[Command]:
    """Commands that turn what is shown into what is wanted, the first ones first: few, though not always the fewest.

    The cheapest path through pairs of a shown and a wanted segment: the next wanted one is split off, the next shown
    one belongs to the same wanted one, or both go on at a boundary, which is moved where it is more than ``slack``
    steps off. A name that differs costs a naming.
    """
    best: dict[tuple[int, int], tuple[int, str]] = {}
    for i, (option, start, stop) in enumerate(shown):
        for j, (name, to, _) in enumerate(wanted):
            ways = [(0, "")] if i == j == 0 else []
            if (i, j - 1) in best and start < to < stop:
                ways.append((best[i, j - 1][0] + 1, "split"))
            if (i - 1, j) in best:
                ways.append((best[i - 1, j][0], "join"))
            if (i - 1, j - 1) in best and (abs(start - to) <= slack or shown[i - 1][1] < to < stop):
                ways.append((best[i - 1, j - 1][0] + (abs(start - to) > slack), "move"))
            if ways:
                cost, way = min(ways, key=lambda own: own[0])
                best[i, j] = cost + (option != name), way
    i, j, path = len(shown) - 1, len(wanted) - 1, list[tuple[int, int, str]]()
    while i >= 0 and j >= 0:
        way = best[i, j][1]
        path.append((i, j, way))
        i, j = i - (way != "split"), j - (way != "join")
    commands = list[Command]()
    for i, pairs in itertools.groupby(reversed(path), key=lambda own: own[0]):
        (option, start, _), own = shown[i], [*pairs]
        first = wanted[own[0][1]]
        if own[0][2] == "move" and abs(start - first[1]) > slack:
            commands.append({"do": "move", "boundary": start, "to": first[1]})
        commands += [{"do": "split", "step": wanted[j][1]} for _, j, way in own if way == "split"]
        for _, j, way in own:
            if wanted[j][0] != option:
                naming = {"do": "open"} if wanted[j][0] == OPEN else {"do": "name", "option": wanted[j][0]}
                commands.append({**naming, "step": wanted[j][1] if way == "split" else start})
    return commands


def named(truth: Sequence[np.ndarray]) -> list[int]:
    """The labels that occur."""
    return sorted({int(label) for own in truth for label in np.unique(own)} - {UNKNOWN})


def runs_of(options: np.ndarray) -> Segments:
    """Segments of equal options."""
    return runs(options, np.diff(options, prepend=-9) != 0)


@contextmanager
def weighted(weight: Callable[[float], float]) -> Iterator[None]:
    """The weight of the recogniser's evidence follows from the power so."""
    with mock.patch.object(proposals, "weight", weight), mock.patch.object(refitting, "weight", weight):
        yield


def first_fit(path: Path, demos: Demonstrations, count: int, changes: Mapping[str, Any]) -> Fit:
    """What the page begins with: a fit of the spec that ``init`` writes, with as many options as there are labels.

    :param path: keeps the demonstrations; the fit is kept beside them.
    :param changes: of the spec; ``training.seed`` is one.
    """
    folder = path.with_name(f"{'alone' if 'control.power' in changes else 'fit'}-{changes['training.seed']}")
    with only_one(path.parent, wait=True):
        if not path.exists():
            demos.write(path)
        if not is_finished(folder):
            facts = inspect(path)
            small = decide(parse_spec(read_yaml(starting_spec(facts, path).text)), demos, demos.frequency)
            spec = parse_spec(read_yaml(starting_spec(facts, path.resolve(), decided=small).text))
            alone = {"compare_with": [], "demonstrations.labels": None, "demonstrations.valid_fraction": 0.0}
            every = alone | {"demonstrations.leave_one_out": False, "hierarchy.levels.0.count": count}
            fit(with_overrides(spec, every | dict(changes)), demos, folder)
    return load(folder)


def from_scratch(truth: Sequence[np.ndarray]) -> list[dict[str, float]]:
    """Every name of a segment and every boundary counts one, and so does the naming of a label."""
    curve, edits, right, seen = [{"edits": 0.0, "right": 0.0}], 0, 0, set[int]()
    steps = sum(int((own >= 0).sum()) for own in truth)
    for own in truth:
        segments = runs_of(own)
        edits += len(segments) - 1 + sum(label >= 0 for label, _, _ in segments) + len({*named([own])} - seen)
        right, seen = right + int((own >= 0).sum()), seen | {*named([own])}
        curve.append({"edits": float(edits), "right": right / steps})
    return curve


def from_equal_parts(truth: Sequence[np.ndarray], slack: int) -> list[dict[str, float]]:
    """Demonstrations cut into equal parts, as many as labelled ones have segments, with the usual name of each part."""
    proposed, edits, seen = [np.full(len(own), PATIENCE) for own in truth], 0, set[int]()
    curve = [{"edits": 0.0, "right": 0.0}]
    known = np.concatenate(truth) >= 0
    for number, own in enumerate(truth, start=1):
        edits += len(plan(runs_of(proposed[number - 1]), runs_of(own), slack)) + 1 + len({*named([own])} - seen)
        seen |= {*named([own])}
        count = round(np.mean([len(runs_of(one)) for one in truth[:number]]))
        cut = [equal_lengths(len(one), count) for one in truth]
        done = np.concatenate(truth[:number])
        usual = np.array(
            [np.bincount(1 + done[np.concatenate(cut[:number]) == part]).argmax() - 1 for part in range(count)]
        )
        proposed = [*truth[:number], *(usual[parts] for parts in cut[number:])]
        curve.append(
            {"edits": float(edits), "right": float((np.concatenate(proposed) == np.concatenate(truth))[known].mean())}
        )
    return curve


def reached(curve: Sequence[Mapping[str, float]], target: float) -> float | None:
    """The edits after which so many steps are right, and stay so after every further demonstration; None for never."""
    below = [number for number, values in enumerate(curve) if values["right"] < target]
    after = below[-1] + 1 if below else 0
    return curve[after]["edits"] if after < len(curve) else None


def cells(own: argparse.Namespace) -> list[LabellingCell]:
    """All orders of a task before another task, and all tasks of a first fit before another fit."""
    tasks = [*own.tasks, *(SURGEONS if own.data else ())]
    return [
        LabellingCell(str(own.data), task, order, own.seeds if order == "random" else 1, seed)
        for seed, task, order in itertools.product(range(own.fits), tasks, own.orders)
        if seed == 0 or order not in ("equal parts", "from scratch")
    ]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), metavar="TASK")
    parser.add_argument("--data", type=Path, metavar="FOLDER")
    parser.add_argument("--orders", nargs="+", default=list(ORDERS), choices=ORDERS)
    parser.add_argument("--seeds", type=int, default=4, help="random orders of each first fit, whose mean is taken")
    parser.add_argument("--fits", type=int, default=3, help="first fits of each task, by their training seeds")
    study.main("labelling", parser, DEFAULTS, cells, lambda settings: sawyer(settings).made())


if __name__ == "__main__":
    main()
