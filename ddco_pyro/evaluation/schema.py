"""Files that a run or a selection keeps, read back: what is damaged is one line with the file, the place, the remedy.

Keys that are not named here are kept as they are.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import command
from ddco_pyro.evaluation.agreement_record import Agreement, as_today, each_level_of
from ddco_pyro.evaluation.record_types import NOT_NULL, AtLeastOne, Finite, Record
from ddco_pyro.spec.messages import invalid, lines

T = TypeVar("T")


def read_record(path: Path, kind: type[T], remedy: str) -> T:
    """What a JSON file holds, which has to be of this kind.

    :param remedy: what to do where it is not.
    :raises Damaged: it is not.
    """
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes(), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        no_json = f"is no JSON: {first['ctx']['error']}" if first["type"] == "json_invalid" else ""
        raise Damaged(path, no_json or next(lines(error, Record)).removeprefix("spec: "), remedy) from None


def read_table(path: Path, row: Callable[[dict[str, str]], T], remedy: str) -> list[T]:
    """The rows of a CSV file.

    :param row: what is made of a row; KeyError, TypeError and ValueError say that it is damaged.
    :param remedy: what to do where it is.
    :raises Damaged: it is.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [row(fields) for fields in csv.DictReader(file)]
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise Damaged(path, f"{type(error).__name__}: {error}", remedy) from error


def read_successes(folder: Path) -> dict[tuple[str, int], float]:
    """Success (1) or not (0) by method and seed, from a run's ``rollouts.csv``; nothing where it says nothing of it.

    :raises Damaged: it cannot be read.
    """
    path = folder / "rollouts.csv"
    if not path.exists():
        return {}
    rows = read_table(path, _success, f"remove it and roll out again: {command('rollout', folder)}")
    return {(method, seed): value for method, seed, value in rows if value is not None}


def _success(row: Mapping[str, str]) -> tuple[str, int, float | None]:
    said = row.get("success")
    return row["method"], int(row["seed"]), float(said) if said else None


def read_metrics(folder: Path, counts: Sequence[int]) -> dict[str, Any]:
    """The contents of a run's ``metrics.json``.

    :param counts: the number of options of each level, lowest first.
    :raises Damaged: it cannot be read, or lacks something that a reader needs.
    """
    path, remedy = folder / "metrics.json", refit(folder)
    metrics = read_record(path, Metrics, remedy)
    levels = [[use.choice for use in level] for level in metrics.options]
    each_level = [
        values for values in (*each_level_of(metrics.agreement), metrics.divergences or None) if values is not None
    ]
    if levels != [list(range(1 + count)) for count in counts] or {len(values) for values in each_level} - {len(counts)}:
        raise Damaged(path, f"is not about levels with {', '.join(map(str, counts)) or 'no'} options", remedy)
    data: dict[str, Any] = json.loads(path.read_bytes(), parse_constant=lambda _: None)  # NaN of earlier versions
    return data | ({"agreement": as_today(data["agreement"], len(counts))} if "agreement" in data else {})


def option_labels(metrics: Mapping[str, Any]) -> dict[str, dict[int, int]]:
    """The label that each option stands for, by level, of a run trained from labels."""
    said = metrics.get("trained_labels")
    return {said["level"]: dict(enumerate(said["values"], start=1))} if said else {}


def refit(folder: Path, remove: str = "it") -> str:
    """What to do about a damaged file of a run: what its checkpoint holds need not be trained again."""
    return f"remove {remove} and fit again: {command('fit', folder / 'spec.yaml', '--out', folder, '--resume')}"


class PerStep(Record):
    """Log-likelihood in nats per step; ``valid`` where demonstrations were held out."""

    train: Finite
    valid: Finite | None


class HeldOut(Record):
    """A demonstration that was held out."""

    name: str
    steps: AtLeastOne
    log_likelihood: Finite


class Difference(Record):
    """Paired, in nats per step; a single demonstration has no error."""

    nats_per_step: Finite
    standard_error: float | None


class BothParts(PerStep):
    """Baselines are trained only where demonstrations are held out."""

    valid: Finite


class Allowed(Record):
    """What training may spend; None for no limit."""

    epochs: int | None
    gradient_steps: int | None


class Spent(Record):
    """What training has spent."""

    epochs: int
    gradient_steps: int


class Stage(Record):
    """How a stage of training ended (:class:`ddco_pyro.training.convergence.StageEnd`)."""

    stage: str
    epochs: int
    cap: int | None
    rising: Finite
    over: int
    converged: bool


class Restart(Record):
    """What a restart took, after how many epochs of its last stage it was stopped early (None where it was not), and
    whether it diverged.
    """

    epochs: int
    stopped: int | None
    diverged: bool = False


class Restarts(Record):
    """Which restart was the best, and what all of them took."""

    best: int
    spent: Spent
    each: Annotated[list[Restart], Field(min_length=1)]


class Training(Record):
    """What training spent of its budget, and whether it had converged then."""

    budget: Allowed
    spent: Spent
    stages: Annotated[list[Stage], Field(min_length=1)]
    converged: bool
    restarts: Annotated[Restarts | None, NOT_NULL] = None


class Compared(Record):
    """A baseline."""

    log_likelihood_per_step: BothParts
    difference: Difference
    training: Annotated[Training | None, NOT_NULL] = None


class InARow(Record):
    """Mean steps for which a level of the hierarchy, and of the mixture, keeps to one choice."""

    options: Finite
    mixture: Finite


class Worth(Record):
    """What the hierarchy is worth (:func:`ddco_pyro.evaluation.worth.worth`)."""

    memory: Difference
    experts: Annotated[Difference | None, NOT_NULL] = None
    total: Annotated[Difference | None, NOT_NULL] = None
    flat: Annotated[str | None, NOT_NULL] = None
    steps_in_a_row: Annotated[list[InARow], Field(min_length=1)]


class Seeds(Record):
    """What a fit and its repetitions say, in the order of their training seeds."""

    training_seeds: Annotated[list[int], Field(min_length=2)]
    held_out: dict[str, list[Finite]]
    worth: dict[str, list[Finite]]


class Dimensions(Record):
    """Log-likelihood per step that each control dimension adds, None for constant ones, and choosing options."""

    by_dimension: list[Finite | None]
    options: Finite


class ByDimension(Record):
    """That of each part of the data."""

    train: Dimensions
    valid: Dimensions | None


class Listed(Record):
    """A demonstration and its log-likelihood per step under each method."""

    name: str
    part: Literal["train", "valid"]
    steps: AtLeastOne
    log_likelihood_per_step: dict[str, Finite]


class ControlRange(Record):
    """What a control dimension does in the demonstrations."""

    number: int
    minimum: Finite
    maximum: Finite
    at_minimum: int
    at_maximum: int
    steps: AtLeastOne
    inside: Finite | None = None
    at_inside: int = 0


class Branches(Record):
    """Activation of each branch of a level's networks, and what is lost without its input, by option and branch."""

    level: int
    branches: Annotated[list[str], Field(min_length=1)]
    activation: list[list[Finite | None]]
    loss: list[list[Finite | None]]


class Use(Record):
    """How a choice of a level is used."""

    choice: int
    share: Finite
    selected: Finite
    demonstrations: Finite = 0.0
    duration: Finite | None


class Alike(Record):
    """How differently two options act."""

    options: tuple[int, int]
    divergence: Finite | None


class Measure(Record):
    """What episodes came to: a rate (``successes``) or a ``mean``."""

    trials: int
    interval: tuple[Finite, Finite] | None
    successes: int = 0
    rate: Finite | None = None
    mean: Finite | None = None
    std: Finite | None = None

    @model_validator(mode="after")
    def _rate_or_mean(self) -> Measure:
        given = self.model_fields_set
        rate = {"successes", "rate"} <= given and (self.trials == 0 or None not in (self.rate, self.interval))
        mean = {"mean", "std"} <= given and (self.trials == 0 or self.mean is not None)
        if not rate and not mean:
            raise invalid(("", "is neither a rate nor a mean"))
        return self


class Against(Record):
    """Successes of two methods on the same initial states."""

    only_ours: int
    only_theirs: int
    trials: int
    p_value: Finite


class Method(Record):
    """The rollouts of a method."""

    measures: dict[str, Measure]
    against: Annotated[Against | None, NOT_NULL] = None


class SuccessWorth(Record):
    """The parts of what the hierarchy is worth in success (:func:`ddco_pyro.fitting.worth.success_worth`)."""

    memory: Against
    experts: Annotated[Against | None, NOT_NULL] = None
    total: Annotated[Against | None, NOT_NULL] = None
    flat: Annotated[str | None, NOT_NULL] = None


class SuccessOfSeeds(Record):
    """Success rates of a fit and its repetitions by method, and differences of rates, by training seed."""

    training_seeds: Annotated[list[int], Field(min_length=2)]
    success: dict[str, list[Finite]]
    worth: dict[str, list[Finite]]


class Rollouts(Record):
    """Those of all methods, from the same initial states."""

    seed: int
    episodes: AtLeastOne
    methods: dict[str, Method]
    worth: Annotated[SuccessWorth | None, NOT_NULL] = None
    seeds: Annotated[SuccessOfSeeds | None, NOT_NULL] = None


class Unfinished(Record):
    """Rollouts that were interrupted: the outcome of each seed's episode, for every method that was done; null for a
    measure that does not apply to an episode.
    """

    models: str
    seeds: list[int]
    outcomes: dict[str, list[dict[str, float | None]]]

    @model_validator(mode="after")
    def _an_outcome_for_each_seed(self) -> Unfinished:
        for method, outcomes in self.outcomes.items():
            if len(outcomes) != len(self.seeds):
                raise invalid(("outcomes", f"{method} has {len(outcomes)}, but there are {len(self.seeds)} seeds"))
        return self


class Counts(Record):
    """Demonstrations, and how often their supervisor succeeded."""

    train: AtLeastOne
    tune: int
    valid: int
    supervisor: dict[str, Measure] = Field(default_factory=dict)


class TrainedLabels(Record):
    """The labels that the options 1, 2, ... of a level stand for, and how much of the labelled steps has them."""

    level: str
    labels: str
    values: list[int]
    agreement: Finite


class Metrics(Record):
    """What ``metrics.json`` has to have for those who read it."""

    model: str
    log_likelihood_per_step: PerStep
    log_likelihood_by_dimension: Annotated[ByDimension | None, NOT_NULL] = None
    valid: list[HeldOut]
    demonstrations_by_likelihood: list[Listed] = Field(default_factory=list)
    comparison: dict[str, Compared]
    worth: Annotated[Worth | None, NOT_NULL] = None
    seeds: Annotated[Seeds | None, NOT_NULL] = None
    options: list[list[Use]] = Field(default_factory=list)
    divergences: list[list[Alike]] = Field(default_factory=list)
    agreement: Annotated[Agreement | None, NOT_NULL] = None
    trained_labels: Annotated[TrainedLabels | None, NOT_NULL] = None
    engine_check: dict[str, float]
    demonstrations: Counts
    control_dimensions: list[ControlRange] = Field(default_factory=list)
    measure: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    branches: list[Branches] = Field(default_factory=list)
    parameters: int
    training: Annotated[Training | None, NOT_NULL] = None
    seconds: dict[str, float]
    versions: dict[str, str]
    rollouts: Annotated[Rollouts | None, NOT_NULL] = None
