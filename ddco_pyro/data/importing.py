"""Import of other libraries' demonstrations into one HDF5 file of this project's layout."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np

from ddco_pyro.data.annotations import Labelled, LabelTable
from ddco_pyro.data.checks import NUMBERS, check, check_alike, check_values, reading
from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.pictures import resized
from ddco_pyro.data.sources import Column, Recording, Source, open_source
from ddco_pyro.data.sources.metadata import FREQUENCY
from ddco_pyro.data.sources.robomimic import robomimic_file, write_recording
from ddco_pyro.errors import BadInput, nearest

OnRecording = Callable[[int, int], None]


@dataclass(frozen=True)
class Choice:
    """The part of a source that is imported.

    :param observations: keys, or names in the source; if empty, the observations that hold numbers, without videos.
    :param mask: import only the demonstrations of this mask (robomimic: filter key).
    :param videos: whether videos are decoded, too.
    :param image_size: height and width to which pictures are scaled; None for no scaling.
    :param hz: the rate to import at, Hz; None for that of the source. Numbers are means over the source's frames; a
        picture, a label and a discrete action are those of one frame.
    :param skip_broken: whether unusable demonstrations are left out rather than refused.
    :param actions: names in the source of the arrays that are the control together; if empty, the usual ones.
    :param labels: a table of segments that become labels.
    """

    observations: tuple[str, ...] = ()
    mask: str | None = None
    videos: bool = False
    image_size: tuple[int, int] | None = None
    hz: float | None = None
    skip_broken: bool = False
    actions: tuple[str, ...] = ()
    labels: LabelTable | None = None


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    :param names: the demonstrations in the file.
    :param left_out: the reason for each demonstration that was left out.
    :param notes: a line for each observation that networks cannot read or that was left out as a video, and for what
        was left out of the table of labels.
    :param labelled: for labels of the table by name, the number of demonstrations in which a step is named.
    """

    path: Path
    names: tuple[str, ...]
    left_out: Mapping[str, str]
    notes: tuple[str, ...] = ()
    labelled: Mapping[str, int] = field(default_factory=dict)


def import_demonstrations(
    source: str | Path,
    out: Path,
    form: str | None = None,
    choice: Choice = Choice(),
    on_recording: OnRecording = lambda done, total: None,
) -> Imported:
    """Write the demonstrations of a file or folder into ``out``, whole or not at all.

    Memory holds one block of an array at a time.

    :raises DemonstrationsError: the source cannot be read, or a demonstration cannot be used.
    :raises BadInput: ``out`` exists, or the table of labels does not fit.
    """
    if out.exists():
        raise BadInput(f"{out}: is there already; choose another --out, or remove it")
    with open_source(source, form, choice.actions) as whole:
        labelled = Labelled(whole, choice.labels) if choice.labels else None
        chosen = labelled or whole
        masks: dict[str, tuple[str, ...]] = {}
        rate = choice.hz or chosen.frequency
        about = {**chosen.attributes, **({FREQUENCY: rate} if rate else {})}
        about |= {"source": Path(source).name, "source_format": chosen.format}
        with robomimic_file(out, about, masks) as data:
            left_out, unread = _write(chosen, choice, data, on_recording)
            if not len(data):
                why = next(iter(left_out.values()))
                raise DemonstrationsError(f"{source}: none of its demonstrations can be used: {why}")
            names = tuple(name for name in chosen.names if name in data)
            present = set(names)
            for mask, members in chosen.masks.items():
                if imported := tuple(name for name in members if name in present):
                    masks[mask] = imported
    if labelled is None:
        return Imported(out, names, left_out, unread)
    return Imported(out, names, left_out, (*unread, *labelled.notes), labelled.counts)


def _write(
    source: Source, choice: Choice, data: h5py.Group, on_recording: OnRecording
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write all demonstrations; the reason for each that is left out, and the observations that are not read."""
    names = _names(source, choice)
    left_out: dict[str, str] = {}
    unread: tuple[str, ...] = ()
    if not choice.skip_broken:
        _check_headers(source, names, choice)
    first: Recording | None = None
    for number, name in enumerate(names):
        try:
            recording = _usable(source, name, choice, first)
            check_values(recording, pictures=choice.skip_broken)
            write_recording(data, recording)
            unread = unread if first else tuple(_unread(source.recording(name), recording))
            first = first or recording
        except DemonstrationsError as error:
            if not choice.skip_broken:
                raise _refused(source, names, choice, error) from None
            left_out[name] = str(error)
        on_recording(number + 1, len(names))
    return left_out, unread


def _unread(whole: Recording, chosen: Recording) -> Iterator[str]:
    """A line for each observation that networks cannot read, and for each video that is not chosen."""
    for key, column in whole.observations.items():
        _, why = reading(column.shape[1:], column.dtype)
        if why:
            yield f"networks do not read obs/{key}: it {why}"
        elif column.video and key not in chosen.observations:
            yield f"obs/{key} is a video, left out without --videos"


def _usable(source: Source, name: str, choice: Choice, first: Recording | None = None) -> Recording:
    """The chosen part of a demonstration, which is usable by its headers, beside the first one."""
    recording = _chosen(source.recording(name), choice, source.frequency)
    check(recording)
    check_alike(recording, first or recording)
    return recording


def _check_headers(source: Source, names: Sequence[str], choice: Choice) -> None:
    """Refuse unusable demonstrations by their headers, before anything is written."""
    first: Recording | None = None
    try:
        for name in names:
            recording = _usable(source, name, choice, first)
            first = first or recording
    except DemonstrationsError as error:
        raise _refused(source, names, choice, error) from None


def _refused(source: Source, names: Sequence[str], choice: Choice, error: DemonstrationsError) -> DemonstrationsError:
    """The error, with the advice to leave demonstrations out where one of them can be used."""
    for name in names:
        with suppress(DemonstrationsError):
            check_values(_usable(source, name, choice), pictures=True)
            return DemonstrationsError(f"{error}; or leave such ones out with --skip-broken")
    return error


def _names(source: Source, choice: Choice) -> tuple[str, ...]:
    if choice.mask is None:
        return source.names
    if choice.mask not in source.masks:
        known = ", ".join(source.masks) or "none"
        raise DemonstrationsError(
            f"there is no mask {choice.mask!r}{nearest(choice.mask, source.masks)}; there is: {known}"
        )
    members = set(source.masks[choice.mask])
    return tuple(name for name in source.names if name in members)


def _chosen(recording: Recording, choice: Choice, frequency: float | None) -> Recording:
    """A recording with the chosen observations, scaled, at the chosen rate."""
    known = recording.observations
    names = {column.named or key: key for key, column in known.items()}
    keys = names | {key: key for key in known}
    for key in choice.observations:
        if key not in keys:
            raise DemonstrationsError(
                f"{recording.name}: there is no observation {key!r}{nearest(key, keys)}; there is: {', '.join(names)}"
            )
    wanted = [keys[key] for key in choice.observations] or [
        key for key, column in known.items() if column.dtype.kind in NUMBERS and (choice.videos or not column.video)
    ]
    if not wanted:
        why = "; ".join(_unread(recording, replace(recording, observations={}))) or "there is none"
        raise DemonstrationsError(f"{recording.name}: has no observation that can be used: {why}")
    observations = {key: _scaled(known[key], choice.image_size) for key in wanted}
    recording = replace(recording, observations=observations)
    return recording if choice.hz is None else _slower(recording, _frames(frequency, choice.hz))


def _frames(frequency: float | None, hz: float) -> int:
    """The frames of a step."""
    if frequency is None:
        raise BadInput(f"--hz {hz:g}: the source does not say its own rate; leave --hz out")
    frames = round(frequency / hz)
    if not frames or abs(frames * hz / frequency - 1) > NEARLY:
        rates = ", ".join(f"{frequency / number:g}" for number in range(2, 6))
        raise BadInput(f"--hz {hz:g}: the source has {frequency:g} Hz; give a whole part of that, such as {rates}")
    return frames


NEARLY = 0.01
"""How far the rate may be from a whole part of the source's."""


def _slower(recording: Recording, frames: int) -> Recording:
    def slower(column: Column) -> Column:
        def reduced(rows: np.ndarray) -> np.ndarray:
            steps = rows.reshape(-1, frames, *rows.shape[1:])
            if rows.dtype.kind == "f":
                return steps.mean(1, dtype=np.float64).astype(rows.dtype)
            middle: np.ndarray = steps[:, frames // 2]
            return middle

        def blocks() -> Iterator[np.ndarray]:
            left = np.empty((0, *column.shape[1:]), column.dtype)
            for block in column.blocks():
                rows = np.concatenate([left, block])
                whole = len(rows) - len(rows) % frames
                left = rows[whole:]
                if whole:
                    yield reduced(rows[:whole])

        return replace(column, shape=(column.shape[0] // frames, *column.shape[1:]), blocks=blocks, kept=None)

    def each(columns: Mapping[str, Column]) -> dict[str, Column]:
        return {key: slower(column) for key, column in columns.items()}

    actions, observations = slower(recording.actions), each(recording.observations)
    return replace(recording, actions=actions, observations=observations, labels=each(recording.labels))


def _scaled(column: Column, size: tuple[int, int] | None) -> Column:
    if size is None or not column.image or column.shape[1:3] == size:
        return column

    def blocks() -> Iterator[np.ndarray]:
        for block in column.blocks():
            yield resized(block, size)

    return Column((column.shape[0], *size, column.shape[3]), column.dtype, blocks, named=column.named)
