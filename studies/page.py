"""Generated tables of pages, as ``docs/studies.md`` describes them, and the report of a study.

``studies/tables/PAGE.md`` has a table ``## NAME`` for ``<!-- table: PAGE/NAME -->`` to ``<!-- end -->``.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import pandas as pd

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.page import Table
from ddco_pyro.errors import BadInput, nearest
from studies import statistics
from studies.cells import ROOT, Folder, State
from studies.declaration import NATS, Study
from studies.statistics import EQUIVALENCE, FAILS, HOLDS, NOT_TESTED, Estimate, estimated, tested

STUDIES, RESULTS = ROOT / "studies", ROOT / "docs" / "results"
BLOCK = re.compile(r"^<!-- table: (\w+)/(\w+) -->$.*?^<!-- end -->$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"\{(\w+\.(?:csv|yaml)): (.*?)\}")
SETTING = re.compile(r"(study|task|seed|form|show|times|by)=(.*)")


def name_of(measure: str) -> str:
    """The name of a measure in tables."""
    return words.measure("log_likelihood" if measure == NATS else measure) if measure.islower() else measure


def shown(known: Estimate, form: str = ".2f") -> str:
    """A mean and its 95 % t interval, such as ``0.82 [0.75, 0.89]``."""
    return _between(known.value, known.interval, form)


def _between(value: float, ends: tuple[float, float], form: str) -> str:
    between = "" if math.isnan(ends[0]) else f" [{', '.join(format(end, form) for end in ends)}]"
    return f"{value:{form}}{between}".replace("-", "−")


def _with(known: Estimate, half: float, form: str) -> str:
    return f"{known.value:{form}}" + ("" if math.isnan(half) else f" ± {half:{form.replace('+', '')}}")


SHOWN: dict[str, Callable[[Estimate, str], str]] = {
    "interval": shown,
    "mean": lambda known, form: f"{known.value:{form}}",
    "±": lambda known, form: _with(known, known.interval[1] - known.value, form),
    "sd": lambda known, form: _with(known, known.error * math.sqrt(len(known.units)), form),
    "se": lambda known, form: _with(known, known.error, form),
    "median": lambda known, form: _between(*known.median, form),
    "range": lambda known, form: f"{min(known.units):{form}} to {max(known.units):{form}}",
    "above": lambda known, form: f"{sum(unit > 0 for unit in known.units)} of {len(known.units)}",
}
"""How a number shows an estimate; others show a ``verdict``, or that on the ``equivalence`` of a contrast."""


def render(text: str) -> str:
    """A page's text with its generated tables as the results have them; raises BadInput if one is missing."""
    numbers = Numbers()
    templates = {match.groups(): template(*match.groups()) for match in BLOCK.finditer(text)}
    for one in templates.values():
        NUMBER.sub(numbers.shown, one)  # finds the families of differences
    numbers.judge()

    def block(match: re.Match[str]) -> str:
        begin, table = match[0].partition("\n")[0], NUMBER.sub(numbers.shown, templates[match.groups()])
        return f"{begin}\n\n{table}\n\n<!-- end -->"

    return BLOCK.sub(block, text)


def template(place: str, name: str) -> str:
    """A table before its numbers are there; raises BadInput if there is none."""
    path = STUDIES / "tables" / f"{place}.md"
    kept = path.read_text(encoding="utf-8") if path.exists() else ""
    parts = re.split(r"^## (\w+)\n", kept, flags=re.MULTILINE)
    known = dict(zip(parts[1::2], parts[2::2], strict=True))
    if name not in known:
        raise BadInput(f"{path}: has no table {name!r}{nearest(name, known)}; add it under: ## {name}")
    return known[name].strip()


@dataclass
class Numbers:
    """The numbers of a page, families of differences in ``.csv`` files, and verdicts on primary contrasts."""

    tables: dict[str, tuple[Study | None, pd.DataFrame]] = field(default_factory=dict)
    estimates: dict[Any, Estimate | None] = field(default_factory=dict)
    families: dict[Any, dict[Any, Estimate]] = field(default_factory=lambda: defaultdict(dict))
    verdicts: dict[Any, str] = field(default_factory=dict)

    def judge(self) -> None:
        """Give the verdicts of the families."""
        for family in self.families.values():
            judged = statistics.verdicts([known.p_value(0.0) for known in family.values()])
            self.verdicts |= {key: verdict for key, (verdict, _) in zip(family, judged, strict=True)}

    def table(self, source: str) -> tuple[Study | None, pd.DataFrame]:
        """The study ``STUDY.yaml`` with its rows by its declaration's names; the rows of ``TABLE.csv``."""
        if source not in self.tables:
            study = Study.load(STUDIES / source) if source.endswith(".yaml") else None
            table = statistics.earlier(study) if study else statistics.read_tidy(RESULTS / source)
            self.tables[source] = study, table
            for one in tested(study, table) if study else ():
                key = source, (), one.spec.contrast, one.spec.measure, (str(one.demonstrations),), None
                if one.spec.kind == EQUIVALENCE:
                    self.verdicts[EQUIVALENCE, *key] = one.verdict
                    self.verdicts.setdefault(key, one.verdict)
                else:
                    self.verdicts[key] = one.verdict
        return self.tables[source]

    def shown(self, match: re.Match[str]) -> str:
        """A number, or a table of several methods, measures or counts; raises BadInput if there is none."""
        source, asked = match.groups()
        fields = [part.strip() for part in asked.split(";")]
        settings = {found[1]: found[2] for part in fields if (found := SETTING.fullmatch(part))}
        plain = [part.split(" | ") for part in fields if not SETTING.fullmatch(part)]
        shows = (*SHOWN, "verdict", EQUIVALENCE)
        if len(plain) not in (2, 3) or settings.get("show", "mean") not in shows:
            text = "write a method or contrast, a measure and a number of demonstrations, such as: options - "
            text += f"flat; success; 50. After show= stands one of: {', '.join(shows)}"
            raise BadInput(f"{match[0]}: {text}")
        whats, measures, counts = [*plain, [""]][:3]
        alone, by_task, rows = max(map(len, (whats, measures, counts))) == 1, settings.get("by") == "task", []
        tasks: list[Any] = sorted({*self.table(source)[1].task}) if by_task else [settings.get("task")]
        for task, count, measure in product(tasks, counts, measures):
            numbers = tuple(count.split(" - "))
            cells = [self._number((source, what, measure, numbers, task), settings, alone) for what in whats]
            if any(cells):
                filled = [text or "–" for text in cells]
                rows.append([str(task), " − ".join(numbers), name_of(measure), *filled])
        if not rows:
            raise BadInput(f"{match[0]}: there is no such number; check its names")
        head = ["task", "demonstrations", "measure", *(what.replace(" - ", " − ") for what in whats)]
        whole = Table(head[not by_task :], [row[not by_task :] for row in rows], {0, 2} if by_task else {1})
        return rows[0][-1] if alone else whole.markdown()

    def _number(self, named: Any, settings: Mapping[str, str], alone: bool) -> str:
        """A number as it is shown; empty where there is none."""
        (source, what, measure, counts, task), times = named, float(settings.get("times", 1))
        study, table = self.table(source)
        taken = tuple((column, settings[column]) for column in ("study", "seed") if column in settings)
        key = source, taken, what, measure, counts, task
        if (key, times) not in self.estimates:
            for column, value in taken:
                first, _, last = value.partition("-") if column == "seed" else (value, "", "")
                those = [*map(str, range(int(first), int(last) + 1))] if last else [value]
                table = table[table[column].isin(those)]
            self.estimates[key, times] = estimated(study, table, what, measure, counts, task, times)
        if (known := self.estimates[key, times]) is None:
            return ""
        difference, verdict = " - " in what, self.verdicts.get(key, NOT_TESTED)
        show = settings.get("show") or ("interval" if alone or difference else "mean")
        if show in ("interval", "±", "verdict") and difference and study is None:
            self.families[source, taken, measure.partition(",")[0]][key] = known
        if show in ("verdict", EQUIVALENCE):
            return verdict if show == "verdict" else self.verdicts.get((EQUIVALENCE, *key), NOT_TESTED)
        form = settings.get("form") or (".0%" if measure.startswith("success") else ".2f")
        form = f"+{form}" if difference and not (alone and "form" in settings) else form
        text = SHOWN[show](known, form).replace("-", "−")
        declared = study is not None and not study.declared.exploratory
        return f"**{text}**" if declared and show in ("interval", "±") and verdict in (HOLDS, FAILS) else text


def report(folder: Folder, state: State) -> str:
    """Write ``table.csv`` into the folder of a study; returns its contrasts and means as Markdown.

    :raises BadInput: no cell has a declared measure.
    """
    study, declared, table = folder.study, folder.study.declared, folder.table(state)
    there = sorted({name for one in state.done.values() for name in one.values}) or ["no cell that is done"]
    for measure in {*declared.measures} - {*table.measure}:
        text = f"measures: no cell has {measure!r}{nearest(measure, there)}; there is: {', '.join(there)}"
        raise BadInput(f"{study.path}: {text}")
    write_text(folder.path / "table.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.9g"))
    rows, means = list[list[str]](), list[list[str]]()
    for one in tested(study, table):
        known = one.estimate
        numbers = [SHOWN[show](known, "+.2f") for show in ("interval", "median")] if known else ["–"] * 2
        facts = [one.spec.contrast, name_of(one.spec.measure), str(one.demonstrations)]
        facts += [one.spec.kind, one.verdict]
        rows.append([*facts, *numbers, "–" if one.verdict == NOT_TESTED else words.p_value(one.adjusted)])
    head = ["contrast", "measure", "demonstrations", "kind", "verdict"]
    head += ["mean [95 % t]", "median [95 %]", "adjusted p"]
    tables = [Table(head, rows, {0, 1, 3, 4}).markdown()] if rows else []
    for count, method in product(declared.demonstrations.counts, declared.methods):
        own = [estimated(study, table, method, measure, [count]) for measure in declared.measures]
        means.append([str(count), method, *(shown(known) if known else "–" for known in own)])
    columns = ["demonstrations", "method", *map(name_of, declared.measures)]
    tables.append(Table(columns, means, {1}).markdown())
    return "\n\n".join([f"# Study {study.path.stem}", declared.question, *tables])
