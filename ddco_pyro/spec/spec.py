"""The whole spec, the consistency of its parts, and specs with other values at some key paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from ddco_pyro.errors import nearest
from ddco_pyro.spec.base import Emission, Items, Model, Problems, Seed, SpecError, Text, invalid, lines, show
from ddco_pyro.spec.model import Baseline, HierarchySpec, LevelSpec
from ddco_pyro.spec.networks import foreign_keys
from ddco_pyro.spec.settings import (
    STEP,
    TASK,
    ControlSpec,
    DemonstrationsSpec,
    Observation,
    ReportSpec,
    RolloutSpec,
    SelectionSpec,
)
from ddco_pyro.spec.training import TrainingSpec

_LINEAR = ("linear", "constant")
"""The networks that EM trains."""


class Spec(Model):
    """Everything that determines a run.

    >>> spec = ddco_pyro.load_spec("mine.yaml")
    >>> spec.observations[0].key, spec.training.epochs, spec.hierarchy.levels[0].count
    ('place', 12, 2)
    """

    task: Text | None = None
    """Name of a registered task, or ``module:name``."""
    demonstrations: DemonstrationsSpec = DemonstrationsSpec()
    """Where the demonstrations come from."""
    observations: Items[Observation] = Field(min_length=1)
    """The observations that the networks read; a bare name stands for ``{key: name}``. ``step`` is built in:
    the number of the step divided by the steps of the longest training demonstration. So is ``task``: a
    number for each task of the demonstrations, 1 for the demonstration's own and 0 for the others."""
    control: ControlSpec = ControlSpec()
    """The distribution of the control."""
    hierarchy: HierarchySpec | None = None
    """Levels of options below a meta-policy; either ``hierarchy`` or ``baseline`` is given."""
    baseline: Baseline | None = None
    """A policy without options, in place of ``hierarchy``. A bare name stands for ``{kind: name}``."""
    compare_with: Items[Baseline] = ()
    """Baselines trained on the same split, for the report."""
    training: TrainingSpec = TrainingSpec()
    """How the model is trained."""
    inference: Literal["fused", "enumerate"] = "fused"
    """How latent variables are summed out: ``fused``, one compiled pass, or ``enumerate``, Pyro's
    enumeration. Both give the same numbers."""
    selection: SelectionSpec = SelectionSpec()
    """Cross-validation over a grid."""
    rollout: RolloutSpec = RolloutSpec()
    """How the fitted policy is rolled out in the task."""
    report: ReportSpec = ReportSpec()
    """What the report shows."""
    seed: Seed = 0
    """Seed of everything random that has no seed of its own."""

    @property
    def levels(self) -> tuple[LevelSpec, ...]:
        """The levels of options, lowest first; none of a policy without options."""
        return self.hierarchy.levels if self.hierarchy else ()

    @property
    def demonstrated_task(self) -> str | None:
        """Name of the task in which demonstrations are collected; None where a file is all there is."""
        return self.demonstrations.task or self.task

    @property
    def observed(self) -> list[str]:
        """Names of the observations that demonstrations must hold: all except the built-in ones."""
        named = (name for each in self.observations for name in (each.key, each.minus))
        return [*dict.fromkeys(name for name in named if name not in (None, STEP, TASK))]

    @property
    def sees_task(self) -> bool:
        """Whether a network may read the built-in observation ``task``."""
        return any(observation.key == TASK for observation in self.observations)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """EM trains linear networks by default."""
        spec, training = self, self.training
        if not (training.optimizer.name == "em" or training.takes_gradient_steps) and spec._is_linear:
            optimizer = training.optimizer.model_copy(update={"name": "em"})
            spec = spec.model_copy(update={"training": training.model_copy(update={"optimizer": optimizer})})
        if problems := list(spec.problems()) or list(_grid_problems(spec)):
            raise invalid(*problems)
        return spec

    @property
    def _is_linear(self) -> bool:
        """Whether every network is declared ``linear`` or ``constant``."""
        if self.hierarchy is None:
            baseline = self.baseline
            return baseline is not None and baseline.kind == "flat" and baseline.policy.network in _LINEAR
        linear = all(network.network in _LINEAR for network in self.hierarchy.networks.values())
        return linear and self.hierarchy.trunk is None

    def problems(self) -> Problems:
        checks = (self._choices, self._baselines, self._observed, self._labelled, self._segments)
        return (problem for check in checks for problem in check())

    def _choices(self) -> Problems:
        if self.demonstrated_task is None and self.demonstrations.path is None:
            yield "task", "missing; name a task, or give a file in demonstrations.path"
        if self.hierarchy is None and self.baseline is None:
            yield "hierarchy", "missing; declare a hierarchy, or a baseline in its place"
        if self.hierarchy is not None and self.baseline is not None:
            text = "stands beside hierarchy; keep one of the two (compare_with takes baselines to compare)"
            yield "baseline", text
        baseline = self.baseline
        if baseline and baseline.kind == "mixture":
            text = "mixture takes its experts from a hierarchy; declare one, with termination: always"
            yield "baseline", text
        if baseline and baseline.kind == "flat_equal" and "hidden" not in baseline.policy.model_fields_set:
            text = "flat_equal takes its size from a hierarchy; list it in compare_with there, or say flat"
            yield "baseline", text
        if baseline and baseline.optimizer:
            yield "baseline.optimizer", "is for baselines in compare_with; give it in training.optimizer"
        if baseline and baseline.std:
            yield "baseline.std", "is for baselines in compare_with; give it in control.std"

    def _baselines(self) -> Problems:
        known = [level.name for level in self.levels]
        for number, baseline in enumerate(self.compare_with):
            place, optimizer = f"compare_with.{number}", baseline.optimizer
            if optimizer and optimizer.schedule == "cosine" and self.training.epochs is None:
                yield f"{place}.optimizer.schedule", "cosine ends at training.epochs, which is null"
            if baseline.std and not self.control.learned_stds:
                yield f"{place}.std", "no σ in control is learned; say control.std: {learn: true}"
            if baseline.kind != "mixture":
                continue
            if not known:
                yield place, "mixture takes its experts from a hierarchy; declare one, or leave it out"
            elif not any(level.lasts for level in self.levels):
                yield place, "the hierarchy is a mixture already: none of its options lasts; leave it out"
        if self.compare_with and not self.demonstrations.validates:
            text = "needs held-out demonstrations to compare on; raise demonstrations.valid_fraction"
            yield "compare_with", text

    def _observed(self) -> Problems:
        keys = [observation.name for observation in self.observations]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                yield f"observations.{index}.key", f"{key!r} is given twice; keep one"
        if not self.observed:
            text = f"{' and '.join(keys)} alone says nothing about the state; name an observation beside it"
            yield "observations", text
        named = [("report.trajectory", path.key) for path in self.report.trajectory or ()]
        named += [("control.relative_to", self.control.relative_to)] if self.control.relative_to else []
        for place, key in dict.fromkeys(named):
            if key not in self.observed:
                there = ", ".join(self.observed)
                text = f"there is no observation {key!r}{nearest(key, self.observed)}; there is: {there}"
                yield place, text

    def _labelled(self) -> Problems:
        names, known = self.demonstrations.labels, [level.name for level in self.levels]
        if known and isinstance(names, tuple) and len(names) != len(known):
            text = f"must have a name for each of {len(known)} levels, or be one name for all"
            yield "demonstrations.labels", f"{text}, got {show([*names])}"
        if self.training.labels is None:
            return
        name = self.training.labels.level
        if not known:
            text = f"there is no level {name!r}; a baseline has none; leave training.labels out"
            yield "training.labels.level", text
        elif name not in known:
            text = f"there is no level {name!r}{nearest(name, known)}; there is: {', '.join(known)}"
            yield "training.labels.level", text
        elif any("options" not in emits for emits in self._emitted[known.index(name) + 1 :]):
            text = f"no policy selects the options of {name!r}; let the policies above emit options"
            yield "training.labels.level", text

    def _segments(self) -> Problems:
        if self.training.layerwise != "segments":
            return
        for number, emits in enumerate(self._emitted[1:], start=1):
            if "options" not in emits:
                place = f"levels.{number}.policy" if number < len(self.levels) else "meta_policy"
                yield f"hierarchy.{place}.emits", "training.layerwise: segments needs options here"

    @property
    def _emitted(self) -> list[tuple[Emission, ...]]:
        """The choices that the policies of each level, and last the meta-policy, emit."""
        meta_policy = [self.hierarchy.meta_policy.emits] if self.hierarchy else []
        return [*(level.policy.emits for level in self.levels), *meta_policy]


def _grid_problems(spec: Spec) -> Problems:
    """The problems of the spec with each single value of its grid."""
    data = _given(spec)
    for path, values in spec.selection.grid.items():
        here = f"selection.grid.{path}"
        if path.partition(".")[0] == "selection":
            yield here, "the selection cannot be part of its own grid; remove it"
            continue
        if path == "control.relative_to":
            yield here, "decides what the control is, for all candidates; remove it"
            continue
        for value in values:
            try:
                parse_spec(data, {"selection.grid": {}, path: value})
            except SpecError as error:
                yield from ((here, f"value {show(value)}: {problem}") for problem in error.problems)


def parse_spec(data: Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Spec:
    """The spec in plain ``data``, such as YAML gives, after the overrides ``{key path: value}``.

    >>> parse_spec({"task": "needle", "observations": ["pose"], "baseline": "flat"}, {"seed": 3}).seed
    3

    :raises SpecError: the spec is invalid; one line for each problem.
    """
    try:
        return Spec.model_validate(edited(data, overrides or {}))
    except ValidationError as error:
        raise SpecError(*lines(error, Spec)) from None


def with_overrides(spec: Spec, overrides: Mapping[str, Any]) -> Spec:
    """The spec with other values at some key paths, such as ``{"hierarchy.levels.0.count": 3}``.

    Another ``network`` removes the settings beside it that do not apply to it.

    :raises SpecError: a path or a value is invalid; one line for each problem.
    """
    return parse_spec(_given(spec), overrides)


def _given(spec: Spec) -> dict[str, Any]:
    return spec.model_dump(exclude_unset=True)


# --- key paths in plain data --------------------------------------------------------------------------------

_GRID = "selection.grid."
MODEL = "model"
"""The key path that stands for the whole model."""

OPTIONS = "options"
"""The value of :data:`MODEL` that keeps the hierarchy."""

_BARE = {"observations": "key", "baseline": "kind", "compare_with": "kind"}


def edited(data: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain data with other values at some key paths.

    Another ``network`` removes the settings beside it that do not apply to it, unless ``values`` has them
    too. The key path ``model`` replaces the whole model by a baseline as in ``compare_with``, a list of
    levels, or a hierarchy; ``options`` keeps the hierarchy.

    :raises SpecError: a key path leads nowhere.
    """
    copy: dict[str, Any] = plain(data)
    for path, value in plain(values).items():
        if path == MODEL:
            _set_model(copy, value)
            continue
        node, last = _find(copy, path)
        node[last] = value
        if path.endswith(".network") and isinstance(value, str):
            for key in foreign_keys(value):
                if path.removesuffix(last) + key not in values:
                    node.pop(key, None)
    return copy


def _set_model(data: dict[str, Any], value: Any) -> None:
    """Replace the model; labels stay where the new model has options for them."""
    if value == OPTIONS:
        return
    hierarchy = data.get("hierarchy") or {}
    if isinstance(value, list):
        data["hierarchy"] = {**hierarchy, "levels": value}
    elif isinstance(value, dict) and "kind" not in value:
        data["hierarchy"] = value
    elif not isinstance(value, str | dict):
        what = "options, a baseline such as flat or mixture, a list of levels, or a hierarchy"
        raise SpecError(f"{MODEL}: must be {what}, got {show(value)}")
    else:
        baseline = {"kind": value} if isinstance(value, str) else value
        data["compare_with"] = []
        levels = hierarchy.get("levels") or []
        if baseline["kind"] == "mixture" and levels:
            for level in levels:
                level["termination"] = "always"
        else:
            data |= {"hierarchy": None, "baseline": baseline}
            (data.get("training") or {}).pop("labels", None)


def plain(data: Any) -> Any:
    """A deep copy of plain data: dicts for mappings, lists for sequences, Python's numbers for numpy's."""
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    data = data.tolist() if hasattr(data, "tolist") else data
    return [plain(value) for value in data] if isinstance(data, list | tuple) else data


def _find(data: dict[str, Any], path: str) -> tuple[Any, Any]:
    """The mapping or list that holds the value at a key path, and its key there. Makes missing mappings."""
    parts = path.split(".")
    if path.startswith(_GRID):  # keys of the grid contain dots
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
            text = f"cannot be set, because {parent} is {show(node[key])}; set the whole of {parent}"
            raise SpecError(f"{path}: {text}")
        node = node[key]
    return node, _key(node, parts[-1], path)


def _key(node: Any, part: str, path: str) -> Any:
    if isinstance(node, dict):
        return part
    if part.isdecimal() and int(part) < len(node):
        return int(part)
    text = f"{part!r} is not the number of one of the {len(node)} items there (the first is 0)"
    raise SpecError(f"{path}: {text}")
