"""How well options agree with labels, as ``metrics.json`` has it and had it before."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from ddco_pyro.evaluation.record_types import NOT_NULL, Finite, Record
from ddco_pyro.spec.messages import invalid


class Matched(Record):
    """Measures under a matching of options with labels (:mod:`ddco_pyro.evaluation.agreement`)."""

    accuracy: Finite
    iou: Finite
    f1_10: Finite
    f1_25: Finite
    f1_50: Finite
    edit: Finite


class Scores(Record):
    """All measures of a level."""

    nmi: Finite
    ari: Finite
    boundary_f1_1: Finite
    boundary_f1_3: Finite
    boundary_f1_5: Finite
    matched_globally: Matched
    matched_per_demonstration: Matched


class Confusion(Record):
    """Steps of each label in each option, and which label an option is matched with."""

    labels: list[int]
    options: list[int]
    steps: list[list[Annotated[int, Field(ge=0)]]]
    matched: list[int | None]

    @model_validator(mode="after")
    def _of_one_size(self) -> Confusion:
        sizes = [len(self.labels), *(len(row) for row in self.steps), len(self.matched)]
        if sizes != [len(self.steps), *[len(self.options)] * (len(self.steps) + 1)]:
            raise invalid(("", "is no table of labels by options"))
        return self


LevelScores = list[Scores | None] | list[Finite]
"""Of each level; None where no label is known. Runs of before have the NMI alone."""


class Agreement(Record):
    """How well each level agrees with the labels so named; runs of before have one name for all levels."""

    labels: list[str] | str
    train: LevelScores
    valid: Annotated[LevelScores | None, NOT_NULL] = None
    confusion: list[Confusion] = Field(default_factory=list)


def each_level_of(agreement: Agreement | None) -> list[Any]:
    """What of it has to have an entry for each level."""
    if agreement is None:
        return []
    names = None if isinstance(agreement.labels, str) else agreement.labels
    lists = (agreement.train, agreement.valid, agreement.confusion or None, names)
    return [values for values in lists if values is not None]


def as_today(agreement: dict[str, Any], levels: int) -> dict[str, Any]:
    """What ``metrics.json`` holds; runs of before have one name of labels, and the NMI in place of all measures."""
    names = agreement["labels"]
    today = agreement | {"labels": [names] * levels if isinstance(names, str) else names}
    for part in {"train", "valid"} & agreement.keys():
        today[part] = [{"nmi": s} if isinstance(s, float | int) else s for s in agreement[part]]
    return today
