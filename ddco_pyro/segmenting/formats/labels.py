"""Labels for each step in an HDF5 file of demonstrations, or in a copy of it."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import attributes_of, opened, written
from ddco_pyro.data.labels import BOUNDARY, EXCLUDE, LABEL_NAMES, SOURCE, label_names
from ddco_pyro.errors import BadInput
from ddco_pyro.names import choice_names
from ddco_pyro.segmenting.formats import Asked, check_copy
from ddco_pyro.segmenting.segments import Segmented, Segments, chosen_names

OURS = "segmented_by"
"""Attribute of labels written by this library; other labels are never replaced."""

SIGNATURE = "ddco-pyro"

COPIED = "segmented_from"
"""Attribute of a labelled copy: a digest of the path that was copied."""


def labels_of(demo: Segments) -> dict[str, np.ndarray]:
    """Labels of a demonstration: ``<level>``, its options [T], and ``<level>_boundary``, 1 at each new choice
    [T].

    ``<level>_source``, who says so, likewise.
    """
    labels = {}
    each = {name: (level.options, level.boundaries) for name, level in demo.levels.items()}
    each |= {name: (sources, np.diff(sources, prepend=0) != 0) for name, sources in demo.sources.items()}
    for name, (options, boundaries) in each.items():
        labels[name] = options.astype(np.int16)
        labels[name + BOUNDARY] = boundaries.astype(np.int8)
    return labels


def check(asked: Asked) -> None:
    """Check that the labels can be written into the file, or into a copy of it.

    :raises BadInput: the copy's place is taken, or a demonstration has labels of that name from elsewhere.
    """
    if not _same(asked.out, asked.source.path):
        check_copy("robomimic", asked.out, asked.source.path)
    check_labels(asked.source.path, asked.fit.names, chosen_names(asked.source, asked.fit))


def check_labels(path: Path, given: Iterable[str], names: Iterable[str]) -> None:
    """Check that demonstrations in ``path`` can be given these labels and their boundaries.

    :param given: their names.
    :raises BadInput: a demonstration has labels of that name from another source.
    """
    labels = [label for name in given for label in (name, name + BOUNDARY)]
    with opened(path) as file:
        for name in names:
            group = file["data"][name].get("labels", {})
            for label in labels:
                if label in group and group[label].attrs.get(OURS) != SIGNATURE:
                    foreign = f"labels/{label} exists and was not written by ddco-pyro segment"
                    remedy = "give the level another name in the run's spec"
                    raise BadInput(f"{path}: {name}: {foreign}; {remedy}")


def is_copy(out: Path, path: Path) -> bool:
    """Whether ``out`` is a labelled copy of ``path``."""
    with suppress(DemonstrationsError), opened(out) as file:
        return bool(file.attrs.get(COPIED) == _digest(path))
    return False


def write(asked: Asked, segmented: Segmented) -> str:
    """``labels/<level>`` and ``labels/<level>_boundary`` of every level, in a copy or in the file itself.

    Labels of the same name are replaced. The names of options become names of their labels.
    """
    with whole_file(asked.out) as temporary:
        shutil.copyfile(asked.source.path, temporary)
        with written(temporary, "r+") as file:
            for demo in segmented.segments:
                group = file["data"][demo.name].require_group("labels")
                labels = labels_of(demo)
                stale = {level + SOURCE + end for level in segmented.counts for end in ("", BOUNDARY)}
                ours = {name for name in stale & {*group} if group[name].attrs.get(OURS) == SIGNATURE}
                for name in ours | labels.keys() & {*group}:
                    del group[name]
                for name, values in labels.items():
                    group.create_dataset(name, data=values).attrs[OURS] = SIGNATURE
            for name, marks in segmented.marks.items():
                for mark in ("flag", "note"):
                    file["data"][name].attrs.pop(mark, None)
                    if mark in marks:
                        file["data"][name].attrs[mark] = marks[mark]
            if segmented.marks:
                file.pop(f"mask/{EXCLUDE}", None)
                left_out = [name for name, marks in segmented.marks.items() if EXCLUDE in marks]
                leave_out(file, left_out)
                if left_out:
                    file[f"mask/{EXCLUDE}"] = np.array(left_out, "S")
            if (names := _names(segmented)) != label_names(attributes_of(file["data"]) | attributes_of(file)):
                holder = file if LABEL_NAMES in file.attrs else file["data"]
                holder.attrs[LABEL_NAMES] = json.dumps(names)
            if not _same(asked.out, asked.source.path):
                file.attrs[COPIED] = _digest(asked.source.path)
    return f"{asked.out}: labels/{', labels/'.join(segmented.counts)}"


def leave_out(file: h5py.File, names: Collection[str]) -> None:
    """Take demonstrations out of all masks; one without others goes."""
    for mask, members in [*file.get("mask", {}).items()]:
        kept = [name for name in members[()] if name.decode() not in names]
        if len(kept) < len(members):
            del file[f"mask/{mask}"]
            if kept:
                file[f"mask/{mask}"] = np.array(kept, "S")


def _names(segmented: Segmented) -> dict[str, list[str]]:
    """The names of the labels in the file; those of a level with named options are named like its choices."""
    labels, levels = segmented.label_names.items(), segmented.names.items()
    known = {name: list(names) for name, names in labels if name not in segmented.counts}
    own = {level: list(names) for level, names in levels if tuple(names) != choice_names(len(names) - 1)}
    return known | own


def _same(out: Path, path: Path) -> bool:
    return out.exists() and out.samefile(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(os.fsencode(path.resolve())).hexdigest()
