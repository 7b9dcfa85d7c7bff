"""How often the frozen test's intervals cover, and what it would find: simulated before any of its fits.

    python studies/frozen_coverage.py

Tasks are drawn from the nine of ``arena.yaml``, whose differences options − mixture are shifted to a mean that is
known. A family of siblings has either tasks of its own (``apart``) or one task again and again (``alike``); the truth
is between the two. Seeds are drawn from a task's three, and successes are binomial. Adds rows to
``docs/results/frozen.csv``: the share of intervals that cover, and of contrasts that hold, by the true
difference in points.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy.stats import t
from study import RESULTS, ROOT, Row, add, printed, shown

from ddco_pyro.study.declaration import Study
from ddco_pyro.study.table import earlier, values

DRAWS = 4000
DIFFERENCES = (0, 5, 10, 15, 20)
"""True differences, in points."""


def families(frozen: Study) -> list[int]:
    """The number of tasks of each unit of the frozen test."""
    members = [len(own) for own in frozen.declared.families.values()]
    return [*members, *[1] * (len(frozen.tasks) - sum(members))]


def pool(table: pd.DataFrame, count: int) -> np.ndarray:
    """Success of options and of the mixture, [tasks, seeds, 2]."""
    both = [values(table, method, "success", [count]).unstack().sort_index() for method in ("options", "mixture")]
    assert both[0].index.equals(both[1].index)
    assert both[0].columns.equals(both[1].columns)
    rates: np.ndarray = np.stack([own.to_numpy() for own in both], axis=-1)
    return rates


def differences(rates: np.ndarray, sizes: list[int], seeds: int, starts: int, alike: bool) -> np.ndarray:
    """Simulated differences of the units, [DRAWS, units]."""
    random, units = np.random.default_rng(0), []
    for size in sizes:
        shape = (DRAWS, 1 if alike else size)
        tasks = np.broadcast_to(random.integers(len(rates), size=shape), (DRAWS, size))
        drawn = random.integers(rates.shape[1], size=(DRAWS, size, seeds))
        successes = random.binomial(starts, rates[tasks[..., None], drawn]) / starts
        units.append((successes[..., 0] - successes[..., 1]).mean((1, 2)))
    return np.stack(units, axis=1)


def rows(frozen: Study, arena: Study) -> Iterator[Row]:
    """Coverage of the 95 % t interval, and the share of draws in which a contrast holds at 2.5 %."""
    declared, table = frozen.declared, earlier(arena)
    assert declared.starts is not None
    sizes, margin = families(frozen), next(one.margin for one in declared.contrasts if one.kind == "equivalence")
    for count in declared.demonstrations.counts:
        rates = pool(table, count)
        truth = float((rates[..., 0] - rates[..., 1]).mean())
        for alike in (False, True):
            units = differences(rates, sizes, declared.seeds.test.count, declared.starts.test.count, alike)
            half = t.ppf(0.975, len(sizes) - 1) * units.std(1, ddof=1) / len(sizes) ** 0.5
            method = f"families {'alike' if alike else 'apart'}"
            covered = float((abs(units.mean(1) - truth) <= half).mean())
            yield Row("coverage", "", method, count, None, "covered", covered)
            for points in DIFFERENCES:
                mean = units.mean(1) - truth + points / 100
                holds, same = (mean > half).mean(), (abs(mean) + half < margin).mean()
                yield Row("coverage", "", method, count, None, f"superior at {points}", float(holds))
                yield Row("coverage", "", method, count, None, f"equivalent at {points}", float(same))


def main() -> None:
    """Simulate, and write the table."""
    frozen, arena = (Study.load(ROOT / "studies" / f"{name}.yaml", allow_code=True) for name in ("frozen", "arena"))
    found = list(rows(frozen, arena))
    add(RESULTS / "frozen.csv", found)
    printed(lambda: shown(found))


if __name__ == "__main__":
    main()
