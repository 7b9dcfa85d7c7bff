"""Which demonstrations a run is of: their digest, kept in the run folder as ``demonstrations.json``."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.pictures import Observed, Pictures, blocks
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.record_types import Record
from ddco_pyro.evaluation.schema import read_record

NAME = "demonstrations.json"

TRAINED = ("checkpoints", "model.safetensors", "folds.json")
"""What a run or a selection has as soon as something of it is trained."""


class OtherDemonstrations(BadInput):
    """Demonstrations are not those that a run is of."""


class Digest(Record):
    """What decides a fit to demonstrations: their ``names`` in order, SHA-256 of the ``controls``, of each of the
    ``observations`` and of the ``labels`` that are used, and the ``masks`` that divide them.

    :param files: size, time of the last change (ns) and inode of the file that has the pictures of an observation.
    """

    names: list[str]
    controls: str
    observations: dict[str, str]
    labels: dict[str, str]
    masks: dict[str, list[str]]
    files: dict[str, list[int]]

    def places(self) -> dict[str, Any]:
        """All but the names, by place in a file."""
        kinds: dict[str, Mapping[str, Any]] = {"obs": self.observations, "labels": self.labels, "mask": self.masks}
        each = {f"{kind}/{key}": value for kind, values in kinds.items() for key, value in values.items()}
        return {"actions": self.controls} | each


def digest(demos: Demonstrations, known: Digest | None = None) -> Digest:
    """The digest of demonstrations.

    :param known: one from earlier: pictures whose file has not changed since are not read again.
    :raises DemonstrationsError: a file of pictures cannot be read.
    """
    seen = {key: [demo.observations[key] for demo in demos] for key in sorted(demos[0].observations)}
    files = {key: found for key, arrays in seen.items() if (found := _file(arrays))}
    unchanged = {key for key in files if known and (known.names, known.files.get(key)) == ([*demos.names], files[key])}
    return Digest(
        names=[*demos.names],
        controls=_sha256(demo.actions for demo in demos),
        observations={
            key: known.observations[key] if known and key in unchanged else _sha256(arrays)
            for key, arrays in seen.items()
        },
        labels={name: _sha256(demo.labels[name] for demo in demos) for name in sorted(demos[0].labels)},
        masks={name: [*demos.masks[name]] for name in ("train", "valid") if name in demos.masks},
        files=files,
    )


def _sha256(arrays: Iterable[Observed]) -> str:
    """Of arrays one after the other; pictures of files are read block by block."""
    sha256 = hashlib.sha256()
    for array in arrays:
        sha256.update(json.dumps([array.dtype.str, *array.shape]).encode())
        for block in blocks(array):
            sha256.update(np.ascontiguousarray(block).data)
    return sha256.hexdigest()


def _file(arrays: Sequence[Observed]) -> list[int] | None:
    """The state of the file that has all of these pictures; None where there is no such file."""
    paths = {array.path if isinstance(array, Pictures) else None for array in arrays}
    path = paths.pop()
    if paths or path is None:
        return None
    state = os.stat(path)
    return [state.st_size, state.st_mtime_ns, state.st_ino]


def recorded(folder: Path) -> Digest | None:
    """The digest of the demonstrations that a run or a selection is of; None where nothing is kept yet.

    :raises Damaged: it cannot be read.
    :raises OtherDemonstrations: the folder has none, since another version wrote it.
    """
    path = folder / NAME
    if path.exists():
        return read_record(path, Digest, "fit again into another --out")
    if any((folder / name).exists() for name in TRAINED):
        raise OtherDemonstrations(
            f"{folder}: was written by another version, without a digest of its demonstrations; fit again into another "
            "--out"
        )
    return None


def record(folder: Path, demos: Demonstrations, known: Digest | None = None) -> None:
    """Make a folder in which nothing has been trained a run of these demonstrations, or see that it is one.

    :param known: as of :func:`digest`, where the folder keeps none.
    :raises OtherDemonstrations: it is a run of others.
    :raises Damaged: the digest that is kept cannot be read.
    """
    kept = recorded(folder)
    if kept is None:
        write_text(folder / NAME, digest(demos, known).model_dump_json(indent=1) + "\n")
    else:
        _compare(folder, kept, demos)


def refuse_others(folder: Path, demos: Demonstrations) -> None:
    """See that a finished run is of these demonstrations.

    :raises OtherDemonstrations: it is a run of others.
    :raises Damaged: the digest that is kept cannot be read.
    """
    kept = recorded(folder)
    assert kept is not None  # or it would not be finished
    _compare(folder, kept, demos)


def _compare(folder: Path, kept: Digest, demos: Demonstrations) -> None:
    if different := difference(kept, digest(demos, kept)):
        raise OtherDemonstrations(
            f"{folder}: is a run of other demonstrations ({different}); bring back those that it was fitted to, or "
            "choose another --out for these"
        )


def difference(kept: Digest, now: Digest) -> str:
    """In what demonstrations differ from those that were kept, in words; nothing where they are the same."""
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
