"""The declarative spec: YAML in, one frozen and fully validated :class:`Spec` out. Nothing else reads YAML.

An unknown key, a wrong type or a value out of range is a :class:`SpecError` with one line for each problem.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from ddco_pyro.errors import BadInput


class SpecError(BadInput):
    """A spec that cannot be used. The message has one line for each problem; ``problems`` has them apart."""

    def __init__(self, *problems: str) -> None:
        super().__init__(*problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


T = TypeVar("T")
Items = Annotated[tuple[T, ...], Field(strict=False)]  # strict would refuse the lists that YAML gives
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Share = Annotated[float, Field(ge=0, lt=1)]
Text = Annotated[str, Field(min_length=1)]
Emission = Literal["options", "control"]


class _Model(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def _problems(*found: tuple[str, str]) -> PydanticCustomError:
    """An error for keys below the one that a validator validates: ``(key path from there, what is wrong)``."""
    return PydanticCustomError("spec", "the spec has problems", {"problems": found})


# --- networks ---------------------------------------------------------------------------------------------------------

CUSTOM = "module:Class"
NETWORK_KEYS: dict[str, tuple[str, ...]] = {
    "linear": (),
    "mlp": ("hidden", "dropout"),
    "per_timestep": ("hidden", "dropout"),
    "conv": ("hidden", "dropout", "filters", "kernel"),
    CUSTOM: ("options",),
}
_SETTINGS = ("hidden", "dropout", "filters", "kernel", "options")


def _foreign_keys(network: Any) -> tuple[str, ...]:
    """The settings that do not apply to a network of this kind."""
    known = NETWORK_KEYS.get(network, NETWORK_KEYS[CUSTOM]) if isinstance(network, str) else _SETTINGS
    return tuple(key for key in _SETTINGS if key not in known)


class NetworkSpec(_Model):
    """A network from observations to the parameters of a distribution. Settings of other networks are refused."""

    network: str = "mlp"
    """``linear``, ``mlp``, ``per_timestep``, ``conv``, or ``module:Class`` for a network of your own."""
    hidden: Items[Count] = Field(
        default_factory=lambda data: () if "hidden" in _foreign_keys(data.get("network")) else (64,)
    )
    """Sizes of the hidden layers, first one first (``mlp``, ``per_timestep`` and ``conv``; default [64])."""
    dropout: Share = 0.0
    """Probability with which a unit is dropped while training."""
    filters: Count = 64
    """Number of filters of each convolution (``conv``)."""
    kernel: Count = 5
    """Height and width of each filter in pixels (``conv``)."""
    options: dict[str, Any] = {}
    """Keyword arguments of the class (``module:Class``)."""

    @field_validator("network")
    @classmethod
    def _known_network(cls, name: str) -> str:
        if name == CUSTOM or (name not in NETWORK_KEYS and not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", name)):
            names = ", ".join(NETWORK_KEYS)
            raise _problems(("", f"no network is called {name!r}{_nearest(name, NETWORK_KEYS)}; use one of {names}"))
        return name

    @model_validator(mode="after")
    def _settings_apply(self) -> NetworkSpec:
        given = [key for key in _foreign_keys(self.network) if key in self.model_fields_set]
        if given:
            raise _problems(*((key, f"does not apply to network {self.network!r}; leave it out") for key in given))
        return self

    @model_serializer(mode="wrap")
    def _without_foreign_keys(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = serialize(self)
        return {key: value for key, value in fields.items() if key not in _foreign_keys(self.network)}


class PolicySpec(NetworkSpec):
    """The policy of a level: it emits the control (lowest level) or selects from the level below."""

    emits: Items[Emission] = Field(default=(), min_length=1)
    """What the policy chooses: ``[control]`` at the lowest level (filled in), above it ``options`` (the default),
    ``control``, or both for a hybrid policy."""

    @field_validator("emits")
    @classmethod
    def _distinct(cls, emits: tuple[Emission, ...]) -> tuple[Emission, ...]:
        for name, times in Counter(emits).items():
            if times > 1:
                raise _problems(("", f"{name!r} is given twice; keep one"))
        return emits


class MetaPolicySpec(PolicySpec):
    """The policy at the top, η: it selects from the highest level."""

    emits: Items[Emission] = Field(default=("options",), min_length=1)
    """What the meta-policy chooses: ``options``, ``control``, or both for a hybrid policy."""


# --- model ------------------------------------------------------------------------------------------------------------


class LevelSpec(_Model):
    """One level of options."""

    name: str = Field(default="option", pattern=r"^[A-Za-z][\w-]*$")
    """Name of the level in reports and files; letters, digits, ``_`` and ``-``, a letter first."""
    count: Count
    """Number of options, k."""
    policy: PolicySpec = PolicySpec()
    """The options' policies, π: one network for each option."""
    termination: NetworkSpec = NetworkSpec(network="linear")
    """The options' termination conditions, ψ: one network for each option."""


class HierarchySpec(_Model):
    """Levels of options below a meta-policy."""

    levels: Items[LevelSpec] = Field(min_length=1)
    """The levels, lowest first."""
    meta_policy: MetaPolicySpec = MetaPolicySpec()
    """The policy that selects from the highest level, η."""

    @field_validator("levels")
    @classmethod
    def _consistent(cls, levels: tuple[LevelSpec, ...]) -> tuple[LevelSpec, ...]:
        problems = []
        first: dict[str, int] = {}
        for index, level in enumerate(levels):
            if level.name in first:
                text = f"{level.name!r} is also the name of level {first[level.name]}; give each level its own"
                problems.append((f"{index}.name", text))
            first.setdefault(level.name, index)
        if levels[0].policy.emits not in ((), ("control",)):
            problems.append(("0.policy.emits", "the lowest level emits the control and nothing else; leave it out"))
        if problems:
            raise _problems(*problems)
        return tuple(_with_emission(level, "options" if index else "control") for index, level in enumerate(levels))


def _with_emission(level: LevelSpec, default: Emission) -> LevelSpec:
    emits = level.policy.emits or (default,)
    return level.model_copy(update={"policy": level.policy.model_copy(update={"emits": emits})})


Kind = Literal["flat", "per_timestep"]


class BaselineSpec(_Model):
    """A policy without options, trained by behaviour cloning."""

    kind: Kind
    """``flat``: one policy for all times; ``per_timestep``: one policy for each time step."""
    policy: NetworkSpec = NetworkSpec()
    """The policy's network, π."""


def _bare(key: str, allowed: Any) -> BeforeValidator:
    """Reads a bare string as ``{key: that}``; ``allowed`` is the type that the JSON Schema shows."""
    return BeforeValidator(
        lambda value: {key: value} if isinstance(value, str) else value, json_schema_input_type=allowed
    )


Baseline = Annotated[BaselineSpec, _bare("kind", Kind | BaselineSpec)]

# --- data and control -------------------------------------------------------------------------------------------------


class DemonstrationsSpec(_Model):
    """Where the demonstrations come from: a file, or the task's supervisor."""

    path: Text | None = None
    """HDF5 file in robomimic's layout; without it they are collected in the task."""
    task: Text | None = None
    """Task in which they are collected, such as one whose episodes are single demonstrations; null: the spec's own."""
    count: int = Field(default=100, ge=2)
    """Number of demonstrations to collect."""
    seed: Seed = 0
    """Seed of the first collected episode."""
    supervisor: Text = "supervisor"
    """Which of the task's scripted policies is recorded."""
    valid_fraction: Fraction = 0.1
    """Part of the demonstrations held out for validation, where the file has no ``mask/valid``."""
    labels: Text | None = None
    """Name of ground-truth labels in the file; the discovered options are compared with them (NMI)."""


class ObservationSpec(_Model):
    """One observation that the networks see."""

    key: Text
    """Name of the observation in the demonstrations."""
    differences: bool = False
    """Append x_t − x_{t−1}."""
    standardize: bool = True
    """Shift and scale to mean 0 and standard deviation 1 over the training demonstrations."""


Observation = Annotated[ObservationSpec, _bare("key", str | ObservationSpec)]


class LearnedStd(_Model):
    """A standard deviation that is learned, one for each level and control dimension."""

    learn: Literal[True]
    """Always true; for a fixed standard deviation give a number instead of this mapping."""
    floor: Positive = 0.01
    """Lower bound, in scaled units."""


_STD = "<a positive number or {learn: true}>"
_STD_LEARNED = "<>"
_SCALE_NAME = "<standardize, none, or a list of positive numbers>"
_SCALE_SIZES = "<>"


class ControlSpec(_Model):
    """The distribution of the control, a_t ~ N(π(s_t), σ²)."""

    std: Annotated[
        Annotated[Positive, Tag(_STD)] | Annotated[LearnedStd, Tag(_STD_LEARNED)],
        Discriminator(lambda value: _STD_LEARNED if isinstance(value, Mapping | LearnedStd) else _STD),
    ] = 0.1
    """Standard deviation σ in scaled units, or ``{learn: true, floor: ...}``."""
    scale: Annotated[
        Annotated[Literal["standardize", "none"], Tag(_SCALE_NAME)]
        | Annotated[Items[Positive], Field(min_length=1), Tag(_SCALE_SIZES)],
        Discriminator(
            lambda value: _SCALE_SIZES if isinstance(value, Sequence) and not isinstance(value, str) else _SCALE_NAME
        ),
    ] = "standardize"
    """``standardize`` (by the training demonstrations), ``none``, or one positive number for each control dimension,
    by which it is divided."""


# --- training and evaluation ------------------------------------------------------------------------------------------


class OptimizerSpec(_Model):
    """The optimiser of the expectation-gradient steps."""

    name: Literal["adam", "momentum"] = "adam"
    """``adam``, or ``momentum`` for gradient descent with momentum."""
    lr: Positive = 1e-3
    """Learning rate."""
    momentum: Share = 0.9
    """Momentum (``momentum`` only)."""
    weight_decay: float = Field(default=0.0, ge=0)
    """L2 penalty."""


class TrainingSpec(_Model):
    """How the model is trained."""

    initialize: Literal["vq", "vq_controls", "random"] = "vq"
    """``vq``: by vector quantisation of the observations (SM 2.2); ``vq_controls``: of observations and controls;
    ``random``: random weights."""
    layerwise: bool = True
    """Discover level after level, lowest first, rather than all at once."""
    lower_levels: Literal["fine_tuned", "frozen"] = "fine_tuned"
    """Layer-wise training: whether a last stage trains all levels together, or what was discovered stays as it is."""
    optimizer: OptimizerSpec = OptimizerSpec()
    """The optimiser."""
    epochs: Count = 200
    """Passes over the training demonstrations in each stage, at most."""
    batch_size: Count = 16
    """Trajectories in each gradient step."""
    restarts: Count = 1
    """Independent initialisations; the best on the tuning demonstrations is kept."""
    tune_fraction: Fraction = 0.1
    """Part of the training demonstrations held out to stop early and to choose among restarts."""
    patience: Count | None = 20
    """Epochs without improvement before a stage stops; null for never."""
    clip_gradient: Positive | None = None
    """Largest norm of a gradient; null for no limit."""


class InferenceSpec(_Model):
    """How the latent variables are eliminated."""

    engine: Literal["fused", "enumerate"] = "fused"
    """``fused``: in one compiled pass; ``enumerate``: Pyro's enumeration. Both give the same numbers."""


class SelectionSpec(_Model):
    """Cross-validation over a grid."""

    folds: int = Field(default=10, ge=2)
    """Number of folds."""
    grid: dict[str, Annotated[Items[Any], Field(min_length=1)]] = {}
    """Key path of this spec to the values to try there."""


class RolloutSpec(_Model):
    """How the fitted policy is tried in the task."""

    episodes: Count = 50
    """Number of episodes."""
    seed: Seed = 1000
    """Seed of the first episode; the next ones count up from it."""
    control: Literal["mean", "sample"] = "mean"
    """Whether the control is the mean of its distribution or a sample."""
    options: Literal["sample", "most_likely"] = "sample"
    """Whether options and terminations are sampled or the most likely ones."""
    policies: Items[Text] = ()
    """Scripted policies of the task that are rolled out beside, such as ``open_loop``."""


class Spec(_Model):
    """Everything that determines a run."""

    task: Text | None = None
    """Name of a registered task, or ``module:name``."""
    demonstrations: DemonstrationsSpec = DemonstrationsSpec()
    """Where the demonstrations come from."""
    observations: Items[Observation] = Field(min_length=1)
    """The observations that the networks see; a bare name stands for ``{key: name}``."""
    control: ControlSpec = ControlSpec()
    """The distribution of the control."""
    hierarchy: HierarchySpec | None = None
    """Levels of options below a meta-policy; either this or ``baseline``."""
    baseline: Baseline | None = None
    """A policy without options; either this or ``hierarchy``. A bare name stands for ``{kind: name}``."""
    compare_with: Items[Baseline] = ()
    """Baselines trained beside on the same split, for the report."""
    training: TrainingSpec = TrainingSpec()
    """How the model is trained."""
    inference: InferenceSpec = InferenceSpec()
    """How the latent variables are eliminated."""
    selection: SelectionSpec = SelectionSpec()
    """Cross-validation over a grid."""
    rollout: RolloutSpec = RolloutSpec()
    """How the fitted policy is tried in the task."""
    seed: Seed = 0
    """Seed of everything random that has no seed of its own."""

    @property
    def demonstrated_task(self) -> str | None:
        """Name of the task in which demonstrations are collected; None where there is only a file."""
        return self.demonstrations.task or self.task

    @model_validator(mode="after")
    def _consistent(self) -> Spec:
        problems = [*self._choices(), *self._repeated_observations()]
        if problems:
            raise _problems(*problems)
        if self.selection.grid:
            problems = list(_grid_problems(self))
            if problems:
                raise _problems(*problems)
        return self

    def _choices(self) -> Iterator[tuple[str, str]]:
        if self.demonstrated_task is None and self.demonstrations.path is None:
            yield "task", "missing; name a task, or give a file in demonstrations.path"
        if self.hierarchy is None and self.baseline is None:
            yield "hierarchy", "missing; declare a hierarchy, or a baseline in its place"
        if self.hierarchy is not None and self.baseline is not None:
            yield "baseline", "stands beside hierarchy; keep one of them (compare_with takes baselines to train beside)"

    def _repeated_observations(self) -> Iterator[tuple[str, str]]:
        keys = [observation.key for observation in self.observations]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                yield f"observations.{index}.key", f"{key!r} is given twice; keep one"


def _grid_problems(spec: Spec) -> Iterator[tuple[str, str]]:
    """Applies every value of the grid by itself; what the spec then complains about is what is wrong with the value."""
    data = _given(spec)
    del data["selection"]["grid"]
    for path, values in spec.selection.grid.items():
        here = f"selection.grid.{path}"
        if path.partition(".")[0] == "selection":
            yield here, "the selection cannot be part of its own grid; remove it"
            continue
        for value in values:
            try:
                parse_spec(data, {path: value})
            except SpecError as error:
                yield from ((here, f"value {_show(value)}: {problem}") for problem in error.problems)


# --- reading and writing ----------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """Reads ``1e-3`` as a number, as YAML 1.2 does, and refuses a key given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key.value!r} is given twice", key.start_mark)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """Quotes the text that :class:`_Loader` would read as a number; repeats what is shared rather than use anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$|[-+]?\.[0-9]+$")
for _yaml in (_Loader, _Dumper):
    _yaml.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def load_spec(path: str | Path, overrides: Iterable[str] = ()) -> Spec:
    """The spec in a YAML file, after ``overrides`` such as ``"hierarchy.levels.0.count=3"`` (the value is YAML).

    :raises SpecError: the file cannot be read, is not YAML, or is not a valid spec; one line for each problem.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    try:
        data = _read_yaml(content)
        if data is None:
            raise SpecError("the file is empty; it has to hold a spec")
        if not isinstance(data, dict):
            raise SpecError(f"the file holds {_show(data)}, not a mapping (key: value)")
        return parse_spec(data, dict(_parse_override(text) for text in overrides))
    except SpecError as error:
        raise SpecError(*(f"{path}: {problem}" for problem in error.problems)) from None


def parse_spec(data: Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Spec:
    """The spec that plain ``data`` declares, as YAML would give it, after the overrides ``{key path: value}``.

    :raises SpecError: it is not a valid spec; one line for each problem.
    """
    overrides = overrides or {}
    edited = _copy(data)
    for path, value in overrides.items():
        _set(edited, path, value)
        if path.endswith(".network"):
            _drop_foreign_keys(edited, path, keep=overrides)
    try:
        return Spec.model_validate(edited)
    except ValidationError as error:
        raise SpecError(*_lines(error)) from None


def with_overrides(spec: Spec, overrides: Mapping[str, Any]) -> Spec:
    """The spec with other values at some key paths, such as ``{"hierarchy.levels.0.count": 3}``.

    Another ``network`` drops the settings beside it that do not apply to it.

    :raises SpecError: a path or a value is not valid; one line for each problem.
    """
    return parse_spec(_given(spec), overrides)


def dump_spec(spec: Spec) -> str:
    """The spec as YAML with every default written out. Reading it again gives an equal spec."""
    return yaml.dump(
        spec.model_dump(), Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120
    )


def spec_schema() -> dict[str, Any]:
    """The JSON Schema of a spec file, for editors."""
    schema = Spec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ddco-pyro spec"}


def _read_yaml(content: bytes | str) -> Any:
    try:
        return _copy(yaml.load(content, Loader=_Loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise SpecError(f"{where}not valid YAML: {error.problem or error.context}") from None
    except RecursionError:
        raise SpecError("not valid YAML: nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # not text, or a date or number that Python cannot hold
        raise SpecError(f"not valid YAML: {' '.join(str(error).split())}") from None


def _parse_override(text: str) -> tuple[str, Any]:
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise SpecError(f"override {text!r}: write it as key.path=value")
    try:
        return path.strip(), _read_yaml(value)
    except SpecError as error:
        raise SpecError(f"override {text!r}: {error}") from None


def _given(spec: Spec) -> dict[str, Any]:
    """The values that were given, as plain data, without the defaults."""
    return spec.model_dump(exclude_unset=True)


def _copy(data: Any) -> Any:
    """A copy of plain data whose mappings and sequences can be edited."""
    if isinstance(data, Mapping):
        return {key: _copy(value) for key, value in data.items()}
    return [_copy(value) for value in data] if isinstance(data, list | tuple) else data


_GRID = "selection.grid."
_BARE = {"observations": "key", "baseline": "kind", "compare_with": "kind"}


def _set(data: dict[str, Any], path: str, value: Any) -> None:
    """Sets the value at a key path of plain data; mappings that are missing on the way are made."""
    node, last = _find(data, path)
    node[last] = value


def _drop_foreign_keys(data: dict[str, Any], path: str, keep: Container[str]) -> None:
    """Removes the settings beside the network at ``path`` that belong to another kind of network."""
    node, last = _find(data, path)
    for key in _foreign_keys(node[last]):
        if path.removesuffix(last) + key not in keep:
            node.pop(key, None)


def _find(data: dict[str, Any], path: str) -> tuple[Any, Any]:
    """The mapping or list that holds what a key path leads to, and its key there."""
    parts = path.split(".")
    if path.startswith(_GRID):  # the keys of the grid have dots themselves
        parts = [*_GRID.split(".")[:-1], path.removeprefix(_GRID)]
    node: Any = data
    for depth, part in enumerate(parts[:-1]):
        key = _key(node, part, path)
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        if isinstance(node[key], str) and parts[0] in _BARE:
            node[key] = {_BARE[parts[0]]: node[key]}
        if not isinstance(node[key], dict | list):
            parent = ".".join(parts[: depth + 1])
            raise SpecError(f"{path}: cannot be set, because {parent} is {_show(node[key])}; set the whole of {parent}")
        node = node[key]
    return node, _key(node, parts[-1], path)


def _key(node: Any, part: str, path: str) -> Any:
    """The key ``part`` of a mapping, or the index ``part`` of a list."""
    if isinstance(node, dict):
        return part
    if part.isdecimal() and int(part) < len(node):
        return int(part)
    raise SpecError(f"{path}: {part!r} is not the number of one of the {len(node)} items there (the first is 0)")


# --- messages ---------------------------------------------------------------------------------------------------------

_MESSAGES = {
    "literal_error": "must be {names}",
    "missing": "missing; it has to be given",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "string_type": "must be text",
    "bool_type": "must be true or false",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping (key: value)",
    "model_type": "must be a mapping (key: value)",
    "invalid_key": "a key must be text; put it in quotes",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "too_short": "must have at least {min_length} item(s)",
    "string_too_short": "must not be empty",
    "string_pattern_mismatch": "must be letters, digits, '_' or '-', a letter first",
}


def _lines(error: ValidationError) -> Iterator[str]:
    """One line for each problem that pydantic found."""
    errors = error.errors()
    for detail in errors:
        if not _follows_from_another(detail, errors):
            yield from _lines_of(detail)


def _follows_from_another(error: ErrorDetails, errors: list[ErrorDetails]) -> bool:
    """A list is "too short" also when its items are not valid; a default may depend on a value that is not valid."""
    depth = len(error["loc"])
    below = any(other["loc"][:depth] == error["loc"] and len(other["loc"]) > depth for other in errors)
    return error["type"] == "default_factory_not_called" or (error["type"] == "too_short" and below)


def _lines_of(error: ErrorDetails) -> Iterator[str]:
    parts = [str(part) for part in error["loc"]]
    allowed = "".join(part[1:-1] for part in parts if re.fullmatch("<.+>", part))
    parts = [part for part in parts if part != "[key]" and not re.fullmatch("<.*>", part)]
    path = ".".join(parts)
    if error["type"] == "spec":
        for below, text in error["ctx"]["problems"]:
            yield f"{'.'.join(filter(None, [path, below]))}: {text}"
    elif error["type"] == "extra_forbidden":
        yield f"{path}: unknown key; {_suggestion(parts)}"
    else:
        yield f"{path or 'spec'}: {_text(error, allowed)}"


def _text(error: ErrorDetails, allowed: str) -> str:
    """What is wrong in words; ``allowed`` is what the key takes where it takes more than one type."""
    kind = "invalid_key" if "[key]" in error["loc"] else error["type"]
    context = {
        key: f"{value:.15g}" if isinstance(value, float) else value for key, value in error.get("ctx", {}).items()
    }
    names = re.findall(r"'([^']*)'", context.get("expected", ""))
    context["names"] = " or ".join(names) or "true"
    expected = f"must be {allowed}" if allowed else _MESSAGES.get(kind, error["msg"]).format(**context)
    return (
        expected if kind == "missing" else f"{expected}, got {_show(error['input'])}{_nearest(error['input'], names)}"
    )


def _show(value: Any) -> str:
    """A value as the user may have written it, cut short."""
    text = {None: "null", True: "true", False: "false"}.get(value) if value is None or isinstance(value, bool) else None
    text = text or repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _nearest(given: Any, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(given), list(names), n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _suggestion(parts: list[str]) -> str:
    """The valid key nearest to an unknown one: beside it, or of the same name elsewhere; else all that are valid."""
    *above, wrong = parts
    valid = [key for model in _models_at(above) for key in model.model_fields]
    close = difflib.get_close_matches(wrong, valid, n=1)
    if close:
        return f"did you mean {'.'.join([*above, close[0]])}?"
    elsewhere = [path for path in _all_paths(Spec) if path.rpartition(".")[2] == wrong]
    if elsewhere:
        return f"did you mean {elsewhere[0]}?"
    return f"valid here: {', '.join(valid)}"


def _models_at(parts: list[str]) -> list[type[BaseModel]]:
    """The models that a key path leads to."""
    models: list[type[BaseModel]] = [Spec]
    for part in parts:
        if not part.isdecimal():
            fields = [model.model_fields[part] for model in models if part in model.model_fields]
            models = [found for field in fields for found in _models_in(field.annotation)]
    return models


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in a type such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _all_paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every key path below a model, with 0 for the place in a list."""
    for name, field in model.model_fields.items():
        yield prefix + name
        place = ".0" if get_origin(field.annotation) is tuple else ""
        for inner in _models_in(field.annotation):
            yield from _all_paths(inner, f"{prefix}{name}{place}.")
