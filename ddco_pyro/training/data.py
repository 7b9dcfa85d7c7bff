"""The demonstrations that a spec names, and their shapes before any work starts."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ddco_pyro.data.arrays import is_picture, network_input, refuse_too_much
from ddco_pyro.data.demonstration import Demonstration, check, needed
from ddco_pyro.data.demonstrations import (
    Demonstrations,
    check_trained,
    with_labels_of_tasks,
    with_tasks,
    with_values,
)
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.sources import open_own
from ddco_pyro.data.tasks import chosen, known_tasks
from ddco_pyro.data.tensors import read_tensors
from ddco_pyro.errors import nearest
from ddco_pyro.events import OnEvent, ignore
from ddco_pyro.simulation.collect import cache_path, collect
from ddco_pyro.simulation.task import find_task
from ddco_pyro.spec import Spec
from ddco_pyro.training.networks import Dimensions, check_networks
from ddco_pyro.training.optimizers import optimizer_of


def dimensions(spec: Spec, demos: Demonstrations | None = None) -> Dimensions:
    """The dimensions of the demonstrations that a spec names, without collecting any.

    They are read from the headers of the spec's file, or else from its task. A task whose episodes have no
    fixed length counts as one step. A task's control is described where demonstrations are there already.

    :param demos: the demonstrations, where they have been read.
    """
    if demos is None and in_file(spec):
        demos = outline(spec)
    if demos is not None:
        return Dimensions.of(demos, spec.control.relative_to)
    assert spec.demonstrated_task is not None  # or they would be in a file
    task = find_task(spec.demonstrated_task)
    environment = task.watched(spec.demonstrations.seed, spec.observed)
    try:
        shapes = {name: tuple(array.shape) for name, array in environment.observation_spec().items()}
        size = Dimensions(shapes, environment.action_spec().shape[0], task.steps)
    finally:
        environment.close()
    sought = spec.demonstrations
    file = sought.file or cache_path(task, spec.demonstrated_task, sought, spec.observed)
    if not file.exists():
        return size
    known = Demonstrations.read(file, _measured(spec), (), sought.exclude, sought.where)
    collected = Dimensions.of(known, spec.control.relative_to)
    return replace(size, constant=collected.constant, control=collected.control)


def train_and_valid(spec: Spec, demos: Demonstrations) -> dict[str, Demonstrations]:
    """The demonstrations to train with, ``train``, and the held-out ones, ``valid``, where there are any.

    :raises DemonstrationsError: one part is empty, or masks overlap.
    """
    if spec.demonstrations.holds_out_each:
        return {"train": demos, "valid": demos}
    if spec.demonstrations.valid_fraction == 0 and not demos.masks.keys() & {"train", "valid"}:
        return {"train": demos}
    train, valid = demos.split(spec.demonstrations.valid_fraction, spec.seed)
    return {"train": train, "valid": valid}


def tuning_split(
    spec: Spec, dimensions: Dimensions, train: Demonstrations
) -> tuple[Demonstrations, Demonstrations]:
    """The training demonstrations of a model in those that it is fitted to, and those that it is tuned by.

    With ``training.tune_fraction: 0`` both are all of them where EM trains the model or a library is its
    prior, which needs no early stopping. A mask ``tune`` names those that it is tuned by, in place of a draw.
    """
    fraction = spec.training.tune_fraction
    if fraction == 0:
        optimizer = optimizer_of(spec.training.optimizer, check_networks(spec, dimensions))
        if optimizer == "em" or spec.training.library is not None:
            return train, train
    if "tune" in train.masks:
        train = replace(train, masks={"valid": train.masks["tune"]})
    return train.split(fraction, spec.seed)


def refuse_unfit(spec: Spec, demos: Demonstrations) -> None:
    """Refuse observations that networks cannot read, and a division with too few demonstrations to train.

    :raises DemonstrationsError: one of both is the case.
    """
    for key in spec.observed:
        observed = demos[0].observations[key]
        if why := network_input(observed.shape[1:], observed.dtype)[1]:
            raise DemonstrationsError(f"obs/{key} {why}")
    training = spec.training
    em_alone = training.optimizer.name == "em" and not spec.compare_with
    needs_no_tuning = training.library is not None or em_alone
    if training.tune_fraction > 0 or not needs_no_tuning:  # or one is enough
        check_trained(train_and_valid(spec, demos)["train"].names)


def in_file(spec: Spec) -> bool:
    """Whether the demonstrations are read from a file; otherwise they are collected in a task."""
    file = spec.demonstrations.file
    return spec.demonstrated_task is None or (file is not None and file.exists())


def known_demonstrations(spec: Spec) -> Demonstrations | None:
    """:func:`demonstrations` where nothing has to be collected for them, else None."""
    return demonstrations(spec) if in_file(spec) else None


def demonstrations(spec: Spec, on_event: OnEvent = ignore) -> Demonstrations:
    """The spec's demonstrations, read from its file or collected from its task's supervisor.

    :raises DemonstrationsError: the file is missing or damaged, lacks an observation or label that the spec
        names, or a fit to it takes more memory than is allowed.
    """
    sought = spec.demonstrations
    path = sought.file
    if path is None or not in_file(spec):
        path = collect(str(spec.demonstrated_task), sought, path, on_event, spec.observed)
    return _read(spec, path, lambda demo: Demonstration(**vars(demo)))


def outline(spec: Spec) -> Demonstrations:
    """The demonstrations in the spec's file, with zeros as observations, of which headers alone are read.

    The one that controls are relative to is read.

    :raises DemonstrationsError: as :func:`demonstrations`, except for values of observations.
    """
    path = spec.demonstrations.file
    assert path is not None  # the demonstrations are in a file
    return _read(spec, path, partial(_outlined, measured=_measured(spec)))


def _read(spec: Spec, path: Path, ready: Callable[[Demonstration], Demonstration]) -> Demonstrations:
    """The demonstrations of a file, each as ``ready`` makes it of what the file stores.

    :raises DemonstrationsError: the file is missing or damaged, or a fit to it does not fit into memory.
    """
    if not path.exists():
        keys = [f"obs/{key}" for key in spec.observed]
        read = ", ".join(["actions", *keys, *(f"labels/{name}" for name in _labels(spec))])
        raise DemonstrationsError(
            f"demonstrations.path: {path}: there is no such file; put it there, or fit to another with --set "
            f"demonstrations.path=FILE; it has to be HDF5 in robomimic's layout, with {read} in each "
            "data/<demonstration>"
        )
    sought = spec.demonstrations
    with open_own(path, sought.where, sought.exclude) as source:
        found = [source.read(name, spec.observed, _labels(spec)) for name in source.names]
        remedy = "leave observations out, or make its demonstrations fewer, shorter or equally long"
        refuse_too_much(needed(found), f"a fit to {', '.join(spec.observed)}", remedy)
        return _set_apart(spec, Demonstrations(tuple(map(ready, found)), source.masks, source.attributes))


def _outlined(demo: Demonstration, measured: Collection[str]) -> Demonstration:
    """A demonstration with zeros, which need no memory, in place of observations but the measured ones."""
    check(demo)
    zeros = {
        key: np.broadcast_to(np.zeros((), np.uint8 if is_picture(array) else np.float64), array.shape)
        for key, array in demo.observations.items()
    }
    known = Demonstration(**{**vars(demo), "observations": {key: demo.observations[key] for key in measured}})
    return Demonstration.stored(**{**vars(known), "observations": {**zeros, **known.observations}})


def _measured(spec: Spec) -> tuple[str, ...]:
    """The observation that controls are relative to, if any."""
    return tuple(filter(None, [spec.control.relative_to]))


def seen(spec: Spec, demos: Demonstrations) -> Demonstrations:
    """Demonstrations in memory, without excluded ones, reduced to what a spec names to observe and label.

    :raises DemonstrationsError: an observation, a label or an excluded demonstration is missing.
    """
    keys, labels, exclude = spec.observed, _labels(spec), set(spec.demonstrations.exclude)
    first = demos[0]
    if spec.demonstrations.where:
        attributes = {demo.name: demo.attributes for demo in demos}
        exclude |= {*demos.names} - {*chosen(attributes, spec.demonstrations.where)}
    if (first.observations.keys(), first.labels.keys(), exclude) == ({*keys}, {*labels}, set()):
        return _set_apart(spec, demos)
    for kind, names, there in (("obs", keys, first.observations), ("labels", labels, first.labels)):
        for name in names:
            if name not in there:
                missing = f"there is no {kind}/{name}{nearest(name, there)}"
                raise DemonstrationsError(f"{missing}; there is: {', '.join(there) or 'nothing'}")
    if exclude:
        demos.select(exclude)  # or one of them is not there
    kept = tuple(
        replace(
            demo,
            observations={key: demo.observations[key] for key in keys},
            labels={name: demo.labels[name] for name in labels},
        )
        for demo in demos
        if demo.name not in exclude
    )
    masks = {mask: tuple(name for name in own if name not in exclude) for mask, own in demos.masks.items()}
    return _set_apart(spec, replace(demos, demonstrations=kept, masks=masks))


def _set_apart(spec: Spec, demos: Demonstrations) -> Demonstrations:
    """The demonstrations with the mask ``valid`` that ``hold_out_by`` asks for, in place of the file's own.

    They have the observation ``task`` where the spec names it, and labels of two tasks differ.

    :raises DemonstrationsError: the demonstrations cannot be divided by this attribute, or have no tasks.
    """
    demos = with_labels_of_tasks(demos)
    if spec.sees_task:
        demos = with_tasks(demos, _tasks_of_library(spec))
    given, own = spec.demonstrations, {demo.name: demo.attributes for demo in demos}
    if given.hold_out_by is None:
        return demos
    others = {mask: names for mask, names in demos.masks.items() if mask not in ("train", "valid")}
    if given.holds_out_each:
        return replace(demos, masks=others)
    found = with_values(given.hold_out_by, own, given.valid_fraction, spec.seed)
    held_out = {name for members in found.values() for name in members}
    return replace(demos, masks={**others, "valid": tuple(name for name in demos.names if name in held_out)})


def _tasks_of_library(spec: Spec) -> tuple[str, ...]:
    """The tasks of the run that is the spec's library; none without one."""
    library = spec.training.library
    model = library and Path(library.run) / "model.safetensors"
    return known_tasks(read_tensors(model)[1]) if model and model.is_file() else ()


def _labels(spec: Spec) -> tuple[str, ...]:
    """Names of the labels to compare segments with, and to train from."""
    trained = spec.training.labels
    return tuple(dict.fromkeys((*spec.demonstrations.label_names, *([trained.source] if trained else []))))
