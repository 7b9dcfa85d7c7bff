"""The section on control dimensions: what each does in the demonstrations, and what it adds to the log-likelihood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ddco_pyro.data.controls import ControlDimension
from ddco_pyro.drawing.words import method, number
from ddco_pyro.report.tables import Table


@dataclass(frozen=True)
class Dimensions:
    """What each control dimension and choosing options add to the log-likelihood per step of each method.

    :param part: of which demonstrations: ``held-out`` or ``training``.
    """

    table: Table
    part: str


def section(metrics: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> Dimensions | None:
    """The section of a run, from its ``metrics.json`` and its baselines'; None for runs of before."""
    by_method = {metrics["model"]: metrics, **baselines}
    known = {name: record["log_likelihood_by_dimension"] for name, record in by_method.items() if _KEY in record}
    if metrics["model"] not in known:
        return None
    part = "valid" if known[metrics["model"]]["valid"] else "train"
    values = {name: parts[part] for name, parts in known.items()}
    control = [ControlDimension(**fields) for fields in metrics["control_dimensions"]]
    return Dimensions(
        _table(control, values, metrics.get("measure", {})), "held-out" if part == "valid" else "training"
    )


_KEY = "log_likelihood_by_dimension"


def _table(
    control: Sequence[ControlDimension], values: Mapping[str, Mapping[str, Any]], measure: Mapping[str, Sequence[Any]]
) -> Table:
    rows = [
        [
            str(dimension.number),
            *(number(value["by_dimension"][dimension.number]) for value in values.values()),
            str(measure.get(str(dimension.number), [""])[0]),
            dimension.note,
        ]
        for dimension in control
    ]
    totals = [sum(filter(None, value["by_dimension"])) + value["options"] for value in values.values()]
    return Table(
        ["Control dimension", *map(method, values), "Modelled as", "In the demonstrations"],
        [
            *rows,
            ["options", *(number(value["options"]) for value in values.values()), "", ""],
            ["sum", *map(number, totals), "", ""],
        ],
    )
