"""What a study found: tables and figures of a page, and the numbers that other pages quote."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.figures import GRID, Interval, Panel, blank, interval_plot, save, style
from ddco_pyro.drawing.page import Block, Page, Picture, Section, Table, Text, note
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.segmenting.agreement import measure_names
from ddco_pyro.study.cells import Folder, State
from ddco_pyro.study.declaration import NATS, ContrastSpec, Study
from ddco_pyro.study.statistics import LEVEL, Estimate, estimate, holm
from ddco_pyro.study.table import earlier, read_tidy, values

FILES = ("table.csv", "page.md", "page.html", "contrasts.png", "methods.png")
"""The files of a study's report."""

COLUMNS_OF_PANELS = 4
NOT_TESTED = "not tested"
DECIDED = ("holds", "does not hold")


@dataclass(frozen=True)
class Tested:
    """A primary contrast with its estimate (None without any cell), its verdict and Holm's adjusted p-value."""

    spec: ContrastSpec
    demonstrations: int
    estimate: Estimate | None
    verdict: str
    adjusted: float


def tested(study: Study, table: pd.DataFrame) -> list[Tested]:
    """The primary contrasts of a study, in their order."""
    contrasts, counts = study.declared.contrasts, study.declared.demonstrations.counts
    numbers = [contrast.demonstrations or counts[0] for contrast in contrasts]
    estimates = [
        _estimate(study, one.measure, values(table, one.contrast, one.measure, [number]), lowest=-1.0)
        for one, number in zip(contrasts, numbers, strict=True)
    ]
    judged = verdicts([(own, one.bound) for own, one in zip(estimates, contrasts, strict=True)])
    rows = zip(contrasts, numbers, estimates, judged, strict=True)
    return [Tested(contrast, number, found, *verdict) for contrast, number, found, verdict in rows]


def _estimate(study: Study, measure: str, of: pd.Series, lowest: float = 0.0) -> Estimate | None:
    return estimate(of, trials(study, measure), lowest) if len(of) else None


def verdicts(family: Sequence[tuple[Estimate | None, float]]) -> list[tuple[str, float]]:
    """Whether each estimate exceeds its bound, and Holm's p-value; both sides are corrected for the whole family.

    ``does not hold``: the contrary holds, that the estimate is below the bound. ``inconclusive``: neither does.
    """
    p_values = [math.nan if known is None else known.p_value(bound) for known, bound in family]
    judged = []
    for p, above, below in zip(p_values, holm(p_values), holm([1 - p for p in p_values]), strict=True):
        verdict = "holds" if above <= LEVEL else "does not hold" if below <= LEVEL else "inconclusive"
        judged.append((NOT_TESTED if math.isnan(p) else verdict, above))
    return judged


def trials(study: Study, measure: str) -> int:
    """The starts of each fit, where the measure is a rate of them; else 0."""
    starts = study.declared.starts
    return starts.test.count if starts and measure.startswith("success") else 0


def write(folder: Folder, state: State, to: Path) -> Path:
    """Write the table, the page and the figures of a study into a folder.

    :returns: the path of the page.
    :raises BadInput: no cell is done, or no cell has a declared measure.
    """
    table = folder.table(state)
    if table.empty:
        raise BadInput(f"{folder.path}: no cell is done; do some with: ddco-pyro study run {folder.study.path}")
    for measure in folder.study.declared.measures:
        if measure not in {*table.measure}:
            there = {name for done in state.done.values() for name in done.values}
            text = f"{folder.study.path}: measures: no cell has {measure!r}{nearest(measure, there)}; there is: "
            raise BadInput(text + ", ".join(sorted(there)))
    write_text(to / "table.csv", table.to_csv(index=False, lineterminator="\n"))
    whole = page(folder.study, table, state, to)
    write_text(to / "page.md", f"# {whole.title}\n\n{whole.markdown()}")
    write_text(to / "page.html", whole.html())
    return to / "page.html"


def page(study: Study, table: pd.DataFrame, state: State, to: Path) -> Page:
    """The page of a study; its figures are written into a folder."""
    contrasts = tested(study, table)
    top: list[Block] = [Text(verdict(contrasts), "verdict")] if contrasts else []
    sections = [Section("methods", "Every method", _methods(study, table, to))]
    if any(one.estimate for one in contrasts):
        sections.insert(0, Section("contrasts", "Primary contrasts", _contrasts(contrasts, to)))
    sections.append(Section("design", "Design", [note(line) for line in design(study, state)]))
    return Page(f"Study {study.name}", top, sections, subtitle=study.declared.question)


def verdict(contrasts: Sequence[Tested]) -> str:
    """How many of the primary contrasts hold."""
    forms = {
        "holds": ("holds", "hold"),
        "does not hold": ("does not hold", "do not hold"),
        "inconclusive": ("is inconclusive", "are inconclusive"),
        NOT_TESTED: ("is not tested", "are not tested"),
    }
    counts = Counter(one.verdict for one in contrasts)
    parts = words.listed(f"{count} {forms[name][count > 1]}" for name, count in counts.items())
    return f"Of {len(contrasts)} primary contrasts, {parts}."


def _contrasts(contrasts: Sequence[Tested], to: Path) -> list[Block]:
    head = ["contrast", "measure", "demos", "verdict", "has to exceed", "mean [95 % t]", "median [95 %]", "p (Holm)"]
    rows = []
    for one in contrasts:
        numbers = ["–"] * 3
        if one.estimate:
            p = "–" if one.verdict == NOT_TESTED else words.p_value(one.adjusted)
            numbers = [shown(one.estimate, "+.2f"), _between(*one.estimate.median, "+.2f"), p]
        facts = [one.spec.contrast, name_of(one.spec.measure), str(one.demonstrations), one.verdict]
        rows.append([*facts, words.signed(one.spec.bound), *numbers])
    text = (
        "Differences are paired by task and training seed. The test of each contrast is one-sided, at 2.5 %. For "
        "superiority the difference has to exceed the margin, for non-inferiority minus the margin. Holm's correction "
        "is over these contrasts; intervals are not corrected. With several tasks the units are tasks, so an interval "
        "speaks of further tasks. Rare failures and outliers make t intervals too short: they may cover 75 %. The "
        "median's interval is exact, and needs six units."
    )
    caption = (
        "Mean difference and 95 % t interval. Grey points: single tasks, or seeds where there is one task. Hollow: the "
        "bound that the difference has to exceed."
    )
    drawn = [one for one in contrasts if one.estimate]
    panels = []
    for measure in dict.fromkeys(one.spec.measure for one in drawn):
        lines = [_drawn(one.estimate, one.spec.bound) if one.spec.measure == measure else None for one in drawn]
        panels.append(Panel(name_of(measure), "difference", lines, line=0))
    with style():
        figure = interval_plot([f"{one.spec.contrast}, {one.demonstrations}" for one in drawn], panels)
        picture = _saved(figure, to / "contrasts.png", verdict(contrasts), caption)
    return [Table(head, rows, {0, 1, 3}), picture, note(text)]


def _drawn(known: Estimate | None, bound: float | None = None) -> Interval | None:
    return None if known is None else Interval(known.value, *known.interval, points=known.units, hollow=bound)


def _methods(study: Study, table: pd.DataFrame, to: Path) -> list[Block]:
    """A table for each measure, and one figure."""
    counts, labels = study.declared.demonstrations.counts, study.declared.labels
    blocks: list[Block] = []
    for measure in study.declared.measures:
        rows = []
        for label in labels:
            cells = [_estimate(study, measure, values(table, label, measure, [count])) for count in counts]
            if any(cells):
                rows.append([label, *(shown(cell) if cell else "–" for cell in cells)])
        blocks.append(Table([name_of(measure), *(f"{count} demonstrations" for count in counts)], rows))
    single = "Single tasks: means and ranges over training seeds." if len(study.tasks) > 1 and len(counts) > 1 else ""
    caption = "Means with 95 % t intervals, over tasks where there are several, else over training seeds."
    alt = f"{', '.join(study.declared.measures)} of {', '.join(labels)}"
    picture = _saved(draw(study, table), to / "methods.png", alt, f"{caption} {single}".rstrip())
    return [*blocks, picture]


def _saved(figure: Figure, path: Path, alt: str, caption: str) -> Picture:
    return replace(save(figure, path, alt, caption), file=path.name)


def draw(study: Study, table: pd.DataFrame) -> Figure:
    """Curves over demonstrations: a panel for each measure, and for each task by the first measure.

    With a single number of demonstrations, intervals of every method, a panel for each measure.
    """
    counts, labels, measures = study.declared.demonstrations.counts, study.declared.labels, study.declared.measures
    several = len(study.tasks) > 1

    def known(label: str, measure: str, count: int, task: str | None = None) -> Estimate | None:
        return _estimate(study, measure, values(table, label, measure, [count], task))

    if len(counts) == 1:
        panels = [Panel("", name_of(m), [_drawn(known(label, m, counts[0])) for label in labels]) for m in measures]
        with style():
            return interval_plot(labels, panels)
    wanted: list[tuple[str, str | None]] = [(measure, None) for measure in measures]
    wanted += [(measures[0], task) for task in study.tasks] if several else []
    lines = math.ceil(len(wanted) / COLUMNS_OF_PANELS)
    with style():
        figure = blank(2.2 * lines + 0.4)
        all_axes = figure.subplots(lines, min(COLUMNS_OF_PANELS, len(wanted)), squeeze=False).flatten()
        for axes, (measure, task) in zip(all_axes, wanted, strict=False):
            for number, label in enumerate(labels):
                points = {count: own for count in counts if (own := known(label, measure, count, task))}
                middle = [own.value for own in points.values()]
                ends = [own.interval if task is None else own.range for own in points.values()]
                errors = np.nan_to_num(np.abs(np.reshape(ends, (-1, 2)).T - middle))
                axes.errorbar(
                    [count * 1.02**number for count in points], middle, errors, marker="o", markersize=3.5,
                    capsize=2, linewidth=1.2, color=option_colour(number + 1), label=label,
                )  # fmt: skip
            axes.set(xscale="log", title=task or name_of(measure) + (", mean of tasks" if several else ""))
            axes.set_xticks(counts, map(str, counts))
            axes.set_xticks([], minor=True)
            axes.grid(axis="y", color=GRID)
        for axes in all_axes[len(wanted) :]:
            axes.set_visible(False)
        figure.supxlabel("demonstrations", fontsize=9)
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=min(len(labels), 6))
    return figure


def design(study: Study, state: State) -> list[str]:
    """The data and seeds of a study, missing cells, and fits that have not converged, a line each."""
    declared, data, seeds = study.declared, study.declared.demonstrations, study.declared.seeds.test
    several = f"Tasks: {', '.join(study.tasks)}. " if study.tasks[0] else ""
    drawn = "Each training seed has its own demonstrations."
    if study.source is not None:
        drawn = f"Every training seed draws its demonstrations from {data.path}, so seeds share some."
    lines = [
        f"{several}{', '.join(map(str, data.counts))} demonstrations to train on, {data.held_out} held out. {drawn}",
        f"{seeds.count} training seeds from {seeds.first} on. Spec: {declared.spec}.",
    ]
    if declared.starts is not None:
        lines.append(f"Every method acts from the same {declared.starts.test.count} starts, others for every seed.")
    if declared.kept:
        tables = dict.fromkeys(one.table for one in declared.kept)
        text = "have data of their own studies, whose seeds may share them. They may be older than the contrasts"
        lines.append(f"This is so in new cells. Results that are kept in {', '.join(tables)} {text}.")
    done = [(state.cells[number], result) for number, result in state.done.items()]
    if declared.choose is not None:
        chosen = {cell.of: declared.label(cell.of, dict(cell.point), "") for cell in state.cells if cell.part == "test"}
        text = f"The point of each method has the highest {declared.choose} on the development seeds, of"
        points = len(declared.points(next(iter(declared.methods))))
        lines.append(f"{text} {points}: {', '.join(chosen.values()) or 'not yet known'}.")
        results: dict[str, dict[str, list[Any]]] = {}
        for cell, result in done:
            if cell.part == "development":
                named = cell.task, cell.demonstrations, cell.seed, result.values
                results.setdefault(cell.of, {}).setdefault(cell.method, []).append(named)
        for method, by_point in results.items():
            if (same := len(by_point) - len({*map(repr, by_point.values())})) > 0:
                lines.append(f"{method}: {same} of {len(by_point)} points gave the results of another one: no trials.")
    tests, done = sum(cell.part == "test" for cell in state.cells), [one for one in done if one[0].part == "test"]
    if len(done) < tests:
        lines.append(f"{tests - len(done)} of {tests} cells are missing; contrasts leave their pairs out.")
    if rising := Counter(cell.method for cell, result in done if not result.converged):
        fits = words.listed(f"{count} of {method}" for method, count in rising.items())
        lines.append(f"Fits that have not converged: {fits}. More epochs may change their results.")
    return lines


def name_of(measure: str) -> str:
    """The name of a measure in tables and figures."""
    if measure == NATS:
        return "held-out nats/step"
    if measure in (*UNMATCHED, *MATCHED):
        return measure_names([measure])[0]
    return words.measure(measure) if measure.islower() else measure


def shown(known: Estimate, form: str = ".2f") -> str:
    """A mean and its 95 % t interval, such as ``0.82 [0.75, 0.89]``."""
    return _between(known.value, known.interval, form)


def _between(value: float, ends: tuple[float, float], form: str) -> str:
    between = "" if math.isnan(ends[0]) else f" [{', '.join(format(end, form) for end in ends)}]"
    return f"{value:{form}}{between}".replace("-", "−")


# --- numbers that other pages quote -----------------------------------------------------------------------------------

_QUOTED = re.compile(
    r"<!-- (?P<kind>study|table) (?P<name>[\w-]+): (?P<what>.*?) -->(?P<text>.*?)<!-- / -->", re.DOTALL
)
_SETTING = re.compile(r"(study|task|without|seed|form|show|times|by)=(.*)", re.DOTALL)

_SHOWN: dict[str, Callable[[Estimate, str], str]] = {
    "interval": shown,
    "mean": lambda known, form: f"{known.value:{form}}",
    "±": lambda known, form: _with(known, known.interval[1] - known.value, form),
    "sd": lambda known, form: _with(known, known.error * math.sqrt(len(known.units)), form),
    "se": lambda known, form: _with(known, known.error, form),
    "median": lambda known, form: _between(*known.median, form),
    "range": lambda known, form: " to ".join(format(end, form) for end in known.range),
    "units": lambda known, form: str(len(known.units)),
    "above": lambda known, form: f"{sum(unit > 0 for unit in known.units)} of {len(known.units)}",
}
"""How a quotation shows an estimate."""


def _with(known: Estimate, half: float, form: str) -> str:
    return f"{known.value:{form}}" + ("" if math.isnan(half) else f" ± {half:{form.replace('+', '')}}")


def render(text: str, studies: Path, tables: Path = Path()) -> str:
    """A page's text with every quoted number as the tables have it.

    A quotation is ``<!-- study NAME: options - flat; success; 50 -->…<!-- / -->``: a method or a contrast, a measure,
    and a number of demonstrations, none where the table has none. A difference is bold where it is not inconclusive
    after Holm's correction: for the primary contrasts of ``study NAME``, which has no other bold ones, or for all
    differences of one measure (up to a comma) that the page quotes from one study of ``table NAME``. ``40 - 80`` gives
    both methods of a contrast a number of their own. Several methods, measures or numbers, between ``|``, make a table,
    of means and of differences with intervals. These settings may follow:

    - ``study=NAME``, ``task=NAME`` and ``seed=NAME`` take rows of one study of the table, one task or one seed, and
      ``seed=10-29`` of these; ``without=NAME`` leaves a task out;
    - ``show`` is ``mean``, ``±`` (half of the interval), ``sd``, ``se``, ``median`` (and its interval), ``range``
      (least and greatest unit), ``units`` (how many), ``above`` (how many are above 0) or ``verdict``; else mean and
      interval;
    - ``times=900`` multiplies, ``form=+.0%`` formats as Python does, and ``by=task`` gives a table rows for each task.

    :param studies: the folder of the declarations, whose tables ``kept`` have the numbers of ``study NAME``.
    :param tables: the folder of ``NAME.csv``, which has the numbers of ``table NAME``.
    :raises BadInput: a quotation is wrong, or there is no such value.
    """
    sources: dict[str, _Source] = {}

    def quoted(match: re.Match[str]) -> str:
        kind, name, what, _ = match.groups()
        named = f"{kind} {name}"
        if named not in sources:  # nothing of a study is imported for its numbers
            study = Study.load(studies / f"{name}.yaml", allow_code=True) if kind == "study" else None
            sources[named] = _Source(named, earlier(study) if study else read_tidy(tables / f"{name}.csv"), study)
        return f"<!-- {named}: {what} -->{sources[named].quoted(what)}<!-- / -->"

    _QUOTED.sub(quoted, text)  # finds the families
    for source in sources.values():
        source.judge()
    return _QUOTED.sub(quoted, text)


class _Source:
    """The table that quotations name, the families of their differences, and the verdicts on them."""

    def __init__(self, name: str, table: pd.DataFrame, study: Study | None) -> None:
        self.name, self.table, self.study = name, table, study
        self.estimates: dict[Any, Estimate | None] = {}
        self.families: dict[Any, dict[Any, Estimate]] = {}
        self.verdicts: dict[Any, str] = {}

    def judge(self) -> None:
        """Give the quoted differences their verdicts."""
        for family in self.families.values():
            judged = verdicts([(one, 0.0) for one in family.values()])
            self.verdicts |= {key: verdict for key, (verdict, _) in zip(family, judged, strict=True)}
        for one in tested(self.study, self.table) if self.study else ():
            key = " - ".join(one.spec.pair), one.spec.measure, (str(one.demonstrations),), None
            self.verdicts.setdefault(key, one.verdict)

    def quoted(self, quotation: str) -> str:
        """A number, or a table of several."""
        fields = [part.strip() for part in quotation.split(";")]
        settings = {found[1]: found[2] for part in fields if (found := _SETTING.fullmatch(part))}
        plain = [part.split(" | ") for part in fields if not _SETTING.fullmatch(part)]
        methods, measures, numbers = (*plain, [""])[:3] if len(plain) in (2, 3) else ([], [], [])
        counts = [tuple(one.split(" - ")) for one in numbers]
        forms = (*_SHOWN, "verdict")
        try:
            times, _ = float(settings.get("times", 1)), format(0.0, settings.get("form", ""))
        except ValueError:
            methods = []
        decimal = all(number.isdecimal() for count in counts for number in count) or len(plain) == 2
        if not methods or not decimal or settings.get("show", "mean") not in forms:
            raise BadInput(
                f"{self.name}: {quotation!r}: write a method or contrast, a measure and a number of demonstrations, "
                f"such as: options - flat; success; 50. After show= stands one of: {', '.join(forms)}; form= is "
                "Python's"
            )
        table = self._chosen(settings)
        single, by_task = len(methods) * len(measures) * len(counts) == 1, settings.get("by") == "task"
        rows = []
        tasks = sorted({*table.task}) if by_task else [settings.get("task")]
        for task, count, measure in itertools.product(tasks, counts, measures):
            cells = [self._cell(table, (what, measure, count, task), settings, times, single) for what in methods]
            if any(cells):
                facts = [str(task), " − ".join(count), name_of(measure)]
                rows.append([*facts[not by_task :], *(text or "–" for text in cells)])
        if not rows:
            raise BadInput(f"{self.name}: its tables have no {quotation!r}; check its names")
        if single:
            return rows[0][-1]
        head = ["task", "demonstrations", "measure", *(what.replace(" - ", " − ") for what in methods)]
        return f"\n\n{Table(head[not by_task :], rows, {0, 2} if by_task else {1}).markdown()}\n\n"

    def _chosen(self, settings: Mapping[str, str]) -> pd.DataFrame:
        """The rows of the study and the seeds that are asked for, without the task that is left out."""
        table = self.table[self.table.task != settings.get("without")]
        if "study" in settings:
            table = table[table.study == settings["study"]]
        if several := re.fullmatch(r"(\d+)-(\d+)", settings.get("seed", "")):
            return table[table.seed.isin([str(seed) for seed in range(int(several[1]), int(several[2]) + 1)])]
        return table[table.seed == settings["seed"]] if settings.get("seed") else table

    def _cell(
        self, table: pd.DataFrame, named: tuple[str, str, tuple[str, ...], str | None],
        settings: Mapping[str, str], times: float, single: bool,
    ) -> str:  # fmt: skip
        """One number; empty where the table has none."""
        what, measure, _, _ = named
        difference, form = " - " in what, settings.get("form", "")
        key = (*named, *((name, settings[name]) for name in ("study", "without", "seed") if name in settings))
        if (*key, times) not in self.estimates:
            self.estimates[*key, times] = self._estimate(table, named, times)
        known = self.estimates[*key, times]
        show = settings.get("show") or ("interval" if single or difference else "mean")
        if known is None:
            return ""
        if difference and show in ("interval", "±", "verdict") and self.study is None:
            self.families.setdefault((measure.partition(",")[0], *key[4:]), {})[key] = known
        verdict = self.verdicts.get(key, NOT_TESTED)
        if show == "verdict":
            return verdict
        if not form:
            form = ("+" if difference else "") + (".0%" if measure.startswith("success") else ".2f")
        elif difference and not single:
            form = f"+{form}"
        text = _SHOWN[show](known, form).replace("-", "−")
        return f"**{text}**" if show in ("interval", "±") and verdict in DECIDED else text

    def _estimate(
        self, table: pd.DataFrame, named: tuple[str, str, tuple[str, ...], str | None], times: float
    ) -> Estimate | None:
        what, measure, count, task = named
        own = times * values(table, what, measure, count, task)
        seeds = own.index.get_level_values("seed")
        own = own[(seeds != "") | (seeds == "").all()]  # a row without seed is the summary of the others
        starts = trials(self.study, measure) if self.study and times == 1 else 0
        return None if own.empty else estimate(own, starts, -1.0 if " - " in what else 0.0)
