"""The schema of ``metrics.json``, and reading JSON and CSV files of a run: one line names the file, place and remedy.

Log-likelihoods are in nats. A model has ``extra="allow"``: further keys of a file are kept.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import command
from ddco_pyro.spec.base import invalid, lines

T = TypeVar("T")


def _not_null(value: Any) -> Any:
    if value is None:
        raise invalid(("", "must not be null; where there is none the key is left out"))
    return value


NOT_NULL = AfterValidator(_not_null)
Finite = Annotated[float, Field(allow_inf_nan=False)]
AtLeastOne = Annotated[int, Field(ge=1)]


class Record(BaseModel):
    """A part of a file; further keys are kept."""

    model_config = ConfigDict(extra="allow", frozen=True)


def read_record(path: Path, kind: type[T], remedy: str) -> T:
    """Read a JSON file as an instance of a type.

    :param remedy: what to do about a damaged file.
    :raises Damaged: the file is not of this type.
    """
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes(), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        no_json = f"is no JSON: {first['ctx']['error']}" if first["type"] == "json_invalid" else ""
        raise Damaged(path, no_json or next(lines(error, Record)).removeprefix("spec: "), remedy) from None


def read_table(path: Path, row: Callable[[dict[str, str]], T], remedy: str) -> list[T]:
    """Read the rows of a CSV file.

    :param row: converts a row; a KeyError, TypeError or ValueError means that the file is damaged.
    :param remedy: what to do about a damaged file.
    :raises Damaged: the file is damaged.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [row(fields) for fields in csv.DictReader(file)]
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise Damaged(path, f"{type(error).__name__}: {error}", remedy) from error


def read_successes(folder: Path) -> dict[tuple[str, int], float]:
    """Success (1) or failure (0) of a run's rollouts by method and seed; empty without rollouts or without success.

    :raises Damaged: ``rollouts.csv`` is damaged.
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
    """Read a run's ``metrics.json``, which has to agree with :class:`Metrics`.

    :param counts: the number of options of each level, lowest first.
    :raises Damaged: the file is damaged, or is about other levels.
    """
    path, remedy = folder / "metrics.json", refit(folder)
    metrics = read_record(path, Metrics, remedy)
    levels = [[use.choice for use in level] for level in metrics.options]
    agreement = metrics.agreement
    lists: list[Sequence[Any] | None] = [metrics.divergences or None]
    if agreement is not None:
        lists += [agreement.labels, agreement.train, agreement.valid, agreement.confusion]
    wrong = {len(values) for values in lists if values is not None} - {len(counts)}
    if levels != [list(range(1 + count)) for count in counts] or wrong:
        raise Damaged(path, f"is not about levels with {', '.join(map(str, counts)) or 'no'} options", remedy)
    data: dict[str, Any] = json.loads(path.read_bytes())
    return data


def option_labels(metrics: Mapping[str, Any]) -> dict[str, dict[int, int]]:
    """The label that each option stands for, by level; empty for a run that was not trained from labels."""
    trained = metrics.get("trained_labels")
    return {trained["level"]: dict(enumerate(trained["values"], start=1))} if trained else {}


def refit(folder: Path, remove: str = "it") -> str:
    """The remedy for a damaged file of a run; what the checkpoints hold is not trained again."""
    return f"remove {remove} and fit again: {command('fit', folder / 'spec.yaml', '--out', folder, '--resume')}"


class PerStep(Record):
    """Log-likelihood in nats per step; ``valid`` where demonstrations were held out."""

    train: Finite
    valid: Finite | None


class HeldOut(Record):
    """The log-likelihood of a held-out demonstration, nats."""

    name: str
    steps: AtLeastOne
    log_likelihood: Finite


class Difference(Record):
    """A paired difference in nats per step; a single demonstration has no standard error."""

    nats_per_step: Finite
    standard_error: float | None


class BothParts(PerStep):
    """Log-likelihood of a baseline in nats per step; baselines need held-out demonstrations."""

    valid: Finite


class Allowed(Record):
    """The budget of training; None for no limit."""

    epochs: int | None
    gradient_steps: int | None


class Spent(Record):
    """The effort of training."""

    epochs: int
    gradient_steps: int


class Stage(Record):
    """The end of a stage of training (:class:`ddco_pyro.training.stages.StageEnd`)."""

    stage: str
    epochs: int
    cap: int | None
    rising: Finite
    over: int
    converged: bool


class Restart(Record):
    """The epochs of a restart, and the epoch of its last stage at which it was stopped early, if it was."""

    epochs: int
    stopped: int | None
    diverged: bool = False
    initialize: Annotated[str | None, NOT_NULL] = None
    """The kind of initialisation (``training.initialize``); left out for a policy without options."""
    nmi: Annotated[Finite | None, NOT_NULL] = None
    """NMI of its segments with the best restart's: of the training demonstrations, at the lowest level."""


class Restarts(Record):
    """All restarts of a model, and the number of the best."""

    best: int
    spent: Spent
    each: Annotated[list[Restart], Field(min_length=1)]


class Training(Record):
    """The effort of training out of its budget, and whether training converged."""

    budget: Allowed
    spent: Spent
    stages: Annotated[list[Stage], Field(min_length=1)]
    converged: bool
    restarts: Restarts
    device: str
    by_em: bool = False
    """Whether the gradient steps are EM steps over all training demonstrations."""


class Compared(Record):
    """A baseline and the model's difference to it."""

    log_likelihood_per_step: BothParts
    difference: Difference
    parameters: int
    training: Training


class InARow(Record):
    """Mean steps in a row of one choice, in a level of the hierarchy and of the mixture."""

    options: Finite
    mixture: Finite


class Worth(Record):
    """The parts of the hierarchy's advantage (:func:`ddco_pyro.evaluation.worth.worth`)."""

    memory: Difference
    experts: Annotated[Difference | None, NOT_NULL] = None
    total: Annotated[Difference | None, NOT_NULL] = None
    flat: Annotated[str | None, NOT_NULL] = None
    steps_in_a_row: Annotated[list[InARow], Field(min_length=1)]


class Seeds(Record):
    """Results of a fit and its repetitions, in the order of their training seeds."""

    training_seeds: Annotated[list[int], Field(min_length=2)]
    held_out: dict[str, list[Finite]]
    worth: dict[str, list[Finite]]
    standard_error: dict[str, list[Finite | None]]


class Dimensions(Record):
    """Contributions to the log-likelihood per step, by control dimension (None for constant ones) and of options."""

    by_dimension: list[Finite | None]
    options: Finite


class ByDimension(Record):
    """The contributions in each part of the data."""

    train: Dimensions
    valid: Dimensions | None


class Listed(Record):
    """A demonstration and its log-likelihood per step under each method."""

    name: str
    part: Literal["train", "valid"]
    steps: AtLeastOne
    log_likelihood_per_step: dict[str, Finite]


class ControlRange(Record):
    """Statistics of a control dimension in the demonstrations."""

    number: int
    minimum: Finite
    maximum: Finite
    at_minimum: int
    at_maximum: int
    steps: AtLeastOne
    inside: Finite | None = None
    at_inside: int = 0


class Branches(Record):
    """Use of the branches of a level's networks, by option and branch (:mod:`ddco_pyro.evaluation.branch_use`)."""

    level: int
    branches: Annotated[list[str], Field(min_length=1)]
    activation: list[list[Finite | None]]
    loss: list[list[Finite | None]]


class Use(Record):
    """The use of a choice of a level (:class:`ddco_pyro.evaluation.options.OptionUse`)."""

    choice: int
    share: Finite
    selected: Finite
    demonstrations: Finite
    duration: Finite | None


class Alike(Record):
    """The divergence of two options in nats per step."""

    options: tuple[int, int]
    divergence: Finite | None


class Measure(Record):
    """A measure of episodes: a ``rate`` of ``successes``, or a ``mean``."""

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
    """Successes of two methods from the same initial states (McNemar's test)."""

    only_ours: int
    only_theirs: int
    trials: int
    p_value: Finite


class Method(Record):
    """The rollouts of a method."""

    measures: dict[str, Measure]
    against: Annotated[Against | None, NOT_NULL] = None


class SuccessWorth(Record):
    """The parts of the hierarchy's advantage in success (:func:`ddco_pyro.evaluation.worth.success_worth`)."""

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
    """The rollouts of all methods, from the same initial states."""

    seed: int
    episodes: AtLeastOne
    methods: dict[str, Method]
    worth: Annotated[SuccessWorth | None, NOT_NULL] = None
    seeds: Annotated[SuccessOfSeeds | None, NOT_NULL] = None


class Unfinished(Record):
    """An interrupted rollout: the outcomes of finished methods by seed; null where a measure does not apply."""

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
    """Numbers of demonstrations, and the success rate of their supervisor."""

    train: AtLeastOne
    tune: int
    valid: int
    supervisor: dict[str, Measure] = Field(default_factory=dict)


class TrainedLabels(Record):
    """The labels that options 1, 2, ... of a level stand for, and the share of labelled steps that agree."""

    level: str
    labels: str
    values: list[int]
    agreement: Finite


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
    """Steps of each label in each option, and the label that each option is matched with."""

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


class Agreement(Record):
    """Agreement of each level's segments with the labels so named; None where no label is known."""

    labels: list[str]
    train: list[Scores | None]
    valid: Annotated[list[Scores | None] | None, NOT_NULL] = None
    confusion: list[Confusion]


class Engines(Record):
    """Largest relative differences between the engines before training (:mod:`ddco_pyro.inference.engines`)."""

    value: float
    gradient: float


class Metrics(Record):
    """The contents of ``metrics.json``; what does not apply to a run is left out."""

    model: str
    log_likelihood_per_step: PerStep
    log_likelihood_by_dimension: ByDimension
    valid: list[HeldOut]
    demonstrations_by_likelihood: list[Listed]
    comparison: dict[str, Compared]
    worth: Annotated[Worth | None, NOT_NULL] = None
    seeds: Annotated[Seeds | None, NOT_NULL] = None
    options: list[list[Use]] = Field(default_factory=list)
    divergences: list[list[Alike]] = Field(default_factory=list)
    agreement: Annotated[Agreement | None, NOT_NULL] = None
    trained_labels: Annotated[TrainedLabels | None, NOT_NULL] = None
    engine_check: Engines
    demonstrations: Counts
    control_dimensions: list[ControlRange]
    measure: dict[str, Annotated[list[Any], Field(min_length=1)]]
    branches: list[Branches] = Field(default_factory=list)
    parameters: int
    training: Training
    seconds: dict[str, float]
    versions: dict[str, str]
    rollouts: Annotated[Rollouts | None, NOT_NULL] = None
