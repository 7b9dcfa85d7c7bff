"""Contents of ``metrics.json`` (:class:`Metrics`), how numbers are shown (:data:`METRICS`), reading files.

Log-likelihoods are in nats.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import not_
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, NamedTuple, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from ddco_pyro.data.controls import ControlDimension
from ddco_pyro.data.files import Damaged, json_text, write_text
from ddco_pyro.errors import command
from ddco_pyro.spec.base import invalid, lines

T = TypeVar("T")


Finite = Annotated[float, Field(allow_inf_nan=False)]
AtLeastOne = Annotated[int, Field(ge=1)]
LeftOut = Annotated[T, Field(exclude_if=not_)]
"""A field that is left out of the file where it is empty."""


class Metric(NamedTuple):
    """How a number of a run is called and shown, by console, report, comparison and studies alike.

    Over training seeds it is a mean with its 95 % t interval.

    :param unit: of a difference; ``scale`` times the number has it.
    :param digits: after the point.
    """

    name: str
    unit: str = ""
    scale: float = 1.0
    digits: int = 2


METRICS: Mapping[str, Metric] = {
    "log_likelihood": Metric("held-out nats/step", "nats per step"),
    "success": Metric("Success", "points of success", 100, 0),
    "nmi": Metric("NMI"),
    "ari": Metric("ARI"),
    "boundary_f1_1": Metric("boundary F1 ±1"),
    "boundary_f1_3": Metric("boundary F1 ±3"),
    "boundary_f1_5": Metric("boundary F1 ±5"),
    "accuracy": Metric("accuracy"),
    "iou": Metric("IoU"),
    "f1_10": Metric("F1@10"),
    "f1_25": Metric("F1@25"),
    "f1_50": Metric("F1@50"),
    "edit": Metric("edit"),
}
"""Every metric of a run, by its field; a task's own measures are called as the task calls them."""


class Record(BaseModel):
    """A part of a file; further keys of the file are kept."""

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


def write_table(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file with a line for each row, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_successes(folder: Path) -> dict[tuple[str, int], float]:
    """Success (1) or failure (0) of a run's rollouts by method and seed; empty without rollouts or success.

    :raises Damaged: ``rollouts.csv`` is damaged.
    """
    path = folder / "rollouts.csv"
    if not path.exists():
        return {}
    rows = read_table(
        path,
        lambda row: ((row["method"], int(row["seed"])), float(row.get("success") or math.nan)),
        f"remove it and roll out again: {command('rollout', folder)}",
    )
    return {place: value for place, value in rows if not math.isnan(value)}


def refit(folder: Path, remove: str = "it") -> str:
    """The remedy for a damaged file of a run; what the checkpoints hold is not trained again."""
    again = command("fit", folder / "spec.yaml", "--out", folder, "--resume")
    return f"remove {remove} and fit again: {again}"


class Parts(Record, Generic[T]):
    """A number of the training demonstrations, and of the held-out ones where there are any."""

    train: T
    valid: T | None


class Marginal(Parts[Finite]):
    """The log-likelihood per step of a density of the control that reads no observation.

    It has the model's kinds, fitted to training demonstrations. ``controls``: how many dimensions vary.
    """

    controls: AtLeastOne


class HeldOut(Record):
    """The log-likelihood of a held-out demonstration, nats."""

    name: str
    steps: AtLeastOne
    log_likelihood: Finite


class Difference(Record):
    """A paired difference in nats per step, with its standard error; a single demonstration has none."""

    nats_per_step: Finite
    standard_error: Finite | None


class Effort(Record):
    """What training took, or what it may take: None for no limit."""

    epochs: int | None
    gradient_steps: int | None


class Stage(Record):
    """The end of a stage of training (:func:`ddco_pyro.training.stages.stage_end`)."""

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
    diverged: LeftOut[bool] = False
    start: str
    """What it began from (``training.starts``)."""
    objective: Finite | None
    """As of the model; None where it diverged or was stopped."""
    nmi: LeftOut[Finite | None] = None
    """NMI of its segments with the best restart's: of the training demonstrations, at the lowest level."""


class Restarts(Record):
    """All restarts of a model, and the number of the best."""

    best: int
    spent: Effort
    each: Annotated[list[Restart], Field(min_length=1)]


class Candidate(Record):
    """Weights that were tried, and the mean accuracy and edit score of left-out labelled demonstrations."""

    power: Finite
    weight: Finite
    ridge: Finite
    accuracy: Finite
    edit: Finite

    @property
    def score(self) -> float:
        """The mean of both scores."""
        return (self.accuracy + self.edit) / 2


class Recogniser(Record):
    """How much the controls' density (``power``) and the recogniser (``weight``) count; widths in steps."""

    power: Finite
    weight: Finite
    ridge: Finite
    widths: list[AtLeastOne]
    tried: LeftOut[list[Candidate]] = []


class Training(Record):
    """The effort of training out of its budget, and whether training converged."""

    budget: Effort
    spent: Effort
    stages: Annotated[list[Stage], Field(min_length=1)]
    converged: bool
    restarts: Restarts
    objective: Finite
    """What the best restart has: the log-likelihood of the training demonstrations (``control.power``) with
    the log-prior of EM's ridges, nats per step."""
    device: str
    by_em: bool
    """Whether the gradient steps are EM steps over all training demonstrations."""
    by_lbfgs: bool = False
    """Whether they are steps of L-BFGS over all training demonstrations."""
    raised_ridge: LeftOut[float | None] = None
    """The ridge of policies, where it is larger than the spec's."""
    recogniser: LeftOut[Recogniser | None] = None


class Compared(Record):
    """A baseline and the model's difference to it."""

    log_likelihood_per_step: Parts[Finite]
    difference: Difference
    parameters: int
    training: Training


class Below(Record):
    """By how much training demonstrations are less likely under a hierarchy than a mixture that it contains.

    Nats per step: of training's ``objective``, and of the log-likelihood. Negative where they are likelier.
    """

    objective: Finite
    nats: Finite


class Against(Record):
    """Successes of two methods from the same initial states (McNemar's test)."""

    only_ours: int
    only_theirs: int
    trials: int
    p_value: Finite


class Worth(Record, Generic[T]):
    """The parts of the hierarchy's advantage (:mod:`ddco_pyro.statistics`), and the flat baseline's name.

    In nats per step a part is a :class:`Difference`, in success :class:`Against`.
    """

    memory: T
    experts: LeftOut[T | None] = None
    total: LeftOut[T | None] = None
    flat: LeftOut[str | None] = None

    @property
    def parts(self) -> dict[str, T]:
        """The parts that there are, by name."""
        each = {"memory": self.memory, "experts": self.experts, "total": self.total}
        return {name: part for name, part in each.items() if part}


NatsWorth = Worth[Difference]
SuccessWorth = Worth[Against]
"""Made here, where pickle looks for the classes."""


class Seeds(Record):
    """Results of a fit and its repetitions, in the order of their training seeds.

    ``worth`` has the parts of :class:`Worth`. After fits it is in nats per step, with ``standard_error`` over
    held-out demonstrations and log-likelihoods per step by model (``held_out``). After rollouts it has
    differences of success rates, with the rates by method (``success``).
    """

    training_seeds: Annotated[list[int], Field(min_length=2)]
    worth: dict[str, list[Finite]]
    held_out: LeftOut[dict[str, list[Finite]]] = {}
    standard_error: LeftOut[dict[str, list[Finite | None]]] = {}
    success: LeftOut[dict[str, list[Finite]]] = {}


class Dimensions(Record):
    """Contributions to the log-likelihood per step: by control dimension (None: constant) and of options."""

    by_dimension: list[Finite | None]
    options: Finite


ByDimension = Parts[Dimensions]
"""Made here, where pickle looks for the class."""


class Listed(Record):
    """A demonstration of a part (``train``, ``valid``), and its log-likelihood per step under each method."""

    name: str
    part: str
    steps: AtLeastOne
    log_likelihood_per_step: dict[str, Finite]


class BranchUse(Record):
    """Use of a level's branches, by option and branch (:mod:`ddco_pyro.evaluation.branch_use`)."""

    level: int
    branches: Annotated[list[str], Field(min_length=1)]
    activation: list[list[Finite | None]]
    loss: list[list[Finite | None]]


class Use(Record):
    """The use of one choice of a level (0 is control) in demonstrations.

    - ``share``: mean of u_t, the share of steps in which the choice is active;
    - ``selected``: Σ v_t, the expected number of selections;
    - ``demonstrations``: the expected number of demonstrations with a selection, Σ_n min(1, Σ_t v_t);
    - ``duration``: expected steps from a selection to the next, Σ u_t / Σ v_t; None without a selection;
    - ``segments``: how often the most likely paths go over to the choice; ``steps`` with it; ``length``: the
      median steps of a segment, None without one;
    - ``having``: the number of demonstrations with a segment; ``within``: the share of their steps with the
      choice, None where all demonstrations have it, or none.
    """

    choice: int
    share: Finite
    selected: Finite
    demonstrations: Finite
    duration: Finite | None
    segments: int
    steps: int
    length: Finite | None
    having: int
    within: Finite | None


class Segments(Record):
    """Segments of a level on the most likely paths: the ``median`` of their steps, and their ``number``.

    ``twitches`` of them are too short for a skill (:func:`ddco_pyro.evaluation.options.segments_of`).
    """

    median: Finite
    number: AtLeastOne
    demonstrations: AtLeastOne
    twitches: int

    OFTEN: ClassVar[int] = 6
    """Segments in a demonstration from which on options switch often; a few twitches may be meant."""

    @property
    def often(self) -> bool:
        """Whether options switch often."""
        return self.number >= self.OFTEN * self.demonstrations

    @property
    def brief(self) -> bool:
        """Whether options switch often, and most segments are twitches."""
        return self.often and 2 * self.twitches > self.number


class Alike(Record):
    """The divergence of two options in nats per step."""

    options: tuple[int, int]
    divergence: Finite | None


class Rate(Record):
    """A success rate over ``trials`` episodes, with its 95 % interval; None without trials."""

    successes: int
    trials: int
    rate: Finite | None
    interval: tuple[Finite, Finite] | None


class Mean(Record):
    """A mean over ``trials`` episodes; None where there are too few for it."""

    mean: Finite | None
    std: Finite | None
    trials: int
    interval: tuple[Finite, Finite] | None


Measure = Rate | Mean
"""A measure of episodes."""


class Method(Record):
    """The rollouts of a method."""

    measures: dict[str, Measure]
    against: LeftOut[Against | None] = None


class Rollouts(Record):
    """The rollouts of all methods, from the same initial states."""

    seed: int
    episodes: AtLeastOne
    methods: dict[str, Method]
    worth: LeftOut[SuccessWorth | None] = None
    seeds: LeftOut[Seeds | None] = None

    @property
    def success_rates(self) -> dict[str, Rate]:
        """The success rate of each method that has one."""
        found = {name: method.measures.get("success") for name, method in self.methods.items()}
        return {name: rate for name, rate in found.items() if isinstance(rate, Rate)}


class Counts(Record):
    """Numbers of demonstrations, and the success rate of their supervisor.

    ``tune`` is 0 where the training demonstrations tune. Held-out demonstrations train the model, too, where
    ``left_out`` says that each is held out from a fit without it.
    """

    train: AtLeastOne
    tune: int
    valid: int
    left_out: LeftOut[bool] = False
    supervisor: LeftOut[dict[str, Measure]] = {}


class TrainedLabels(Record):
    """The labels that options 1, 2, ... of a level stand for, and the share of labelled steps that agree."""

    level: str
    labels: str
    values: list[int]
    demonstrations: list[str]
    agreement: Finite


class NamedByLabel(Record):
    """An option and the label that it stands for.

    ``agreement``: the intersection of their steps over the union, in training demonstrations with the labels.
    """

    level: str
    option: AtLeastOne
    labels: str
    name: str
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
    """Steps of each label (rows) in each option (columns), and the label matched with each option, if any."""

    labels: list[int]
    options: list[int]
    steps: list[list[Annotated[int, Field(ge=0)]]]
    matched: list[int | None]

    @model_validator(mode="after")
    def _whole(self) -> Confusion:
        widths = {len(self.matched), *map(len, self.steps)}
        whole = widths == {len(self.options)} and len(self.steps) == len(self.labels)
        if not whole or {*self.matched} - {None, *self.labels}:
            raise invalid(("", "is no table of labels by options"))
        return self


class Agreement(Record):
    """Agreement of each level's segments with the labels so named; None where no label is known.

    ``equal_train`` and ``equal_valid`` are of demonstrations that are cut into equal parts, as many as there
    are options. ``recogniser``: by part, what options a recogniser alone finds at each step of its level.
    """

    labels: list[str]
    train: list[Scores | None]
    valid: LeftOut[list[Scores | None] | None] = None
    equal_train: LeftOut[list[Scores | None]] = []
    equal_valid: LeftOut[list[Scores | None] | None] = None
    recogniser: LeftOut[dict[str, Scores | None]] = {}
    confusion: list[Confusion]


class Engines(Record):
    """Largest relative differences between engines before training (:mod:`ddco_pyro.inference.engines`)."""

    value: float
    gradient: float


class Metrics(Record, frozen=False):
    """The contents of ``metrics.json``. What does not apply to a run is None or empty, not in the file."""

    model: str
    log_likelihood_per_step: Parts[Finite]
    log_likelihood_by_dimension: ByDimension
    marginal: LeftOut[Marginal | None] = None
    valid: list[HeldOut]
    demonstrations_by_likelihood: list[Listed]
    comparison: dict[str, Compared]
    worth: LeftOut[NatsWorth | None] = None
    below: LeftOut[dict[str, Below]] = {}
    """By the name of each mixture among the baselines that the hierarchy contains."""
    branches: LeftOut[list[BranchUse]] = []
    options: LeftOut[list[list[Use]]] = []
    segments: LeftOut[list[Segments]] = []
    divergences: LeftOut[list[list[Alike]]] = []
    agreement: LeftOut[Agreement | None] = None
    control_frequency: LeftOut[Finite | None] = None
    trained_labels: LeftOut[TrainedLabels | None] = None
    named_by_labels: LeftOut[list[NamedByLabel]] = []
    engine_check: Engines
    demonstrations: Counts
    measure: dict[str, Annotated[list[Any], Field(min_length=1)]]
    control_dimensions: list[Annotated[ControlDimension, PlainSerializer(ControlDimension.as_data)]]
    parameters: int
    training: Training
    seconds: dict[str, float]
    versions: dict[str, str]
    seeds: LeftOut[Seeds | None] = None
    rollouts: LeftOut[Rollouts | None] = None

    @classmethod
    def read(cls, folder: Path, counts: Sequence[int]) -> Metrics:
        """Read the ``metrics.json`` of a run.

        :param counts: the number of options of each level, lowest first.
        :raises Damaged: the file is damaged, or is about other levels.
        """
        path, remedy = folder / "metrics.json", refit(folder)
        metrics = read_record(path, cls, remedy)
        levels = [[use.choice for use in level] for level in metrics.options]
        lists: list[Sequence[Any] | None] = [metrics.divergences or None]
        if (agreement := metrics.agreement) is not None:
            lists += [agreement.labels, agreement.train, agreement.valid, agreement.confusion]
        wrong = {len(values) for values in lists if values is not None} - {len(counts)}
        if levels != [list(range(1 + count)) for count in counts] or wrong:
            number = ", ".join(map(str, counts)) or "no"
            raise Damaged(path, f"is not about levels with {number} options", remedy)
        return metrics

    def write(self, folder: Path) -> None:
        """Write ``metrics.json``."""
        write_text(folder / "metrics.json", json_text(self.model_dump()))

    @property
    def methods(self) -> dict[str, Metrics | Compared]:
        """The model itself and its baselines, by name."""
        return {self.model: self, **self.comparison}

    @property
    def trainings(self) -> dict[str, Training]:
        """The training of the model and of each baseline, by name."""
        return {name: method.training for name, method in self.methods.items()}
