"""Runs compared on the demonstrations that all of them held out, and on rollouts from the same initial states.

The form is that of arviz's ``compare``: rank, total, standard error, difference to the best, its standard error; with
the held-out log-likelihood of a trajectory where arviz has the elpd of an observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ddco_pyro.comparison import page, plot
from ddco_pyro.comparison.agreement import agreements
from ddco_pyro.comparison.rollouts import paired_rollouts
from ddco_pyro.comparison.shared import Held, held_out
from ddco_pyro.comparison.table import CompareError, Comparison, Row
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.evaluation.analysis import paired
from ddco_pyro.fitting.fit import load

__all__ = ["FILES", "CompareError", "Comparison", "Row", "compare", "write"]

FILES = ("compare.png", "compare.json", "compare.md", "compare.html")
"""What a comparison is written as."""


def compare(folders: Sequence[Path], allow_code: bool = False) -> Comparison:
    """The runs in these folders (a run's ``baselines/NAME`` is a run too), the best first.

    :param allow_code: import the user code that their specs name.
    :raises CompareError: there are less than two, or one twice.
    :raises NotShared: they were not held out on the same data.
    :raises RunError: a folder is not a finished run.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise CompareError("the same run is given twice; name each once")
    if len(folders) < 2:
        raise CompareError("one run alone cannot be compared; name at least two, such as RUN and RUN/baselines/flat")
    fits = [load(folder, allow_code) for folder in folders]
    runs = held_out(fits)
    values = np.stack([held.values for held in runs])
    best = int(values.sum(1).argmax())
    rows = [_row(0, held, values[best]) for held in runs]
    ranked = sorted(rows, key=lambda row: row.difference)
    order = [row.name for row in ranked]
    with_options = {held.run for held in runs if held.fit.spec.hierarchy}
    return Comparison(
        [Row(**vars(row) | {"rank": rank}) for rank, row in enumerate(ranked)],
        runs[0].names,
        runs[0].steps,
        agreements(fits, order),
        paired_rollouts(fits, order),
        next((row.name for row in ranked if row.name in with_options), ranked[0].name),
    )


def _row(rank: int, held: Held, best: np.ndarray) -> Row:
    steps = np.array(held.steps, dtype=float)
    own, apart = paired(held.values, np.zeros(len(steps)), steps), paired(best, held.values, steps)
    return Row(
        rank, held.run, held.fit.name, int(held.fit.metrics["parameters"]), float(held.values.sum()),
        own["standard_error"] * sum(held.steps), float((best - held.values).sum()),
        apart["standard_error"] * sum(held.steps), own["nats_per_step"], tuple(held.values.tolist()),
        held.fit.metrics.get("training"),
    )  # fmt: skip


def write(compared: Comparison, folder: Path) -> Path:
    """Write ``compare.json``, ``.md``, ``.html`` and ``.png`` into a folder; the path of the page."""
    picture = plot.write(compared, folder / "compare.png")
    write_text(folder / "compare.json", json_text(compared.as_data()))
    write_text(folder / "compare.md", page.markdown(compared))
    write_text(folder / "compare.html", page.html(compared, picture, folder))
    return folder / "compare.html"
