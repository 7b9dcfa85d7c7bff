"""Tidy tables of results, a number in each row, which a task, a method and a training seed name; estimates of means."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import BadInput
from ddco_pyro.statistics import CONFIDENCE, mean_interval, rate, t_quantile
from ddco_pyro.study.declaration import Study

COLUMNS = ["study", "task", "method", "demonstrations", "seed", "measure", "value"]
"""All but ``value`` are text. ``demonstrations`` is empty where a number does not depend on them. ``seed`` may name
other repetitions, and is empty where there is one value."""

CELL = ["task", "method", "demonstrations", "seed"]
"""The columns that name a cell."""

ORIGIN = ["key", "code"]
"""Further columns of a study's table: the digest of what the declaration says of a cell, and the commit of the code."""


def read_tidy(path: Path) -> pd.DataFrame:
    """A tidy table with :data:`COLUMNS`, and with :data:`ORIGIN` where it has them.

    :raises BadInput: the file cannot be read.
    """
    remedy = "write it with: ddco-pyro study report"
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False).astype({"value": float})
        return table[[*COLUMNS, *(column for column in ORIGIN if column in table)]]
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}; {remedy}") from error
    except (KeyError, ValueError) as error:
        raise Damaged(path, f"{type(error).__name__}: {' '.join(str(error).split())}", remedy) from error


def earlier(study: Study) -> pd.DataFrame:
    """The rows of a declaration's tables ``kept``, by the names of the declaration.

    Rows of other cells, and of several seeds together, are left out. The first of several values decides.
    """
    seeds = [str(seed) for block in study.declared.ranges("seeds").values() for seed in block]
    tables = [pd.DataFrame(columns=[*COLUMNS, *ORIGIN])]
    for kept in study.declared.kept:
        table = read_tidy(study.path.parent / kept.table)
        of = {"seed": seeds, "study": kept.study and [kept.study], "method": [*kept.methods.values()]}
        table = table[np.all([table[column].isin(own or table[column]) for column, own in of.items()], axis=0)]
        names = {"task": kept.tasks, "method": kept.methods, "measure": kept.measures}
        names_here = {column: {there: here for here, there in own.items()} for column, own in names.items()}
        table = table.replace(names_here).assign(study=study.name)
        tables.append(table[table.task.isin(study.tasks)])
    whole = pd.concat(tables).drop_duplicates([*CELL, "measure"]).astype({"value": float})
    return whole.fillna(dict.fromkeys(ORIGIN, ""))


def values(
    table: pd.DataFrame, what: str, measure: str, demonstrations: Sequence[str | int], task: str | None = None
) -> pd.Series:
    """The values of a method, or the paired differences of ``ours - theirs``, indexed by ``task`` and ``seed``.

    :param demonstrations: of a method; a second number is that of ``theirs``.
    """
    table = table[(table.measure == measure) & (table.task.eq(task) if task is not None else True)]

    def of(method: str, count: str | int) -> pd.Series:
        rows = table[(table.method == method.strip()) & (table.demonstrations == str(count))]
        return rows.groupby(["task", "seed"], sort=False).value.last()

    found = of(what, demonstrations[0])
    if found.empty and " - " in what:
        ours, _, theirs = what.partition(" - ")
        found = (of(ours, demonstrations[0]) - of(theirs, demonstrations[-1])).dropna()
    seeds = found.index.get_level_values("seed")
    return found[(seeds != "") | (seeds == "").all()]  # a row without seed is the summary of the others


LEVEL = (1 - CONFIDENCE) / 2
"""One-sided level of the tests, which corresponds to two-sided 95 % intervals."""


@dataclass(frozen=True)
class Estimate:
    """A mean over tasks of means over seeds.

    :param error: the standard error; NaN, as the interval is, where the units have no spread or there is one.
    :param interval: the 95 % t interval.
    :param units: the means of the tasks or of their families, or the values of the seeds of a single one.
    """

    value: float
    error: float
    interval: tuple[float, float]
    units: tuple[float, ...]

    @property
    def median(self) -> tuple[float, tuple[float, float]]:
        """The median unit and its exact interval of at least 95 %, whatever the distribution; NaN below six units."""
        from scipy.stats import quantile_test

        middle = float(np.median(self.units))
        ends = quantile_test(self.units, q=middle, p=0.5).confidence_interval(CONFIDENCE)
        return middle, (float(ends.low), float(ends.high))

    def p_value(self, low: float, high: float = math.inf) -> float:
        """The larger p-value of two one-sided t tests, of "the mean is at most ``low``" and of "at least ``high``".

        NaN without a standard error. One minus it is the p-value of the contrary claim.
        """
        from scipy.stats import t

        freedom = len(self.units) - 1
        below, above = t.sf((self.value - low) / self.error, freedom), t.cdf((self.value - high) / self.error, freedom)
        return float(max(below, above))


def estimate(
    values: pd.Series, trials: int = 0, lowest: float = -1.0, families: Mapping[str, str] | None = None
) -> Estimate:
    """The mean and its t interval.

    >>> found = estimate(pd.Series({("push", 0): 1.0, ("push", 1): 2.0, ("push", 2): 3.0}))
    >>> found.value, round(found.interval[0], 3)
    (2.0, -0.484)

    :param values: by task and training seed.
    :param trials: of each fit, where the values are rates or their differences. Equal units have Wilson's interval of
        all trials, a difference that of as many trials with different outcomes.
    :param lowest: the least possible value of a rate: 0, or -1 of a difference.
    :param families: the name of the family of a task, whose mean is one unit; tasks that are left out are units.
    """
    of_task = {task: own.to_numpy().mean() for task, own in values.groupby(level=0, sort=False)}
    related = families or {}
    means = pd.Series(of_task).groupby(lambda task: related.get(task, task), sort=False).mean().to_numpy()
    units = means if len(means) > 1 else values.to_numpy()
    value, error, interval = float(means.mean()), math.nan, (math.nan, math.nan)
    if len(units) > 1 and not np.allclose(units, units[0], rtol=1e-9, atol=1e-12):
        error, interval = float(units.std(ddof=1) / math.sqrt(len(units))), mean_interval(units)
    elif len(units) > 1 and trials:
        number = trials * len(values)
        count = round(abs(value) * number)
        low, high = rate(count, number)["interval"]
        least, most = sorted((math.copysign(low, value), math.copysign(high, value)))
        interval = (least, most) if count else (max(lowest, -high), high)
        error = (interval[1] - interval[0]) / 2 / t_quantile(math.inf)
    return Estimate(value, error, interval, tuple(map(float, units)))


def holm(p_values: Sequence[float] | np.ndarray) -> list[float]:
    """Holm's adjusted p-values, in the given order; a NaN counts as 1.

    >>> [round(p, 6) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    known = np.nan_to_num(np.array(p_values, float), nan=1.0)
    order = np.argsort(known)
    known[order] = np.minimum(np.maximum.accumulate(known[order] * np.arange(len(known), 0, -1)), 1.0)
    return known.tolist()
