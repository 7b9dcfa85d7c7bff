"""Tidy tables of results, a number in each row; estimates of means over them, and verdicts on contrasts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import quantile_test, t

from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import BadInput
from ddco_pyro.statistics import CONFIDENCE, mean_interval, rate, t_quantile
from studies.declaration import ContrastSpec, Study

COLUMNS = ["study", "task", "method", "demonstrations", "seed", "measure", "value"]
"""All but ``value`` are text. ``demonstrations`` and ``seed`` are empty where a number has none."""

CELL, ORIGIN = COLUMNS[1:5], ["key", "code"]
"""The columns that name a cell; further ones of a study's table: the declaration's digest, commit."""

HOLDS, FAILS, NOT_TESTED, EQUIVALENCE = "holds", "does not hold", "not tested", "equivalence"
LEVEL = (1 - CONFIDENCE) / 2
"""One-sided level of the tests, which corresponds to two-sided 95 % intervals."""


def read_tidy(path: Path) -> pd.DataFrame:
    """A table with :data:`COLUMNS`, with :data:`ORIGIN` if it has them; BadInput where it cannot be read."""
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False).astype({"value": float})
        return table[[*COLUMNS, *(column for column in ORIGIN if column in table)]]
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}; check the path") from error
    except (KeyError, ValueError) as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise Damaged(path, said, "write it with: python -m studies report") from error


def earlier(study: Study) -> pd.DataFrame:
    """The rows of a declaration's tables ``kept``, by its names; the first of several values decides."""
    seeds = [str(seed) for block in study.declared.ranges("seeds").values() for seed in block]
    tables = [pd.DataFrame(columns=[*COLUMNS, *ORIGIN])]
    for kept in study.declared.kept:
        table = read_tidy(study.path.parent / kept.table)
        of = {"seed": seeds, "study": kept.study and [kept.study], "method": [*kept.methods.values()]}
        wanted = [table[column].isin(own or table[column]) for column, own in of.items()]
        table = table[np.all(wanted, axis=0)]
        names = {"task": kept.tasks, "method": kept.methods, "measure": kept.measures}
        names_here = {column: {there: here for here, there in own.items()} for column, own in names.items()}
        table = table.replace(names_here).assign(study=study.path.stem)
        tables.append(table[table.task.isin(study.declared.tasks)])
    whole = pd.concat(tables).drop_duplicates([*CELL, "measure"]).astype({"value": float})
    return whole.fillna(dict.fromkeys(ORIGIN, ""))


def values(
    table: pd.DataFrame, what: str, measure: str, counts: Sequence[str | int], task: str | None
) -> pd.Series:
    """Values of a method, or paired differences ``ours - theirs``, by task and seed; ``counts`` of both."""
    table = table[(table.measure == measure) & (table.task.eq(task) if task is not None else True)]

    def of(method: str, count: str | int) -> pd.Series:
        rows = table[(table.method == method.strip()) & (table.demonstrations == str(count))]
        return rows.groupby(["task", "seed"], sort=False).value.last()

    found = of(what, counts[0])
    if found.empty and " - " in what:
        ours, _, theirs = what.partition(" - ")
        found = (of(ours, counts[0]) - of(theirs, counts[-1])).dropna()
    seeds = found.index.get_level_values("seed")
    return found[(seeds != "") | (seeds == "").all()]  # a row without seed is the summary of the others


@dataclass(frozen=True)
class Estimate:
    """A mean over tasks of means over seeds, its standard error and 95 % t interval; NaN without spread.

    ``units`` are the means of the tasks or of their families, or the values of the seeds of a single one.
    """

    value: float
    error: float
    interval: tuple[float, float]
    units: tuple[float, ...]

    @property
    def median(self) -> tuple[float, tuple[float, float]]:
        """The median unit and its exact interval of at least 95 %, for any distribution; NaN below six."""
        middle = float(np.median(self.units))
        ends = quantile_test(self.units, q=middle, p=0.5).confidence_interval(CONFIDENCE)
        return middle, (float(ends.low), float(ends.high))

    def p_value(self, low: float, high: float = math.inf) -> float:
        """The larger p-value of two one-sided t tests: the mean is at most ``low``, and at least ``high``."""
        freedom = len(self.units) - 1
        below = t.sf((self.value - low) / self.error, freedom)
        above = t.cdf((self.value - high) / self.error, freedom)
        return float(max(below, above))


def estimate(
    values: pd.Series,
    trials: int = 0,
    lowest: float = -1.0,
    families: Mapping[str, Sequence[str]] | None = None,
) -> Estimate:
    """The mean of values by task and seed, and its t interval.

    :param trials: of each fit, where the values are rates (``lowest`` 0) or their differences (-1). Equal
        units have Wilson's interval of all trials, a difference that of as many trials that differ.
    :param families: tasks by the name of their family, whose mean is one unit; others are units.
    """
    of_task = {task: own.to_numpy().mean() for task, own in values.groupby(level=0, sort=False)}
    related = {task: family for family, tasks in (families or {}).items() for task in tasks}
    means = pd.Series(of_task).groupby(lambda task: related.get(task, task), sort=False).mean().to_numpy()
    units = means if len(means) > 1 else values.to_numpy()
    value, error, interval = float(means.mean()), math.nan, (math.nan, math.nan)
    if len(units) > 1 and not np.allclose(units, units[0], rtol=1e-9, atol=1e-12):
        error, interval = float(units.std(ddof=1) / math.sqrt(len(units))), mean_interval(units)
    elif len(units) > 1 and trials:
        number = trials * len(values)
        count = round(abs(value) * number)
        low, high = rate(count, number).interval or (0.0, 1.0)
        least, most = sorted((math.copysign(low, value), math.copysign(high, value)))
        interval = (least, most) if count else (max(lowest, -high), high)
        error = (interval[1] - interval[0]) / 2 / t_quantile(math.inf)
    return Estimate(value, error, interval, tuple(map(float, units)))


def estimated(
    study: Study | None, table: pd.DataFrame, what: str, measure: str, counts: Sequence[str | int],
    task: str | None = None, times: float = 1.0,
) -> Estimate | None:  # fmt: skip
    """The mean of a method or contrast, some times as large; a study's rates have their starts as trials."""
    own, starts = times * values(table, what, measure, counts, task), study and study.declared.starts
    trials = starts.test.count if starts and measure.startswith("success") and times == 1 else 0
    families, lowest = study.declared.families if study else {}, -1.0 if " - " in what else 0.0
    return estimate(own, trials, lowest, families) if len(own) else None


def holm(p_values: Sequence[float] | np.ndarray) -> list[float]:
    """Holm's adjusted p-values, in the given order; a NaN counts as 1."""
    known = np.nan_to_num(np.array(p_values, float), nan=1.0)
    order = np.argsort(known)
    known[order] = np.minimum(np.maximum.accumulate(known[order] * np.arange(len(known), 0, -1)), 1.0)
    return known.tolist()


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
    found = [estimated(study, table, one.contrast, one.measure, [number]) for one, number in asked]
    pairs = zip(found, contrasts, strict=True)
    p_values = [own.p_value(*one.bounds) if own else math.nan for own, one in pairs]
    places: dict[Any, int] = {}
    for n, (one, count) in enumerate(asked):
        places[one.kind, one.contrast, one.measure, count] = n
    equal = [(facts, n) for (kind, *facts), n in places.items() if kind == EQUIVALENCE]
    twins = {n: places.get(("superiority", *facts)) for facts, n in equal}
    judged = verdicts(p_values, study.declared.correction, twins)
    return [Tested(*one, own, *verdict) for one, own, verdict in zip(asked, found, judged, strict=True)]


def verdicts(
    p_values: Sequence[float], correction: str = "holm", twins: Mapping[int, int | None] | None = None
) -> list[tuple[str, float]]:
    """The verdict on each claim of a family, and its adjusted p-value.

    ``does not hold``: the contrary does, whose p-value is one minus that of the claim. ``inconclusive``:
    neither does. ``not reached``: in a fixed sequence, an earlier claim does not. ``not tested``: no p-value.

    :param twins: maps an equivalence test to the superiority test of the same contrast. In a fixed sequence
        it is reached where its twin is, and no other claim waits for it.
    """
    given = np.array(p_values, float)
    known = np.nan_to_num(given, nan=1.0)
    beside = {n: twin for n, twin in (twins or {}).items() if twin is not None}
    before, claims, contraries = np.zeros(len(known)), np.array(holm(given)), np.array(holm(1 - given))
    if correction == "fixed_sequence":
        alone = [0.0 if place in beside else p for place, p in enumerate(known)]
        largest = np.maximum.accumulate([0.0, *alone])
        before = np.array([largest[beside.get(place, place)] for place in range(len(known))])
        claims, contraries = np.maximum(before, known), np.maximum(before, 1 - known)
    named = {"not reached": before > LEVEL, NOT_TESTED: np.isnan(given), HOLDS: claims <= LEVEL,
             FAILS: contraries <= LEVEL}  # fmt: skip
    said = np.select([*named.values()], [*named], "inconclusive").tolist()
    return list(zip(said, claims.tolist(), strict=True))
