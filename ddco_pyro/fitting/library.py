"""Libraries: which model of a run is the prior of a new task's, and what strength its own tasks choose."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstrations, with_tasks
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.data.tasks import by_task, known_tasks
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.inferred import infer
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.inference.paths import predicted
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import joint_density
from ddco_pyro.spec import TASK, Spec, SpecError, load_spec, user_code, with_overrides
from ddco_pyro.spec.yaml import dump_yaml, read_mapping
from ddco_pyro.training.data import dimensions, train_and_valid
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.prior import Prior
from ddco_pyro.training.restarts import train_model

STRENGTHS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""The ridges among which the tasks of a library choose."""

MOST_TASKS = 5
"""Tasks that are left out in turn, at most."""

STORED = "library.json"
"""The file of a run with the strength that its tasks have chosen."""


def library_of(spec: Spec) -> Fit | None:
    """The model of a spec's library that has the same networks: of the run, or of one of its baselines.

    :raises BadInput: there is no such run.
    :raises SpecError: no model of the run has the same observations, control and networks.
    """
    if (given := spec.training.library) is None:
        return None
    run = load(given.run, allow_code=bool(user_code(spec)))
    models = [run, *run.baselines.values()]
    for one in models:
        if _model(one.spec) == _model(spec):
            return one
    asked = _model(spec)
    differing = [[key for key, own in asked.items() if _model(one.spec)[key] != own] for one in models]
    nearest = min(differing, key=len)
    raise SpecError(
        f"training.library.run: {given.run} has no model with this {nearest[0]}; take observations, control "
        f"and networks of {Path(given.run) / 'spec.yaml'} (ddco-pyro fit NEW.yaml --library {given.run} does)"
    )


def _model(spec: Spec) -> Mapping[str, Any]:
    """What two specs have in common where the weights of one are a prior of the other's."""
    return {key: getattr(spec, key) for key in ("observations", "control", "hierarchy", "baseline")}


def dimensions_for(spec: Spec, demos: Demonstrations | None = None) -> Dimensions:
    """The dimensions of the demonstrations that a spec names, with the kinds of control of its library.

    :raises DemonstrationsError: the library's model cannot read the demonstrations.
    """
    size, library = dimensions(spec, demos), library_of(spec)
    return size if library is None else size.like(library.hierarchy, library.place)


def check_library(spec: Spec) -> None:
    """Check, before anything is written, that a spec's library is there and that it can choose its strength.

    :raises BadInput: it is not, or it cannot.
    """
    given, library = spec.training.library, library_of(spec)
    if given is None or library is None or given.ridge is not None:
        return
    if not (library.run_folder / STORED).exists():
        _several_tasks(library)


def prior_of(spec: Spec, workers: Workers = Workers(1)) -> Prior | None:  # noqa: B008
    """The prior that a spec's library is; None without one.

    :raises BadInput: the spec leaves the strength to a library of a single task.
    """
    given, library = spec.training.library, library_of(spec)
    if given is None or library is None:
        return None
    ridge = _strength(library, given.spread, workers) if given.ridge is None else given.ridge
    return Prior(library.hierarchy, ridge, given.spread)


def for_new_task(path: Path, run: Path, overrides: Iterable[str] = (), allow_code: bool = False) -> Spec:
    """The spec of a library's run with what a file says of a new task, which trains on all demonstrations.

    :raises SpecError: the file or the run's spec cannot be read, or together they are no valid spec.
    """
    alone = {
        "compare_with": [],
        "demonstrations": {"valid_fraction": 0, "hold_out_by": None, "exclude": [], "where": {}},
        "training": {"tune_fraction": 0, "library": {"run": str(run)}},
    }
    parts = (alone, read_mapping(path, "spec"))
    said = [f"{key}={dump_yaml(value)}" for part in parts for key, value in _leaves(part)]
    return load_spec(run / "spec.yaml", [*said, *overrides], allow_code)


def _leaves(data: Mapping[str, Any], place: str = "") -> Iterable[tuple[str, Any]]:
    """The key paths in plain data, with their values."""
    for key, value in data.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value


# --- the strength that the library's tasks choose -----------------------------------------------------------


def _strength(library: Fit, spread: float, workers: Workers) -> float:
    """The ridge by which left-out tasks are imitated best from one demonstration, kept with the library.

    For each of :data:`MOST_TASKS` tasks the model is fitted without it, from the first of its starts. Each of
    :data:`STRENGTHS` then adapts that model to the task's first demonstration, and the controls of the others
    are expected. Their error decides: likelihood would judge σ, too, of which one demonstration says little.

    :raises BadInput: the demonstrations are of a single task.
    """
    kept = library.run_folder / STORED
    if kept.exists():
        return float(json.loads(kept.read_text(encoding="utf-8"))["ridge"])
    demos, tasks = _several_tasks(library)
    chosen = list(tasks)[:: math.ceil(len(tasks) / MOST_TASKS)]
    calls = {task: partial(_predicted, library.spec, demos, tasks[task], spread) for task in chosen}
    with run_all(calls, workers, "trained without a task") as found:
        errors = np.mean([values for _, values in found], axis=0)
    ridge = STRENGTHS[int(np.argmin(errors))]
    about = {"ridge": ridge, "tasks": chosen, "error": dict(zip(map(str, STRENGTHS), errors, strict=True))}
    write_text(kept, json_text(about))
    return ridge


def _several_tasks(library: Fit) -> tuple[Demonstrations, dict[str, list[str]]]:
    """The training demonstrations of a library, and their names by task, of the tasks with two or more.

    :raises BadInput: there is at most one such task.
    """
    demos = train_and_valid(library.spec, library.demonstrations)["train"]
    each = by_task({demo.name: demo.attributes for demo in demos})
    tasks = {task: names for task, names in each.items() if len(names) > 1}
    if len(tasks) < 2:
        text = f"{library.run_folder}: has demonstrations of {len(tasks)} task(s) with two or more"
        remedy = "say how strong a prior it is: training.library.ridge=30"
        raise BadInput(f"{text}, by the attribute {TASK!r}; {remedy}")
    return demos, tasks


def _predicted(spec: Spec, demos: Demonstrations, names: Sequence[str], spread: float) -> list[float]:
    """``imitation_error`` in a task's demonstrations but the first, by a library without it, by strength."""
    others = demos.select(name for name in demos.names if name not in names)
    if spec.sees_task:
        others = with_tasks(others)
        demos = with_tasks(demos, known_tasks(others.attributes))  # its own task is none of them
    spec = with_overrides(spec, {"training.starts": spec.training.starts[:1]})
    model = train_model(spec, Dimensions.of(others, spec.control.relative_to), others).hierarchy
    first, rest = demos.select(names[:1]), demos.select(names[1:])
    size = Dimensions.of(first, spec.control.relative_to).like(model, "the other tasks")
    found = []
    for ridge in STRENGTHS:
        given = {"training.library": {"run": "the other tasks", "ridge": ridge}, "training.tune_fraction": 0}
        prior = Prior(model, ridge, spread)
        adapted = train_model(with_overrides(spec, given), size, first, library=prior).hierarchy
        found.append(imitation_error(adapted, rest))
    return found


def imitation_error(model: Hierarchy, demos: Demonstrations) -> float:
    """|E[a_t | s_0..t, a_0..t-1] - a_t|, the mean over steps and control dimensions, in scaled units.

    The expectation is over options; each stands for its most likely control.
    """
    total, number = 0.0, 0
    for piece in infer(model, demos):
        actions, lengths = piece.batch.actions, piece.batch.lengths
        tables = piece.outputs.tables(actions)
        belief = predicted(tables, lengths).exp() if tables.depth else torch.ones(())
        for dim in range(actions.shape[-1]):
            pairs = zip(piece.outputs.emissions, tables.control, strict=True)
            modes = [torch.zeros_like(own) if each is None else each.mode[..., dim] for each, own in pairs]
            joint = torch.where(belief > 0, belief * joint_density(modes), 0.0)
            error = (joint.flatten(2).sum(-1) if tables.depth else joint) - actions[..., dim]
            total += float(error[piece.batch.alive].abs().sum())
        number += int(lengths.sum()) * actions.shape[-1]
    return total / number
