"""The whole spec, what has to fit together in it, and the same spec with other values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import Field, ValidationError, model_validator

from ddco_pyro.spec.hierarchy import Baseline, HierarchySpec, LevelSpec
from ddco_pyro.spec.keypaths import edited
from ddco_pyro.spec.messages import SpecError, invalid, lines, nearest, show
from ddco_pyro.spec.settings import (
    STEP,
    ControlSpec,
    DemonstrationsSpec,
    InferenceSpec,
    Observation,
    ReportSpec,
    RolloutSpec,
    SelectionSpec,
)
from ddco_pyro.spec.training import TrainingSpec
from ddco_pyro.spec.types import Emission, Items, Model, Seed, TaskName


class Spec(Model):
    """Everything that determines a run.

    >>> spec = ddco_pyro.load_spec("mine.yaml")
    >>> spec.observations[0].key, spec.training.epochs, spec.hierarchy.levels[0].count
    ('place', 12, 2)
    """

    task: TaskName | None = None
    """Name of a registered task, or ``module:name``."""
    demonstrations: DemonstrationsSpec = DemonstrationsSpec()
    """Where the demonstrations come from."""
    observations: Items[Observation] = Field(min_length=1)
    """The observations that the networks see; a bare name stands for ``{key: name}``. ``step`` is built in: the number
    of the step divided by the steps of the longest training demonstration."""
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
    report: ReportSpec = ReportSpec()
    """What the report shows."""
    seed: Seed = 0
    """Seed of everything random that has no seed of its own."""

    @property
    def demonstrated_task(self) -> str | None:
        """Name of the task in which demonstrations are collected; None where there is only a file."""
        return self.demonstrations.task or self.task

    @property
    def observed(self) -> list[str]:
        """Names of the observations that demonstrations have to hold: all but the built-in ``step``."""
        return [observation.key for observation in self.observations if observation.key != STEP]

    @property
    def trained_with(self) -> list[str]:
        """Names of the observations that demonstrations to train with have to hold: those, and their other versions."""
        versions = (observation.augment.versions for observation in self.observations if observation.augment)
        return list(dict.fromkeys([*self.observed, *filter(None, versions)]))

    @property
    def seen(self) -> dict[str, int]:
        """By place in a file, such as ``obs/pose``: how many numbers networks see for each that is observed."""
        return {f"obs/{observation.key}": observation.seen for observation in self.observations}

    @model_validator(mode="after")
    def _mixture_alone(self) -> Spec:
        """A mixture that stands alone becomes the hierarchy that it is."""
        alone = self.baseline
        if alone is None or alone.kind != "mixture" or self.hierarchy is not None:
            return self
        if alone.count is None:
            raise invalid(("baseline.count", "missing; say how many experts the mixture has"))
        if alone.levels:
            raise invalid(("baseline.levels", "is for a mixture in compare_with; leave it out"))
        return self.model_copy(update={"hierarchy": alone.as_hierarchy, "baseline": None})

    @model_validator(mode="after")
    def _consistent(self) -> Spec:
        problems = [
            *self._choices(),
            *self._mixtures_beside(),
            *self._repeated_observations(),
            *self._nothing_observed(),
            *self._unknown_trajectory(),
            *self._nothing_held_out(),
            *self._own_optimizers(),
            *self._own_stds(),
            *self._labels_of_other_levels(),
            *self._labelled_level(),
            *self._durations(),
            *self._segments(),
        ]
        if problems:
            raise invalid(*problems)
        if self.selection.grid:
            problems = list(_grid_problems(self))
            if problems:
                raise invalid(*problems)
        return self

    def _choices(self) -> Iterator[tuple[str, str]]:
        if self.demonstrated_task is None and self.demonstrations.path is None:
            yield "task", "missing; name a task, or give a file in demonstrations.path"
        if self.hierarchy is None and self.baseline is None:
            yield "hierarchy", "missing; declare a hierarchy, or a baseline in its place"
        if self.hierarchy is not None and self.baseline is not None:
            yield "baseline", "stands beside hierarchy; keep one of them (compare_with takes baselines to train beside)"
        alone = self.baseline
        if alone and alone.kind == "flat_equal" and "hidden" not in alone.policy.model_fields_set:
            yield "baseline", "flat_equal takes its size from a hierarchy; list it in compare_with there, or say flat"

    def _mixtures_beside(self) -> Iterator[tuple[str, str]]:
        known = [level.name for level in self._levels]
        for number, baseline in enumerate(self.compare_with):
            if baseline.kind != "mixture":
                continue
            place = f"compare_with.{number}"
            if not known:
                yield place, "mixture takes its experts from a hierarchy; declare one, or leave it out"
            elif not any(level.lasts for level in self._levels):
                yield place, "mixture is what the hierarchy is already: none of its options lasts; leave it out"
            for key in ("policy", "count", "meta_policy"):
                if key in baseline.model_fields_set:
                    yield f"{place}.{key}", "a mixture in compare_with has the networks of the hierarchy; leave it out"
            for name in baseline.levels:
                if known and name not in known:
                    there = ", ".join(known)
                    yield f"{place}.levels", f"there is no level {name!r}{nearest(name, known)}; there is: {there}"

    def _nothing_held_out(self) -> Iterator[tuple[str, str]]:
        if self.compare_with and self.demonstrations.valid_fraction == 0:
            yield "compare_with", "needs demonstrations held out to compare on; raise demonstrations.valid_fraction"

    def _own_optimizers(self) -> Iterator[tuple[str, str]]:
        if self.baseline and self.baseline.optimizer:
            yield "baseline.optimizer", "is for baselines in compare_with; say it in training.optimizer"
        for number, baseline in enumerate(self.compare_with):
            if baseline.optimizer and baseline.optimizer.schedule == "cosine" and self.training.epochs is None:
                where = f"compare_with.{number}.optimizer.schedule"
                yield where, "cosine falls to 0 at the end of training.epochs, which is null"

    def _own_stds(self) -> Iterator[tuple[str, str]]:
        if self.baseline and self.baseline.std:
            yield "baseline.std", "is for baselines in compare_with; say it in control.std"
        for number, baseline in enumerate(self.compare_with):
            if baseline.std and not self.control.learned_stds:
                yield f"compare_with.{number}.std", "no σ in control is learned; say control.std: {learn: true}"

    def _labels_of_other_levels(self) -> Iterator[tuple[str, str]]:
        names = self.demonstrations.labels
        if self.hierarchy and isinstance(names, tuple) and len(names) != len(self.hierarchy.levels):
            levels = len(self.hierarchy.levels)
            yield (
                "demonstrations.labels",
                f"must have a name for each of {levels} levels, or be one name for all, got {show([*names])}",
            )

    def _labelled_level(self) -> Iterator[tuple[str, str]]:
        if self.training.labels is None:
            return
        name, names = self.training.labels.level, [level.name for level in self._levels]
        if name not in names:
            there = f"there is: {', '.join(names)}" if names else "a baseline has none; leave training.labels out"
            yield "training.labels.level", f"there is no level {name!r}{nearest(name, names)}; {there}"
        elif any("options" not in emits for emits in self._emitted[names.index(name) + 1 :]):
            yield "training.labels.level", f"nothing selects the options of {name!r}; let what is above emit options"

    def _durations(self) -> Iterator[tuple[str, str]]:
        duration, levels = self.training.duration, len(self._levels)
        if duration is None:
            return
        if not any(level.lasts for level in self._levels):
            yield "training.duration", "there are no options that last; leave it out"
        elif isinstance(duration.mean, tuple) and len(duration.mean) != levels:
            yield "training.duration.mean", f"has {len(duration.mean)} numbers, but the number of levels is {levels}"

    @property
    def _levels(self) -> tuple[LevelSpec, ...]:
        return self.hierarchy.levels if self.hierarchy else ()

    @property
    def _emitted(self) -> list[tuple[Emission, ...]]:
        """What the callers of each level emit, and the meta-policy."""
        meta_policy = [self.hierarchy.meta_policy.emits] if self.hierarchy else []
        return [*(level.policy.emits for level in self._levels), *meta_policy]

    def _segments(self) -> Iterator[tuple[str, str]]:
        if self.training.upper_levels != "segments":
            return
        for number, emits in enumerate(self._emitted[1:], start=1):
            if "options" not in emits:
                place = f"levels.{number}.policy" if number < len(self._levels) else "meta_policy"
                problem = "needs options, which training.upper_levels: segments finds by what is selected"
                yield f"hierarchy.{place}.emits", problem

    def _repeated_observations(self) -> Iterator[tuple[str, str]]:
        keys = [observation.key for observation in self.observations]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                yield f"observations.{index}.key", f"{key!r} is given twice; keep one"

    def _nothing_observed(self) -> Iterator[tuple[str, str]]:
        if not self.observed:
            yield "observations", f"{STEP} alone says nothing of the state; name an observation beside it"

    def _unknown_trajectory(self) -> Iterator[tuple[str, str]]:
        key, known = self.report.trajectory, self.observed
        if key is not None and key not in known:
            there = ", ".join(known)
            yield "report.trajectory", f"there is no observation {key!r}{nearest(key, known)}; there is: {there}"


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
                yield from ((here, f"value {show(value)}: {problem}") for problem in error.problems)


def parse_spec(data: Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Spec:
    """The spec that plain ``data`` declares, as YAML would give it, after the overrides ``{key path: value}``.

    :raises SpecError: it is not a valid spec; one line for each problem.
    """
    try:
        return Spec.model_validate(edited(data, overrides or {}))
    except ValidationError as error:
        raise SpecError(*lines(error, Spec)) from None


def with_overrides(spec: Spec, overrides: Mapping[str, Any]) -> Spec:
    """The spec with other values at some key paths, such as ``{"hierarchy.levels.0.count": 3}``.

    Another ``network`` drops the settings beside it that do not apply to it.

    :raises SpecError: a path or a value is not valid; one line for each problem.
    """
    return parse_spec(_given(spec), overrides)


def _given(spec: Spec) -> dict[str, Any]:
    """The values that were given, as plain data, without the defaults."""
    return spec.model_dump(exclude_unset=True)
