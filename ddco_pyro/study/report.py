"""The verdicts of a study, its page, and the numbers that other pages quote."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.figures import Interval, Panel, interval_plot, save, style
from ddco_pyro.drawing.page import Block, Page, Picture, Section, Table, Text, note
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED, measure_names
from ddco_pyro.study.cells import Folder, State
from ddco_pyro.study.declaration import NATS, ContrastSpec, Study
from ddco_pyro.study.table import LEVEL, Estimate, earlier, estimate, holm, read_tidy, values

FILES = ("table.csv", "page.md", "page.html", "contrasts.png", "methods.png")
"""The files of a study's report."""

BLANK = "\n\n"
POINTS = "Grey points: single tasks, or seeds where there is one task."
HOLDS, FAILS, NOT_TESTED, EQUIVALENCE = "holds", "does not hold", "not tested", "equivalence"
CORRECTION = {
    "holm": "Holm's correction is over these contrasts.",
    "fixed_sequence": "Contrasts are tested in this order, each only where all before it hold. A p-value is the "
    "largest so far.",
}


class Tested(NamedTuple):
    """A primary contrast with its estimate (None without any cell), its verdict and its adjusted p-value."""

    spec: ContrastSpec
    demonstrations: int
    estimate: Estimate | None
    verdict: str
    adjusted: float


def tested(study: Study, table: pd.DataFrame) -> list[Tested]:
    """The primary contrasts of a study, in their order."""
    contrasts, counts = study.declared.contrasts, study.declared.demonstrations.counts
    asked = [(one, one.demonstrations or counts[0]) for one in contrasts]
    found = [_estimate(study, table, one.contrast, one.measure, [number]) for one, number in asked]
    p_values = [own.p_value(*one.bounds) if own else math.nan for own, one in zip(found, contrasts, strict=True)]
    places: dict[Any, int] = {(one.kind, one.pair, one.measure, count): n for n, (one, count) in enumerate(asked)}
    twins = {n: places.get(("superiority", *facts)) for (kind, *facts), n in places.items() if kind == EQUIVALENCE}
    judged = verdicts(p_values, study.declared.correction, twins)
    return [Tested(*one, own, *verdict) for one, own, verdict in zip(asked, found, judged, strict=True)]


def _estimate(
    study: Study | None, table: pd.DataFrame, what: str, measure: str, demonstrations: Sequence[str | int],
    task: str | None = None, times: float = 1.0,
) -> Estimate | None:  # fmt: skip
    """The mean of a method or of a contrast, some times as large; rates of a study have the trials of their starts."""
    own, starts = times * values(table, what, measure, demonstrations, task), study and study.declared.starts
    trials = starts.test.count if starts and measure.startswith("success") and times == 1 else 0
    families, lowest = study.family_of if study else {}, -1.0 if " - " in what else 0.0
    return estimate(own, trials, lowest, families) if len(own) else None


def verdicts(
    p_values: Sequence[float], correction: str = "holm", twins: Mapping[int, int | None] | None = None
) -> list[tuple[str, float]]:
    """The verdict on each claim of a family, and its adjusted p-value.

    ``does not hold``: the contrary does, whose p-value is one minus that of the claim. ``inconclusive``: neither does.
    ``not reached``: in a fixed sequence, a claim before it does not hold. ``not tested``: there is no p-value.

    :param twins: in a fixed sequence, the place of a claim that is read off the interval of another one, and the place
        of that one. It is reached where its twin is, and others do not wait for it.
    """
    given = np.array(p_values, float)
    known, beside = np.nan_to_num(given, nan=1.0), {n: twin for n, twin in (twins or {}).items() if twin is not None}
    before, claims, contraries = np.zeros(len(known)), np.array(holm(given)), np.array(holm(1 - given))
    if correction == "fixed_sequence":
        largest = np.maximum.accumulate([0.0, *(0.0 if place in beside else p for place, p in enumerate(known))])
        before = np.array([largest[beside.get(place, place)] for place in range(len(known))])
        claims, contraries = np.maximum(before, known), np.maximum(before, 1 - known)
    named = {"not reached": before > LEVEL, NOT_TESTED: np.isnan(given), HOLDS: claims <= LEVEL,
             FAILS: contraries <= LEVEL}  # fmt: skip
    return [*zip(np.select([*named.values()], [*named], "inconclusive").tolist(), claims.tolist(), strict=True)]


# --- the page ---------------------------------------------------------------------------------------------------------


def write(folder: Folder, state: State, to: Path) -> Path:
    """Write the table, the page and the figures of a study into a folder.

    :returns: the path of the page.
    :raises BadInput: no cell is done, or no cell has a declared measure.
    """
    study, table = folder.study, folder.table(state)
    if table.empty:
        raise BadInput(f"{folder.path}: no cell is done; do some with: ddco-pyro study run {study.path}")
    for measure in study.declared.measures:
        if measure not in {*table.measure}:
            there = {name for done in state.done.values() for name in done.values}
            text = f"{study.path}: measures: no cell has {measure!r}{nearest(measure, there)}; there is: "
            raise BadInput(text + ", ".join(sorted(there)))
    write_text(to / "table.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.9g"))
    contrasts = tested(study, table)
    counts = Counter(one.verdict for one in contrasts)
    said = f"Verdicts on primary contrasts: {', '.join(f'{verdict} {count}' for verdict, count in counts.items())}."
    sections = [
        Section("methods", "Every method", _methods(study, table, to)),
        Section("design", "Design", [note(line) for line in design(study, state)]),
    ]
    if any(one.estimate for one in contrasts):
        sections.insert(0, Section("contrasts", "Primary contrasts", _contrasts(study, contrasts, to, said)))
    top: list[Block] = [Text(said, "verdict")] * bool(contrasts)
    page = Page(f"Study {study.name}", top, sections, subtitle=study.declared.question)
    write_text(to / "page.md", f"# {page.title}\n\n{page.markdown()}")
    write_text(to / "page.html", page.html())
    return to / "page.html"


def _contrasts(study: Study, contrasts: Sequence[Tested], to: Path, said: str) -> list[Block]:
    adjusted = "p (Holm)" if study.declared.correction == "holm" else "p (in order)"
    head = ["contrast", "measure", "demos", "verdict", "has to lie", "mean [95 % t]", "median [95 %]", adjusted]
    rows, drawn = [], [one for one in contrasts if one.estimate]
    for one in contrasts:
        low, high = one.spec.bounds
        where, numbers = f"above {words.signed(low)}" if high == math.inf else f"within ±{high:g}", ["–"] * 3
        if one.estimate:
            p = "–" if one.verdict == NOT_TESTED else words.p_value(one.adjusted)
            numbers = [shown(one.estimate, "+.2f"), _between(*one.estimate.median, "+.2f"), p]
        facts = [one.spec.contrast, name_of(one.spec.measure), str(one.demonstrations), one.verdict]
        rows.append([*facts, where, *numbers])
    text = (
        "Differences are paired by task and training seed. The test of each contrast is one-sided, at 2.5 %; "
        f"equivalence has two, so the interval has to lie within ± the margin. {CORRECTION[study.declared.correction]} "
        "Intervals are not corrected. With several tasks the units are tasks or their families, so an interval "
        "speaks of further tasks. Rare failures and outliers make t intervals too short: they may cover 75 %. The "
        "median's interval is exact, and needs six units."
    )
    caption = f"Mean difference and 95 % t interval. {POINTS} Hollow: the bound that the difference has to exceed."
    panels = {
        measure: [_drawn(one.estimate, one.spec.bounds[0]) if one.spec.measure == measure else None for one in drawn]
        for measure in dict.fromkeys(one.spec.measure for one in drawn)
    }
    names = [f"{one.spec.contrast}, {one.demonstrations}" for one in drawn]
    picture = _plotted(names, panels, to / "contrasts.png", said, caption, "difference", 0)
    return [Table(head, rows, {0, 1, 3}), picture, note(text)]


def _methods(study: Study, table: pd.DataFrame, to: Path) -> list[Block]:
    """A table and a figure of all means."""
    labels, measures = study.declared.labels, study.declared.measures
    rows = [*product(study.declared.demonstrations.counts, labels)]
    known = {name: [_estimate(study, table, label, name, [count]) for count, label in rows] for name in measures}
    cells = [[shown(one) if one else "–" for one in own] for own in zip(*known.values(), strict=True)]
    named = [[str(count), label, *own] for (count, label), own in zip(rows, cells, strict=True)]
    caption = f"Means with 95 % t intervals, over tasks where there are several, else over training seeds. {POINTS}"
    names, alt = [f"{label}, {count}" for count, label in rows], f"{', '.join(measures)} of {', '.join(labels)}"
    panels = {name: [*map(_drawn, own)] for name, own in known.items()}
    picture = _plotted(names, panels, to / "methods.png", alt, caption)
    return [Table(["demonstrations", "method", *map(name_of, measures)], named, {1}), picture]


def _drawn(known: Estimate | None, bound: float | None = None) -> Interval | None:
    return None if known is None else Interval(known.value, *known.interval, points=known.units, hollow=bound)


def _plotted(
    names: Sequence[str], panels: dict[str, list[Interval | None]], path: Path, alt: str, caption: str,
    axis: str = "", line: float | None = None,
) -> Picture:  # fmt: skip
    with style():
        figure = interval_plot(names, [Panel(name_of(one), axis, rows, line=line) for one, rows in panels.items()])
    return replace(save(figure, path, alt, caption), file=path.name)


def design(study: Study, state: State) -> list[str]:
    """The data and seeds of a study, missing cells, and fits that have not converged, a line each."""
    declared, own, seeds = study.declared, study.declared.demonstrations, study.declared.seeds.test
    related = (f"{name} ({', '.join(tasks)})" for name, tasks in declared.families.items())
    tests = [cell for cell in state.cells if cell.part == "test"]
    done = {cell: state.done[cell] for cell in tests if cell in state.done}
    failed, counted = sum(cell in state.failed for cell in tests), declared.failed
    left_out = len(tests) - len(done) - (failed if counted else 0)
    as_failed = ", ".join(f"{measure} {value:g}" for measure, value in counted.items())
    codes = Counter(one.code for one in done.values() if one.code)
    rising = Counter(cell.method for cell, result in done.items() if not result.converged)
    fits = ", ".join(f"{count} of {method}" for method, count in rising.items())
    lines = {
        f"Tasks: {', '.join(study.tasks)}.": study.tasks[0],
        f"Families of tasks are one unit each: {', '.join(related)}.": declared.families,
        f"{', '.join(map(str, own.counts))} demonstrations to train on, {own.held_out} held out.": True,
        f"Every training seed draws its demonstrations from {own.path}, so seeds share some.": study.source,
        f"{seeds.count} training seeds from {seeds.first} on. Spec: {declared.spec}.": True,
        "Each training seed has starts of its own, which all methods share.": declared.starts,
        "Kept results have data of their own studies and may be older than the contrasts. They are those of "
        f"{', '.join(dict.fromkeys(one.table for one in declared.kept))}.": declared.kept and not declared.pinned,
        f"{failed} of {len(tests)} cells failed. They count {as_failed}; pairs of other measures are left out.":
            failed and counted,
        f"{left_out} of {len(tests)} cells are missing; contrasts leave their pairs out.": left_out,
        f"Code: {', '.join(f'{code} ({count} cells)' for code, count in codes.items())}.": codes,
        f"Fits that have not converged: {fits}. More epochs may change their results.": rising,
    }  # fmt: skip
    return [line for line, whether in lines.items() if whether] + _choice(study, state)


def _choice(study: Study, state: State) -> list[str]:
    """The points that development has chosen, and those that are no trials."""
    declared = study.declared
    if declared.choose is None:
        return []
    chosen = {cell.of: declared.label(cell.of, cell.point, "") for cell in state.cells if cell.part == "test"}
    number, names = len(declared.points(next(iter(declared.methods)))), ", ".join(chosen.values()) or "not yet known"
    lines = [
        f"The point of each method has the highest {declared.choose} on the development seeds, of {number}: {names}."
    ]
    results: dict[str, dict[str, str]] = defaultdict(lambda: defaultdict(str))
    for cell, one in state.done.items():
        if cell.part == "development":
            results[cell.of][cell.method] += str(one.values)
    for method, found in results.items():
        if (same := len(found) - len({*found.values()})) > 0:
            lines.append(f"{method}: {same} of {len(found)} points gave the results of another one: no trials.")
    return lines


def name_of(measure: str) -> str:
    """The name of a measure in tables and figures."""
    if measure in (*UNMATCHED, *MATCHED):
        return measure_names([measure])[0]
    return "held-out nats/step" if measure == NATS else words.measure(measure) if measure.islower() else measure


# --- numbers that other pages quote -----------------------------------------------------------------------------------


def shown(known: Estimate, form: str = ".2f") -> str:
    """A mean and its 95 % t interval, such as ``0.82 [0.75, 0.89]``."""
    return _between(known.value, known.interval, form)


def _between(value: float, ends: tuple[float, float], form: str) -> str:
    between = "" if math.isnan(ends[0]) else f" [{', '.join(format(end, form) for end in ends)}]"
    return f"{value:{form}}{between}".replace("-", "−")


def _with(known: Estimate, half: float, form: str) -> str:
    return f"{known.value:{form}}" + ("" if math.isnan(half) else f" ± {half:{form.replace('+', '')}}")


_SHOWN: dict[str, Callable[[Estimate, str], str]] = {
    "interval": shown,
    "mean": lambda known, form: f"{known.value:{form}}",
    "±": lambda known, form: _with(known, known.interval[1] - known.value, form),
    "sd": lambda known, form: _with(known, known.error * math.sqrt(len(known.units)), form),
    "se": lambda known, form: _with(known, known.error, form),
    "median": lambda known, form: _between(*known.median, form),
    "range": lambda known, form: f"{min(known.units):{form}} to {max(known.units):{form}}",
    "units": lambda known, form: str(len(known.units)),
    "above": lambda known, form: f"{sum(unit > 0 for unit in known.units)} of {len(known.units)}",
}
"""How a quotation shows an estimate."""

_QUOTED = re.compile(r"<!-- ((?:study|table) [\w./-]+): (.*?) -->.*?<!-- / -->", re.DOTALL)
_SETTING = re.compile(r"(study|task|without|seed|form|show|times|by)=(.*)", re.DOTALL)
_COUNTS = re.compile(r"\d+( - \d+)?")


def render(text: str, studies: Path, tables: Path = Path()) -> str:
    """A page's text with every quoted number as the tables have it; docs/studies.md says how a page quotes.

    :param studies: the folder of the declarations, whose tables ``kept`` have the numbers of ``study NAME``.
    :param tables: the folder from which ``NAME.csv`` of ``table NAME`` is sought.
    :raises BadInput: a quotation is wrong, or there is no such value.
    """
    page = _Quoting(studies, tables)
    _QUOTED.sub(page.quoted, text)  # finds the families
    for family in page.families.values():
        judged = verdicts([known.p_value(0.0) for known in family.values()])
        page.verdicts |= {number: verdict for number, (verdict, _) in zip(family, judged, strict=True)}
    return _QUOTED.sub(page.quoted, text)


@dataclass
class _Quoting:
    """The tables that a page quotes, the families of their differences, and the verdicts on numbers.

    The verdicts of ``study NAME`` are those on its primary contrasts, and it has no families.
    """

    studies: Path
    folder: Path
    tables: dict[str, tuple[Study | None, pd.DataFrame]] = field(default_factory=dict)
    estimates: dict[Any, Estimate | None] = field(default_factory=dict)
    families: dict[Any, dict[Any, Estimate]] = field(default_factory=lambda: defaultdict(dict))
    verdicts: dict[Any, str] = field(default_factory=dict)

    def _table(self, source: str) -> tuple[Study | None, pd.DataFrame]:
        """The study of ``study NAME``, and its rows by the names of the declaration; the rows of ``table NAME``."""
        if source not in self.tables:
            kind, name = source.split()
            study = Study.load(self.studies / f"{name}.yaml", allow_code=True) if kind == "study" else None
            table = earlier(study) if study else read_tidy(self.folder / f"{name}.csv")  # no code is imported
            self.tables[source] = study, table
            for one in tested(study, table) if study else ():
                key = " - ".join(one.spec.pair), one.spec.measure, (str(one.demonstrations),), None
                if one.spec.kind == EQUIVALENCE:
                    self.verdicts[source, EQUIVALENCE, key] = one.verdict
                    self.verdicts.setdefault((source, (), key), one.verdict)
                else:
                    self.verdicts[source, (), key] = one.verdict
        return self.tables[source]

    def quoted(self, match: re.Match[str]) -> str:
        """A quotation with its numbers.

        :raises BadInput: it is wrong, or there is no such number.
        """
        (source, asked), shows = match.groups(), (*_SHOWN, "verdict", EQUIVALENCE)
        fields = [part.strip() for part in asked.split(";")]
        settings = {found[1]: found[2] for part in fields if (found := _SETTING.fullmatch(part))}
        plain = [part.split(" | ") for part in fields if not _SETTING.fullmatch(part)]
        try:
            whats, measures, *rest = plain
            (counts,) = rest or [[""]]
            wrong = settings.get("show", "mean") not in shows or not all(
                _COUNTS.fullmatch(count) or not rest for count in counts
            )
            _ = float(settings.get("times", 1)), format(0.0, settings.get("form", ""))
        except ValueError:
            wrong = True
        if wrong:
            raise BadInput(
                f"{source}: {asked!r}: write a method or contrast, a measure and a number of demonstrations, such as: "
                f"options - flat; success; 50. After show= stands one of: {', '.join(shows)}; form= is Python's"
            )
        alone, by_task, rows = max(map(len, (*plain, counts))) == 1, settings.get("by") == "task", []
        tasks: list[Any] = sorted({*self._table(source)[1].task}) if by_task else [settings.get("task")]
        for task, count, measure in product(tasks, counts, measures):
            numbers = tuple(count.split(" - "))
            cells = [self._number(source, (what, measure, numbers, task), settings, alone) for what in whats]
            if any(cells):
                rows.append([str(task), " − ".join(numbers), name_of(measure), *(text or "–" for text in cells)])
        if not rows:
            raise BadInput(f"{source}: its tables have no {asked!r}; check its names")
        head = ["task", "demonstrations", "measure", *(what.replace(" - ", " − ") for what in whats)]
        first = not by_task
        whole = Table(head[first:], [row[first:] for row in rows], {0, 2} if by_task else {1}).markdown()
        return f"<!-- {source}: {asked} -->{rows[0][-1] if alone else BLANK + whole + BLANK}<!-- / -->"

    def _number(self, source: str, key: Any, settings: Mapping[str, str], alone: bool) -> str:
        """A number as it is shown; empty where there is none.

        :param key: method or contrast, measure, numbers of demonstrations, and task.
        """
        (study, table), (what, measure, count, task) = self._table(source), key
        taken = tuple((column, settings[column]) for column in ("study", "without", "seed") if column in settings)
        found, times = (source, taken, key, settings.get("times")), float(settings.get("times", 1))
        if found not in self.estimates:  # families are known once all numbers are
            for column, value in taken:
                several = re.fullmatch(r"(\d+)-(\d+)", value) if column == "seed" else None
                those = [*map(str, range(int(several[1]), int(several[2]) + 1))] if several else [value]
                table = table[table.task != value] if column == "without" else table[table[column].isin(those)]
            self.estimates[found] = _estimate(study, table, what, measure, count, task, times)
        if (known := self.estimates[found]) is None:
            return ""
        difference, verdict = " - " in what, self.verdicts.get((source, taken, key), NOT_TESTED)
        show = settings.get("show") or ("interval" if alone or difference else "mean")
        if show in ("interval", "±", "verdict") and difference and study is None:
            self.families[source, taken, measure.partition(",")[0]][source, taken, key] = known
        if show in ("verdict", EQUIVALENCE):
            return verdict if show == "verdict" else self.verdicts.get((source, EQUIVALENCE, key), NOT_TESTED)
        form = settings.get("form") or (".0%" if measure.startswith("success") else ".2f")
        form = f"+{form}" if difference and not (alone and "form" in settings) else form
        text = _SHOWN[show](known, form).replace("-", "−")
        return f"**{text}**" if show in ("interval", "±") and verdict in (HOLDS, FAILS) else text
