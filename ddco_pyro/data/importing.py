"""Other libraries' demonstrations into one HDF5 file of this project's layout, block by block and resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ddco_pyro.data.checks import check, check_alike, check_values
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError, opened
from ddco_pyro.data.resumable import Parts, discard, parts_of
from ddco_pyro.data.sources import Column, Format, Recording, Source, open_source
from ddco_pyro.data.sources.robomimic import FREQUENCY
from ddco_pyro.data.values import NUMBERS
from ddco_pyro.errors import BadInput, nearest

IDENTITY = "imported"
"""Attribute of a file: what decided its contents."""

OnRecording = Callable[[int, int], None]


@dataclass(frozen=True)
class Choice:
    """What of a source is imported.

    :param observations: keys; all that hold numbers, without pictures from videos, if empty.
    :param mask: only the demonstrations of this mask (robomimic: filter key).
    :param videos: decode the videos too.
    :param image_size: height and width to which pictures are scaled; as they are if None.
    :param skip_broken: leave out demonstrations that cannot be used rather than refuse them.
    :param allow_external: read the parts of an HDF5 file that lie in other files.
    """

    observations: tuple[str, ...] = ()
    mask: str | None = None
    videos: bool = False
    image_size: tuple[int, int] | None = None
    skip_broken: bool = False
    allow_external: bool = False


@dataclass(frozen=True)
class Imported:
    """What an import did: the demonstrations in the file, and those left out, with the reason."""

    path: Path
    names: tuple[str, ...]
    left_out: Mapping[str, str]


def import_demonstrations(
    source: str | Path,
    out: Path,
    form: Format | None = None,
    choice: Choice = Choice(),
    on_recording: OnRecording = lambda done, total: None,
) -> Imported:
    """Write the demonstrations of a file or folder into ``out``; what an interrupted import has done is kept.

    Memory holds one block of an array at a time, whatever the size of the files.

    :raises DemonstrationsError: the source cannot be read, or a demonstration cannot be used.
    :raises BadInput: ``out`` is there already and is something else, or another process is writing it.
    """
    with open_source(source, form, choice.allow_external) as opened_source:
        identity = _identity(opened_source, choice)
        if out.exists():
            discard(out)
            return _already(out, identity)
        with parts_of(out, identity) as parts:
            if parts is None:
                return _already(out, identity)
            left_out = _keep(opened_source, choice, parts, on_recording)
            if not parts.done:
                raise DemonstrationsError(f"{source}: none of its demonstrations can be used")
            done = tuple(parts.done)
            parts.finish(_attributes(opened_source, source, identity), _masks(opened_source, done))
    return Imported(out, done, left_out)


def _keep(source: Source, choice: Choice, parts: Parts, on_recording: OnRecording) -> dict[str, str]:
    """Add every demonstration that is not there yet; those that had to be left out, with the reason."""
    names = _names(source, choice)
    left_out: dict[str, str] = {}
    first: Recording | None = None
    if not choice.skip_broken:
        _check_headers(source, names, choice)
    for number, name in enumerate(names):
        try:
            recording = _chosen(source.recording(name), choice)
            check(recording)
            check_alike(recording, first or recording)
            if name not in parts.done:
                check_values(recording)
                parts.add(recording)
            first = first or recording
        except DemonstrationsError as error:
            if not choice.skip_broken:
                raise _refused(error) from None
            left_out[name] = str(error)
        on_recording(number + 1, len(names))
    parts.close()
    return left_out


def _check_headers(source: Source, names: Sequence[str], choice: Choice) -> None:
    """See that demonstrations can be used, as far as headers say, before the first of them is written.

    :raises DemonstrationsError: one cannot.
    """
    first: Recording | None = None
    try:
        for name in names:
            recording = _chosen(source.recording(name), choice)
            check(recording)
            check_alike(recording, first or recording)
            first = first or recording
    except DemonstrationsError as error:
        raise _refused(error) from None


def _refused(error: DemonstrationsError) -> DemonstrationsError:
    return DemonstrationsError(f"{error}; or leave such ones out with --skip-broken")


def _identity(source: Source, choice: Choice) -> str:
    """What decides the contents of an import."""
    files = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in source.files]
    return json.dumps({"format": source.format, "files": files, "choice": asdict(choice)})


def _digest(identity: str) -> str:
    return hashlib.sha256(identity.encode()).hexdigest()


def _already(out: Path, identity: str) -> Imported:
    with opened(out) as file:
        if file.attrs.get(IDENTITY) != _digest(identity):
            raise BadInput(f"{out}: is there already and is not this import; choose another --out")
        return Imported(out, tuple(file["data"]), {})


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


def _masks(source: Source, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The masks, of those demonstrations that were imported."""
    present = set(names)
    imported = {mask: tuple(name for name in members if name in present) for mask, members in source.masks.items()}
    return {mask: members for mask, members in imported.items() if members}


def _attributes(source: Source, path: str | Path, identity: str) -> dict[str, Attribute]:
    frequency = {FREQUENCY: source.frequency} if source.frequency else {}
    said = {"source": Path(path).name, "source_format": source.format, IDENTITY: _digest(identity)}
    return {**source.attributes, **frequency, **said}


def _chosen(recording: Recording, choice: Choice) -> Recording:
    """The recording with the observations that are wanted."""
    known = recording.observations
    for key in choice.observations:
        if key not in known:
            raise DemonstrationsError(
                f"{recording.name}: there is no observation {key!r}{nearest(key, known)}; there is: {', '.join(known)}"
            )
    wanted = choice.observations or tuple(
        key for key, column in known.items() if column.dtype.kind in NUMBERS and (choice.videos or not column.video)
    )
    if not wanted:
        raise DemonstrationsError(f"{recording.name}: has no observation that can be used")
    observations = {key: _scaled(known[key], choice.image_size) for key in wanted}
    return replace(recording, observations=observations)


def _scaled(column: Column, size: tuple[int, int] | None) -> Column:
    if size is None or not column.image or column.shape[1:3] == size:
        return column

    def blocks() -> Iterator[np.ndarray]:
        for block in column.blocks():
            yield np.stack([_resized(frame, size) for frame in block])

    return Column((column.shape[0], *size, column.shape[3]), column.dtype, blocks)


def _resized(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA).reshape(*size, frame.shape[-1])
