"""What a study found: tables and figures of a page, and the numbers that other pages quote."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.figures import GRID, WIDTH, Interval, Panel, interval_plot, save, style
from ddco_pyro.drawing.page import Block, Page, Picture, Section, Table, Text, note
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.metrics import write_table
from ddco_pyro.segmenting.agreement import measure_names
from ddco_pyro.study.cells import COLUMNS, Folder, Row, State, earlier, read_tidy, tidy
from ddco_pyro.study.declaration import NATS, ContrastSpec, Study
from ddco_pyro.study.statistics import LEVEL, BySeed, Estimate, estimate, holm, p_value, paired

FILES = ("table.csv", "page.md", "page.html", "contrasts.png", "methods.png")
"""The files of a study's report."""

COLUMNS_OF_PANELS = 4
NOT_TESTED = "not tested"
DECIDED = ("holds", "does not hold")


def values(
    rows: Iterable[Row], what: str, measure: str, demonstrations: Sequence[int | None], task: str | None = None
) -> BySeed:
    """The values of a method, or the paired differences of ``ours - theirs``, by task and training seed.

    :param demonstrations: of a method; a second number is that of ``theirs``.
    """
    found: dict[tuple[str, int | None], dict[str, dict[int | str, float]]] = {}
    for row in rows:
        if row.measure == measure and task in (None, row.task):
            found.setdefault((row.method, row.demonstrations), {}).setdefault(row.task, {})[row.seed] = row.value
    if (what, demonstrations[0]) in found or " - " not in what:
        return found.get((what, demonstrations[0]), {})
    ours, _, theirs = what.partition(" - ")
    return paired(found.get((ours.strip(), demonstrations[0]), {}), found.get((theirs.strip(), demonstrations[-1]), {}))


@dataclass(frozen=True)
class Tested:
    """A primary contrast with its estimate (None without any cell), its verdict and Holm's adjusted p-value."""

    spec: ContrastSpec
    demonstrations: int
    differences: BySeed
    found: Estimate | None
    verdict: str = NOT_TESTED
    adjusted: float = math.nan

    @property
    def name(self) -> str:
        """The contrast with its number of demonstrations."""
        return f"{self.spec.contrast}, {self.demonstrations}"


def tested(study: Study, rows: Sequence[Row]) -> list[Tested]:
    """The primary contrasts of a study, in their order."""
    found = []
    for contrast in study.declared.contrasts:
        count = contrast.demonstrations or study.declared.demonstrations.counts[0]
        differences = values(rows, contrast.contrast, contrast.measure, [count])
        known = estimate(differences, trials(study, contrast.measure)) if differences else None
        found.append(Tested(contrast, count, differences, known))
    judged = verdicts([(one.found, one.spec.bound) for one in found])
    return [replace(one, verdict=name, adjusted=p) for one, (name, p) in zip(found, judged, strict=True)]


def verdicts(family: Sequence[tuple[Estimate | None, float]]) -> list[tuple[str, float]]:
    """Whether each estimate exceeds its bound, and Holm's p-value; both sides are corrected for the whole family.

    ``does not hold``: the contrary holds, that the estimate is below the bound. ``inconclusive``: neither does.
    """
    p = [math.nan if found is None else p_value(found, bound) for found, bound in family]
    found = []
    for one, above, below in zip(p, holm(p), holm([1 - one for one in p]), strict=True):
        known = "holds" if above <= LEVEL else "does not hold" if below <= LEVEL else "inconclusive"
        found.append((NOT_TESTED if math.isnan(one) else known, above))
    return found


def trials(study: Study, measure: str) -> int:
    """The starts of each fit, where the measure is a rate of them; else 0."""
    starts = study.declared.starts
    return starts.test.count if starts and measure.startswith("success") else 0


def write(folder: Folder, state: State, to: Path) -> Path:
    """Write the table, the page and the figures of a study into a folder.

    :returns: the path of the page.
    :raises BadInput: no cell is done, or no cell has a declared measure.
    """
    rows = list(tidy(folder, state))
    if not rows:
        raise BadInput(f"{folder.path}: no cell is done; do some with: ddco-pyro study run {folder.study.path}")
    for measure in folder.study.declared.measures:
        if not any(row.measure == measure for row in rows):
            there = {name for done in state.done.values() for name in done.values}
            text = f"{folder.study.path}: measures: no cell has {measure!r}{nearest(measure, there)}; there is: "
            raise BadInput(text + ", ".join(sorted(there)))
    write_table(to / "table.csv", COLUMNS, map(asdict, rows))
    whole = page(folder.study, rows, state, to)
    write_text(to / "page.md", f"# {whole.title}\n\n{whole.markdown()}")
    write_text(to / "page.html", whole.html())
    return to / "page.html"


def page(study: Study, rows: Sequence[Row], state: State, to: Path) -> Page:
    """The page of a study; its figures are written into a folder."""
    found = tested(study, rows)
    top: list[Block] = [Text(verdict(found), "verdict")] if found else []
    sections = [Section("methods", "Every method", _methods(study, rows, to))]
    if any(one.found for one in found):
        sections.insert(0, Section("contrasts", "Primary contrasts", _contrasts(found, to)))
    sections.append(Section("design", "Design", [note(line) for line in design(study, rows, state)]))
    return Page(f"Study {study.name}", top, sections, subtitle=study.declared.question)


def verdict(found: Sequence[Tested]) -> str:
    """How many of the primary contrasts hold."""
    counts = Counter(one.verdict for one in found)
    return (
        f"Of {len(found)} primary contrasts, {words.listed(f'{n} {_plural(name, n)}' for name, n in counts.items())}."
    )


def _plural(name: str, count: int) -> str:
    one = {"holds": "hold", "does not hold": "do not hold", "inconclusive": "are inconclusive"}
    many = {"inconclusive": "is inconclusive", "not tested": "is not tested"}
    return one.get(name, "are not tested") if count > 1 else many.get(name, name)


def _contrasts(found: Sequence[Tested], to: Path) -> list[Block]:
    head = ["contrast", "measure", "demos", "verdict", "has to exceed", "mean [95 % t]", "median [95 %]", "p (Holm)"]
    table = []
    for one in found:
        named = [one.spec.contrast, name_of(one.spec.measure), str(one.demonstrations), one.verdict]
        numbers = ["–"] * 3
        if one.found:
            p = "–" if one.verdict == NOT_TESTED else words.p_value(one.adjusted)
            numbers = [shown(one.found, "+.2f"), _between(*one.found.median, "+.2f"), p]
        table.append([*named, words.signed(one.spec.bound), *numbers])
    text = (
        "Differences are paired by task and training seed. The test of each contrast is one-sided, at 2.5 %. For "
        "superiority the difference has to exceed the margin, for non-inferiority minus the margin. Holm's correction "
        "is over these contrasts; intervals are not corrected. With several tasks the units are tasks, so an interval "
        "speaks of further tasks. Rare failures and outliers make t intervals too short: they may cover 75 %. The "
        "median's interval is exact, and needs six units."
    )
    known = [one for one in found if one.found]
    measures = dict.fromkeys(one.spec.measure for one in known)
    panels = [
        Panel(
            name_of(measure),
            "difference",
            [
                _drawn(one.found, one.differences, one.spec.bound) if one.spec.measure == measure else None
                for one in known
            ],
            line=0,
        )
        for measure in measures
    ]
    caption = (
        "Mean difference and 95 % t interval. Grey points: single tasks, or seeds where there is one task. Hollow: the "
        "bound that the difference has to exceed."
    )
    with style():
        figure = interval_plot([one.name for one in known], panels)
        picture = _saved(figure, to / "contrasts.png", verdict(found), caption)
    return [Table(head, table, {0, 1, 3}), picture, note(text)]


def _drawn(found: Estimate | None, by_seed: BySeed, bound: float | None = None) -> Interval | None:
    if found is None:
        return None
    own = list(by_seed.values())
    points = [float(np.mean([*one.values()])) for one in own] if len(own) > 1 else [*own[0].values()]
    return Interval(found.value, *found.interval, points=points, hollow=bound)


def _methods(study: Study, rows: Sequence[Row], to: Path) -> list[Block]:
    """A table for each measure, and one figure."""
    counts, labels = study.declared.demonstrations.counts, study.declared.labels
    blocks: list[Block] = []
    for measure in study.declared.measures:
        table = []
        for label in labels:
            cells = [_estimated(study, measure, values(rows, label, measure, [count])) for count in counts]
            if any(cells):
                table.append([label, *(shown(cell) if cell else "–" for cell in cells)])
        head = [name_of(measure), *(f"{count} demonstrations" for count in counts)]
        blocks.append(Table(head, table))
    single = "Single tasks: means and ranges over training seeds." if len(study.tasks) > 1 and len(counts) > 1 else ""
    caption = "Means with 95 % t intervals, over tasks where there are several, else over training seeds."
    alt = f"{', '.join(study.declared.measures)} of {', '.join(labels)}"
    picture = _saved(draw(study, rows), to / "methods.png", alt, f"{caption} {single}".rstrip())
    return [*blocks, picture]


def _saved(figure: Figure, path: Path, alt: str, caption: str) -> Picture:
    return replace(save(figure, path, alt, caption), file=path.name)


def draw(study: Study, rows: Sequence[Row]) -> Figure:
    """Curves over demonstrations: a panel for each measure, and for each task by the first measure.

    With a single number of demonstrations, intervals of every method, a panel for each measure.
    """
    counts, labels, measures = study.declared.demonstrations.counts, study.declared.labels, study.declared.measures
    if len(counts) == 1:
        panels = []
        for m in measures:
            found = [values(rows, label, m, counts[:1]) for label in labels]
            panels.append(Panel("", name_of(m), [_drawn(_estimated(study, m, one), one) for one in found]))
        with style():
            return interval_plot(labels, panels)
    several = len(study.tasks) > 1
    wanted: list[tuple[str, str | None]] = [(measure, None) for measure in measures]
    wanted += [(measures[0], task) for task in study.tasks] if several else []
    columns = min(COLUMNS_OF_PANELS, len(wanted))
    lines = math.ceil(len(wanted) / columns)
    with style():
        figure = Figure(figsize=(WIDTH, 2.2 * lines + 0.4), layout="constrained")
        all_axes = figure.subplots(lines, columns, squeeze=False).flat
        for axes, (measure, task) in zip(all_axes, wanted, strict=False):
            for number, label in enumerate(labels, start=1):
                points = [(n, _estimated(study, measure, values(rows, label, measure, [n], task))) for n in counts]
                known = [(n, one) for n, one in points if one]
                middle = [one.value for _, one in known]
                both = [one.interval if task is None else one.range for _, one in known]
                ends = np.abs(np.array(both).reshape(-1, 2).T - middle)
                axes.errorbar(
                    [n * 1.02 ** (number - 1) for n, _ in known], middle, np.nan_to_num(ends), marker="o",
                    markersize=3.5, capsize=2, linewidth=1.2, color=option_colour(number), label=label,
                )  # fmt: skip
            axes.set(xscale="log", title=task or name_of(measure) + (", mean of tasks" if several else ""))
            axes.set_xticks(counts, map(str, counts))
            axes.set_xticks([], minor=True)
            axes.grid(axis="y", color=GRID)
        for axes in list(all_axes)[len(wanted) :]:
            axes.set_visible(False)
        figure.supxlabel("demonstrations", fontsize=9)
        handles, names = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=min(len(labels), 6))
    return figure


def _estimated(study: Study, measure: str, by_seed: BySeed) -> Estimate | None:
    return estimate(by_seed, trials(study, measure), lowest=0.0) if by_seed else None


def design(study: Study, rows: Sequence[Row], state: State) -> list[str]:
    """The data and seeds of a study, missing cells, and fits that have not converged, a line each."""
    declared, data = study.declared, study.declared.demonstrations
    several = f"Tasks: {', '.join(study.tasks)}. " if study.tasks[0] else ""
    if study.source is None:
        drawn = "Each training seed has its own demonstrations."
    else:
        drawn = (
            f"Every training seed draws its demonstrations from {declared.demonstrations.path}, so seeds share some."
        )
    seeds = declared.seeds.test
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
    if declared.choose is not None:
        first = {cell.of: cell.point for cell in state.cells if cell.part == "test"}
        points = ", ".join(declared.label(method, dict(point), "") for method, point in first.items())
        text = f"The point of each method has the highest {declared.choose} on the development seeds, of"
        lines.append(f"{text} {len(declared.points(next(iter(declared.methods))))}: {points or 'not yet known'}.")
        tried: dict[str, dict[str, list[Any]]] = {}
        for number, result in state.done.items():
            if (cell := state.cells[number]).part == "development":
                named = cell.task, cell.demonstrations, cell.seed
                tried.setdefault(cell.of, {}).setdefault(cell.method, []).append((*named, result.values))
        for method, results in tried.items():
            if (same := len(results) - len({repr(one) for one in results.values()})) > 0:
                lines.append(f"{method}: {same} of {len(results)} points gave the results of another one: no trials.")
    test = [number for number, cell in enumerate(state.cells) if cell.part == "test"]
    done = [number for number in test if number in state.done]
    if len(done) < len(test):
        lines.append(f"{len(test) - len(done)} of {len(test)} cells are missing; contrasts leave their pairs out.")
    rising = Counter(state.cells[number].method for number in done if not state.done[number].converged)
    if rising:
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


def shown(found: Estimate, form: str = ".2f") -> str:
    """A mean and its 95 % t interval, such as ``0.82 [0.75, 0.89]``."""
    return _between(found.value, found.interval, form)


def _between(value: float, ends: tuple[float, float], form: str) -> str:
    between = "" if math.isnan(ends[0]) else f" [{', '.join(format(end, form) for end in ends)}]"
    return f"{value:{form}}{between}".replace("-", "−")


# --- numbers that other pages quote -----------------------------------------------------------------------------------

_QUOTED = re.compile(
    r"<!-- (?P<kind>study|table) (?P<name>[\w-]+): (?P<what>.*?) -->(?P<text>.*?)<!-- / -->", re.DOTALL
)
_Key = tuple[Any, ...]
_SETTING = re.compile(r"(?P<key>study|task|without|seed|form|show|times|by)=(?P<value>.*)", re.DOTALL)


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
    known: dict[tuple[str, str], _Source] = {}
    families: dict[_Key, dict[_Key, Estimate]] = {}
    judged: dict[_Key, str] = {}

    def quoted(match: re.Match[str]) -> str:
        named = match["kind"], match["name"]
        if named not in known:  # nothing of a study is imported for its numbers
            study = Study.load(studies / f"{named[1]}.yaml", allow_code=True) if named[0] == "study" else None
            rows = earlier(study) if study else read_tidy(tables / f"{named[1]}.csv")
            known[named] = _Source(" ".join(named), rows, study)
        own = _quoted(known[named], match["what"], families, judged)
        return f"<!-- {' '.join(named)}: {match['what']} -->{own}<!-- / -->"

    _QUOTED.sub(quoted, text)  # finds the families
    for family in families.values():
        names = [verdict for verdict, _ in verdicts([(one, 0.0) for one in family.values()])]
        judged.update(zip(family, names, strict=True))
    for source in known.values():
        for one in tested(source.study, source.rows) if source.study else ():
            key = source.name, " - ".join(one.spec.pair), one.spec.measure, (str(one.demonstrations),), None
            judged.setdefault(key, one.verdict)
    return _QUOTED.sub(quoted, text)


@dataclass(frozen=True)
class _Source:
    name: str
    rows: Sequence[Row]
    study: Study | None


def _quoted(
    source: _Source, quotation: str, families: dict[_Key, dict[_Key, Estimate]], judged: Mapping[_Key, str]
) -> str:
    fields = [part.strip() for part in quotation.split(";")]
    settings = {found["key"]: found["value"] for part in fields if (found := _SETTING.fullmatch(part))}
    plain = [part.split(" | ") for part in fields if not _SETTING.fullmatch(part)]
    show, form = settings.get("show"), settings.get("form")
    counts = [tuple(one.split(" - ")) for one in plain[2]] if len(plain) == 3 else [()]
    try:
        times, _ = float(settings.get("times", 1)), format(0.0, form or "")
        wrong = not all(n.isdecimal() for one in counts for n in one)
    except ValueError:
        wrong = True
    if wrong or len(plain) not in (2, 3) or show not in (None, *SHOWN):
        raise BadInput(
            f"{source.name}: {quotation!r}: write a method or contrast, a measure and a number of demonstrations, such "
            f"as: options - flat; success; 50. After show= stands one of: {', '.join(SHOWN)}; form= is Python's"
        )
    seeds, several = {settings.get("seed", "")}, re.fullmatch(r"(\d+)-(\d+)", settings.get("seed", ""))
    if several:
        seeds = set(map(str, range(int(several[1]), int(several[2]) + 1)))
    some = tuple((key, settings[key]) for key in ("study", "without", "seed") if key in settings)
    rows = [row for row in source.rows if row.task != settings.get("without")]
    rows = [row for row in rows if settings.get("study") in (None, row.study) and seeds & {"", str(row.seed)}]

    (methods, measures), task, by_task = plain[:2], settings.get("task"), settings.get("by") == "task"
    single = len(methods) * len(measures) * len(counts) == 1

    def cell(what: str, measure: str, count: tuple[str, ...], task: str | None) -> str:
        own = values(rows, what, measure, list(map(int, count)) or [None], task)
        if not own:
            return ""
        each = any(seed != "" for one in own.values() for seed in one)  # a row without seed is their summary
        scaled = {t: {s: times * v for s, v in one.items() if s != "" or not each} for t, one in own.items()}
        difference = " - " in what
        how = show or ("interval" if single or difference else "mean")
        own_form = f"+{form}" if form and difference and not single else form
        starts = trials(source.study, measure) if source.study and times == 1 else 0
        found = estimate(scaled, starts, -1.0 if difference else 0.0)
        key = source.name, what, measure, count, task, *some
        if difference and how in ("interval", "±", "verdict") and source.study is None:
            families.setdefault((source.name, measure.partition(",")[0], *some), {})[key] = found
        if how == "verdict":
            return judged.get(key, NOT_TESTED)
        text = _shown(found, difference, measure, how, own_form)
        return f"**{text}**" if how in ("interval", "±") and judged.get(key) in DECIDED else text

    tasks = sorted({row.task for row in rows}) if by_task else [task]
    table = []
    for one, count, measure in itertools.product(tasks, counts, measures):
        cells = [cell(what, measure, count, one) for what in methods]
        if any(cells):
            named = [str(one), " − ".join(count), name_of(measure)]
            table.append([*named[not by_task :], *(text or "–" for text in cells)])
    if not table:
        raise BadInput(f"{source.name}: its tables have no {quotation!r}; check its names")
    if single:
        return table[0][-1]
    head = ["task", "demonstrations", "measure", *(one.replace(" - ", " − ") for one in methods)]
    return f"\n\n{Table(head[not by_task :], table, {0, 2} if by_task else {1}).markdown()}\n\n"


SHOWN = ("interval", "mean", "±", "sd", "se", "median", "range", "units", "above", "verdict")
"""How a quotation shows an estimate."""


def _shown(found: Estimate, difference: bool, measure: str, show: str, form: str | None) -> str:
    form = form or ("+" if difference else "") + (".0%" if measure.startswith("success") else ".2f")
    number = len(found.units)
    half = {"±": found.interval[1] - found.value, "se": found.error, "sd": found.error * math.sqrt(number)}
    if show == "above":
        return f"{sum(unit > 0 for unit in found.units)} of {number}"
    if show == "units":
        return str(number)
    if show == "range":
        text = " to ".join(format(end, form) for end in found.range)
    elif show in half and not math.isnan(half[show]):
        text = f"{found.value:{form}} ± {half[show]:{form.replace('+', '')}}"
    elif show == "median":
        text = _between(*found.median, form)
    else:
        text = shown(found, form) if show == "interval" else f"{found.value:{form}}"
    return text.replace("-", "−")
