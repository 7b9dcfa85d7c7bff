"""The digest of a run's demonstrations, and the version of its folder's format: ``demonstrations.json``."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import LazyArray, Observed, blocks
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.likeness import Usual, traits, usual
from ddco_pyro.errors import BadInput
from ddco_pyro.metrics import Record, read_record

NAME = "demonstrations.json"

FORMAT = 5
"""The version of the run folder's format."""


class Digest(Record):
    """The digest of demonstrations: ``names`` in order, SHA-256 of controls, observations, labels, ``masks``.

    :param format: the version of the run folder's format.
    :param files: size, time of the last change (ns) and inode of the file with an observation's pictures.
    :param usual: what the demonstrations have in common; None where a folder lacks it.
    """

    names: list[str]
    format: int = 1
    controls: str
    observations: dict[str, str]
    labels: dict[str, str]
    masks: dict[str, list[str]]
    files: dict[str, list[int]]
    usual: Usual | None = None

    def places(self) -> dict[str, Any]:
        """The digests by place in a file of demonstrations."""
        kinds: dict[str, Mapping[str, Any]] = {"obs": self.observations, "labels": self.labels}
        kinds["mask"] = self.masks
        each = {f"{kind}/{key}": value for kind, values in kinds.items() for key, value in values.items()}
        return {"actions": self.controls} | each


def digest(demos: Demonstrations, known: Digest | None = None) -> Digest:
    """The digest of demonstrations.

    :param known: an earlier digest; pictures in a file that has not changed since are not read again.
    :raises DemonstrationsError: a file of pictures cannot be read.
    """
    seen = {key: [demo.observations[key] for demo in demos] for key in sorted(demos[0].observations)}
    files = {key: found for key, arrays in seen.items() if (found := _file(arrays))}
    names = [*demos.names]
    unchanged = {key for key in files if known and (known.names, known.files.get(key)) == (names, files[key])}
    return Digest(
        names=[*demos.names],
        format=FORMAT,
        controls=_sha256(demo.actions for demo in demos),
        observations={
            key: known.observations[key] if known and key in unchanged else _sha256(arrays)
            for key, arrays in seen.items()
        },
        labels={name: _sha256(demo.labels[name] for demo in demos) for name in sorted(demos[0].labels)},
        masks={name: [*demos.masks[name]] for name in ("train", "valid") if name in demos.masks},
        files=files,
        usual=known.usual if known else usual_of(demos),
    )


def usual_of(demos: Demonstrations) -> Usual:
    """What demonstrations have in common."""
    return usual([traits(demo, demo.observations) for demo in demos], demos.frequency)


def _sha256(arrays: Iterable[Observed]) -> str:
    """SHA-256 of arrays one after the other; pictures in files are read block by block."""
    sha256 = hashlib.sha256()
    for array in arrays:
        sha256.update(json.dumps([array.dtype.str, *array.shape]).encode())
        for block in blocks(array):
            sha256.update(np.ascontiguousarray(block).data)
    return sha256.hexdigest()


def _file(arrays: Sequence[Observed]) -> list[int] | None:
    """Size, time and inode of the file with all of these pictures; None without such a file."""
    paths = {array.file if isinstance(array, LazyArray) else "" for array in arrays}
    path = paths.pop()
    if paths or not path:
        return None
    state = os.stat(path)
    return [state.st_size, state.st_mtime_ns, state.st_ino]


def recorded(folder: Path) -> Digest | None:
    """The digest of the demonstrations of a run or a selection; None where nothing is kept yet.

    :raises Damaged: ``demonstrations.json`` is damaged.
    :raises BadInput: the folder was written in another format.
    """
    if not (path := folder / NAME).exists():
        return None
    kept = read_record(path, Digest, "fit again into another --out")
    if kept.format != FORMAT:
        raise BadInput(
            f"{folder}: this run was written by version {kept.format} of the run folder's format, and "
            f"version {FORMAT} is read here: fit again"
        )
    return kept


def record(folder: Path, demos: Demonstrations, known: Digest | None = None) -> None:
    """Write the digest of demonstrations into a new run folder, or compare it with the folder's.

    :param known: an earlier digest, as in :func:`digest`.
    :raises BadInput: the folder is a run of other demonstrations.
    :raises Damaged: ``demonstrations.json`` is damaged.
    """
    kept = recorded(folder)
    if kept is None:
        write_text(folder / NAME, digest(demos, known).model_dump_json(indent=1) + "\n")
    elif different := difference(kept, digest(demos, kept)):
        raise BadInput(
            f"{folder}: is a run of other demonstrations ({different}); bring back those that it was fitted "
            "to, or choose another --out for these"
        )


def difference(kept: Digest, now: Digest) -> str:
    """The differences of two digests in words; empty where they are equal."""
    missing = [name for name in kept.names if name not in now.names]
    new = [name for name in now.names if name not in kept.names]
    if missing or new:
        said = ((missing, "missing"), (new, "new"))
        return " and ".join(f"{_some(names)} {what}" for names, what in said if names)
    if kept.names != now.names:
        return "their order differs"
    ours, theirs = kept.places(), now.places()
    places = [place for place in {**ours, **theirs} if ours.get(place) != theirs.get(place)]
    return f"{' and '.join(places)} changed" if places else ""


def _some(names: Sequence[str]) -> str:
    return f"{names[0]} and {len(names) - 1} more are" if len(names) > 1 else f"{names[0]} is"
