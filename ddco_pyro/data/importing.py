"""Import of other libraries' demonstrations into one HDF5 file of this project's layout."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from ddco_pyro.data.annotations import Labelled, LabelTable, labels_of_table
from ddco_pyro.data.arrays import NUMBERS, LazyArray, Observed, is_picture, network_input
from ddco_pyro.data.controls import few
from ddco_pyro.data.demonstration import Attribute, Demonstration, check, check_values
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.labels import BOUNDARY, LABEL_NAMES, SOURCE, UNKNOWN
from ddco_pyro.data.pictures import resized
from ddco_pyro.data.sources import Source, open_source
from ddco_pyro.data.sources.folder import open_pooled
from ddco_pyro.data.sources.metadata import FREQUENCY
from ddco_pyro.data.sources.robomimic import robomimic_file, write_demonstration
from ddco_pyro.data.tasks import Where, task_of
from ddco_pyro.errors import BadInput, refuse_unknown
from ddco_pyro.events import Counted, OnEvent, ignore


@dataclass(frozen=True)
class Choice:
    """The part of a source that is imported.

    :param observations: keys, or names in the source; if empty, those that hold numbers, without videos.
    :param mask: import only the demonstrations of this mask (robomimic: filter key).
    :param videos: whether videos are decoded, too.
    :param image_size: height and width to which pictures are scaled; None for no scaling.
    :param hz: the rate to import at, Hz; None for that of the source. Numbers are means over the source's
        frames; a picture, a label and a discrete action are those of one frame.
    :param skip_broken: whether unusable demonstrations are left out rather than refused.
    :param actions: names in the source of the arrays that are the control together; if empty, the usual ones.
    :param labels: a table of segments that become labels.
    :param where: attributes and values of the demonstrations to import; all if empty.
    """

    observations: tuple[str, ...] = ()
    mask: str | None = None
    videos: bool = False
    image_size: tuple[int, int] | None = None
    hz: float | None = None
    skip_broken: bool = False
    actions: tuple[str, ...] = ()
    labels: LabelTable | None = None
    where: Where = field(default_factory=dict)


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    :param names: the demonstrations in the file.
    :param left_out: the reason for each demonstration that was left out.
    :param notes: a line for each observation that networks cannot read or that was left out as a video, and
        for what was left out of the table of labels.
    :param labelled: for labels of the table by name, the number of demonstrations in which a step is named.
    """

    path: Path
    names: tuple[str, ...]
    left_out: Mapping[str, str]
    notes: tuple[str, ...] = ()
    labelled: Mapping[str, int] = field(default_factory=dict)


def import_demonstrations(
    source: str | Path | Sequence[Path],
    out: Path,
    form: str | None = None,
    choice: Choice = Choice(),
    on_event: OnEvent = ignore,
) -> Imported:
    """Write the demonstrations of a file or folder, or of pooled ones, into ``out``, whole or not at all.

    Of several tasks, observations that only some have are left out unless they are chosen. Memory holds one
    demonstration at a time, of pictures a block.

    :raises DemonstrationsError: the source cannot be read, or a demonstration cannot be used.
    :raises BadInput: ``out`` exists, or the table of labels does not fit.
    """
    if out.exists():
        raise BadInput(f"{out}: is there already; choose another --out, or remove it")
    paths = [Path(source)] if isinstance(source, str | Path) else [*source]
    pooled = open_pooled(paths, form, choice.actions, choice.where) if len(paths) > 1 else None
    with pooled or open_source(paths[0], form, choice.actions, choice.where) as whole:
        labels, notes, about = Labelled(), list[str](), dict[str, Attribute]()
        if choice.labels:
            whole = replace(whole, frequency=choice.labels.rate or whole.frequency)
            labels, label_names, notes = labels_of_table(choice.labels, whole)
            whole = replace(whole, read=partial(_labelled, whole, labels))
            about[LABEL_NAMES] = json.dumps(label_names)
        if choice.mask is not None:
            refuse_unknown("mask", choice.mask, whole.masks, DemonstrationsError)
        names = [name for name in whole.names if choice.mask is None or name in whole.masks[choice.mask]]
        masks, rate = dict[str, tuple[str, ...]](), choice.hz or whole.frequency
        about = {**whole.attributes, **({FREQUENCY: rate} if rate else {}), **about}
        about |= {"source": ", ".join(path.name for path in paths), "source_format": whole.format}
        alone = _of_some_tasks(whole, names)
        chosen = partial(_chosen, whole, choice=choice, alone=alone)
        left_out = _unusable(names, chosen)  # before pictures are decoded
        _refuse(left_out, names, choice)
        with robomimic_file(out, about, masks) as data:
            for number, name in enumerate(names):
                if name not in left_out:
                    try:
                        demo = chosen(name)
                        check_values(demo, pictures=choice.skip_broken)
                        write_demonstration(data, demo)
                    except DemonstrationsError as error:
                        left_out[name] = error
                        _refuse(left_out, names, choice)
                on_event(Counted("importing", len(names), done=number + 1))
            written = tuple(name for name in whole.names if name in data)
            if not written:
                why = next(iter(left_out.values()), "there is none")
                raise DemonstrationsError(f"{paths[0]}: none of its demonstrations can be used: {why}")
            for mask, members in whole.masks.items():
                if kept := tuple(name for name in members if name in data):
                    masks[mask] = kept
        notes = [*_unread(whole.read(written[0]), chosen(written[0]).observations, alone), *notes]
    reasons = {name: str(error) for name, error in left_out.items()}
    return Imported(out, written, reasons, tuple(notes), {key: len(each) for key, each in labels.items()})


def _of_some_tasks(source: Source, names: Sequence[str]) -> dict[str, str]:
    """The observations that not all of several tasks have, or not of one shape, and why they are left out."""
    tasks: dict[str, dict[str, tuple[int, ...]]] = {}  # the shape of each key in each
    for name in names:
        with suppress(DemonstrationsError):  # which is told where it is used
            demo = source.read(name)
            own = tasks.setdefault(task_of(demo.attributes), {})
            own |= {key: array.shape[1:] for key, array in demo.observations.items() if key not in own}
    reasons = {}
    for key in dict.fromkeys(key for own in tasks.values() for key in own):
        shapes = {task: own[key] for task, own in tasks.items() if key in own}
        if len(shapes) < len(tasks):
            reasons[key] = f"{len(shapes)} of {len(tasks)} tasks have it: {few([*shapes])}"
        elif len({*shapes.values()}) > 1:
            those = few([f"{[*shape]} in {task}" for task, shape in shapes.items()])
            reasons[key] = f"it has other shapes in some tasks: {those}"
    return reasons


def _unusable(names: Sequence[str], chosen: Callable[[str], Demonstration]) -> dict[str, DemonstrationsError]:
    """Why demonstrations cannot be used beside the others, as far as is known without reading lazy values."""
    first: Demonstration | None = None
    left_out = dict[str, DemonstrationsError]()
    for name in names:
        try:
            demo = chosen(name)
            check(demo, first)
            first = first or demo
        except DemonstrationsError as error:
            left_out[name] = error
    return left_out


def _refuse(left_out: Mapping[str, DemonstrationsError], names: Sequence[str], choice: Choice) -> None:
    """Refuse unusable demonstrations, with the advice to leave them out where others are left.

    :raises DemonstrationsError: there are any, and they are not to be left out.
    """
    if left_out and not choice.skip_broken:
        advice = "; or leave such ones out with --skip-broken" if len(left_out) < len(names) else ""
        error = next(iter(left_out.values()))
        raise type(error)(f"{error}{advice}")


def _labelled(source: Source, labels: Mapping[str, Mapping[str, np.ndarray]], name: str) -> Demonstration:
    """A demonstration with the labels of a table, in place of those of the same name."""
    demo = source.read(name)
    stale = {f"{key}{end}" for key in labels for end in ("", BOUNDARY, SOURCE)}
    given = {key: each.get(name, np.full(len(demo), UNKNOWN, np.int16)) for key, each in labels.items()}
    kept = {key: values for key, values in demo.labels.items() if key not in stale}
    return Demonstration.stored(name, demo.observations, demo.actions, {**kept, **given}, demo.attributes)


def _unread(demo: Demonstration, chosen: Mapping[str, Observed], alone: Mapping[str, str]) -> Iterator[str]:
    """A line for each observation that networks cannot read, and for each left out without being asked."""
    yield from (f"obs/{key} is left out: {why}" for key, why in alone.items() if key not in chosen)
    for key, array in demo.observations.items():
        if why := network_input(array.shape[1:], array.dtype)[1]:
            yield f"networks do not read obs/{key}: it {why}"
        elif isinstance(array, LazyArray) and array.video and key not in chosen:
            yield f"obs/{key} is a video, left out without --videos"


def _chosen(source: Source, name: str, choice: Choice, alone: Mapping[str, str]) -> Demonstration:
    """A demonstration with the chosen observations, scaled, at the chosen rate.

    :param alone: observations that are left out unless they are chosen.
    """
    demo = source.read(name)
    known = demo.observations
    named = {f"observation.{key.replace('/', '.')}": key for key in known}  # as LeRobot calls them
    asked = [named.get(key, key) for key in choice.observations]
    for key in asked:
        refuse_unknown("observation", key, known, DemonstrationsError, f"{name}: ")
    videos = {key for key, array in known.items() if isinstance(array, LazyArray) and array.video}
    without = {*alone, *(() if choice.videos else videos)}
    usual = [key for key in known if known[key].dtype.kind in NUMBERS and key not in without]
    wanted = asked or usual
    if not wanted:
        why = "; ".join(_unread(demo, {}, alone)) or "there is none"
        raise DemonstrationsError(f"{name}: has no observation that can be used: {why}")
    observations = {key: known[key] for key in wanted}
    actions: Observed = demo.actions
    labels: Mapping[str, Observed] = demo.labels
    if choice.image_size:
        observations = {key: _scaled(array, choice.image_size) for key, array in observations.items()}
    if choice.hz is not None:
        frames = _frames(source.frequency, choice.hz)
        actions = _slower(actions, frames)
        observations = {key: _slower(array, frames) for key, array in observations.items()}
        labels = {key: _slower(array, frames) for key, array in labels.items()}
    return Demonstration.stored(name, observations, actions, labels, demo.attributes)


NEARLY = 0.01
"""How far the rate may be from a whole part of the source's."""


def _frames(frequency: float | None, hz: float) -> int:
    """The frames of a step."""
    if frequency is None:
        raise BadInput(f"--hz {hz:g}: the source does not say its own rate; leave --hz out")
    frames = round(frequency / hz)
    if not frames or abs(frames * hz / frequency - 1) > NEARLY:
        rates = ", ".join(f"{frequency / number:g}" for number in range(2, 6))
        has = f"the source has {frequency:g} Hz; give a whole part of that, such as {rates}"
        raise BadInput(f"--hz {hz:g}: {has}")
    return frames


def _slower(array: Observed, frames: int) -> Observed:
    """Of each so many frames the mean, or the middle one of pictures and whole numbers."""
    steps = len(array) // frames
    if isinstance(array, LazyArray) and is_picture(array):

        def read(start: int, stop: int) -> Iterator[np.ndarray]:
            middle = frames // 2
            for block in array.read(start * frames, stop * frames):
                yield block[middle % frames :: frames]
                middle -= len(block)

        return replace(array, shape=(steps, *array.shape[1:]), read=read, file="")
    rows = np.asarray(array)[: steps * frames].reshape(steps, frames, *array.shape[1:])
    if array.dtype.kind == "f":
        return rows.mean(1, dtype=np.float64).astype(array.dtype)
    return rows[:, frames // 2]


def _scaled(array: Observed, size: tuple[int, int]) -> Observed:
    if not is_picture(array) or array.shape[1:3] == size:
        return array
    change = partial(resized, size=size)
    if not isinstance(array, LazyArray):
        return change(array)
    stored, shape = array.read, (len(array), *size, array.shape[3])
    return replace(array, shape=shape, read=lambda start, stop: map(change, stored(start, stop)), file="")
