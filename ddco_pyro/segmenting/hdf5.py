"""Segments as labels in an HDF5 file of demonstrations."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import DemonstrationsError, opened, written
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented, Segments

BOUNDARY = "_boundary"
OURS = "segmented_by"
"""Attribute of labels that were written here; others are never replaced."""

SIGNATURE = "ddco-pyro"

COPIED = "segmented_from"
"""Attribute of a labelled copy: what it is a copy of."""


def labels_of(demo: Segments) -> dict[str, np.ndarray]:
    """``<level>``: the options [T]; ``<level>_boundary``: 1 where they are chosen anew [T]."""
    labels = {}
    for name, level in demo.levels.items():
        labels[name] = level.options.astype(np.int16)
        labels[name + BOUNDARY] = level.boundaries.astype(np.int8)
    return labels


def check_labels(path: Path, levels: Iterable[str], names: Iterable[str]) -> None:
    """See that demonstrations in ``path`` can be given labels named after these levels.

    :raises BadInput: one has labels of that name from elsewhere.
    """
    labels = [label for level in levels for label in (level, level + BOUNDARY)]
    with opened(path) as file:
        for name in names:
            group = file["data"][name].get("labels", {})
            for label in labels:
                if label in group and group[label].attrs.get(OURS) != SIGNATURE:
                    raise BadInput(
                        f"{path}: {name}: labels/{label} is there already and was not written by ddco-pyro "
                        f"segment; give the level another name in the run's spec"
                    )


def check_copy(path: Path, out: Path) -> None:
    """See that ``out`` is not there, or is a labelled copy of ``path`` that was written here.

    :raises BadInput: it is something else.
    """
    if out.exists() and _copied_from(out)[:1] != _version(path)[:1]:
        raise BadInput(
            f"--out {out}: is there already and is not a labelled copy of {path}; choose another --out, or replace it "
            "with --overwrite"
        )


def write_labels(path: Path, out: Path, segmented: Segmented) -> None:
    """Write the labels into ``out``, a copy of ``path`` or ``path`` itself, whole or not at all.

    Labels of the same name are replaced. A file that has these very labels stays as it is; a copy does so only where
    ``path`` is what it was copied from.
    """
    in_place = out.exists() and out.samefile(path)
    if (in_place or _copied_from(out) == _version(path)) and _has(out, segmented):
        return
    with whole_file(out) as temporary:
        shutil.copyfile(path, temporary)
        with written(temporary, "r+") as file:
            for demo in segmented.segments:
                group = file["data"][demo.name].require_group("labels")
                for name, values in labels_of(demo).items():
                    if name in group:
                        del group[name]
                    group.create_dataset(name, data=values).attrs[OURS] = SIGNATURE
            if not in_place:
                file.attrs[COPIED] = _version(path)


def _version(path: Path) -> list[str]:
    """Digests of where a file lies, and of its size and time."""
    stat = path.stat()
    facts = (str(path.resolve()), f"{stat.st_size} {stat.st_mtime_ns}")
    return [hashlib.sha256(os.fsencode(fact)).hexdigest() for fact in facts]


def _copied_from(copy: Path) -> list[str]:
    """The :func:`_version` of what a labelled copy was made of; nothing where it is none."""
    try:
        with opened(copy) as file:
            return [str(digest) for digest in np.ravel(file.attrs.get(COPIED, []))]
    except DemonstrationsError:
        return []


def _has(path: Path, segmented: Segmented) -> bool:
    with opened(path) as file:
        for demo in segmented.segments:
            group = file["data"].get(f"{demo.name}/labels", {}) if demo.name in file["data"] else {}
            for name, values in labels_of(demo).items():
                if name not in group or not np.array_equal(group[name], values):
                    return False
    return True
