"""Segments as labels in an HDF5 file of demonstrations."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import opened, written
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented, Segments

BOUNDARY = "_boundary"
OURS = "segmented_by"
"""Attribute of labels that were written here; others are never replaced."""

SIGNATURE = "ddco-pyro"


def labels_of(demo: Segments) -> dict[str, np.ndarray]:
    """``<level>``: the options [T]; ``<level>_boundary``: 1 where they are chosen anew [T]."""
    labels = {}
    for name, level in demo.levels.items():
        labels[name] = level.options.astype(np.int16)
        labels[name + BOUNDARY] = level.boundaries.astype(np.int8)
    return labels


def write_labels(path: Path, out: Path, segmented: Segmented) -> None:
    """Write the labels into ``out``, a copy of ``path`` or ``path`` itself, whole or not at all.

    Labels of the same name are replaced where they were written here. A file that has these very labels stays as it is.

    :raises BadInput: it has labels of that name from elsewhere.
    """
    if out.exists() and _has(out, segmented) and (out == path or out.stat().st_size >= path.stat().st_size):
        return
    _refuse_others(path, segmented)
    with whole_file(out) as temporary:
        shutil.copyfile(path, temporary)
        with written(temporary, "r+") as file:
            for demo in segmented.segments:
                group = file["data"][demo.name].require_group("labels")
                for name, values in labels_of(demo).items():
                    if name in group:
                        del group[name]
                    group.create_dataset(name, data=values).attrs[OURS] = SIGNATURE


def _has(path: Path, segmented: Segmented) -> bool:
    with opened(path) as file:
        for demo in segmented.segments:
            group = file["data"].get(f"{demo.name}/labels", {}) if demo.name in file["data"] else {}
            for name, values in labels_of(demo).items():
                if name not in group or not np.array_equal(group[name], values):
                    return False
    return True


def _refuse_others(path: Path, segmented: Segmented) -> None:
    with opened(path) as file:
        for demo in segmented.segments:
            group = file["data"][demo.name].get("labels", {})
            for name in labels_of(demo):
                if name in group and group[name].attrs.get(OURS) != SIGNATURE:
                    raise BadInput(
                        f"{path}: {demo.name}: labels/{name} is there already and was not written by ddco-pyro "
                        f"segment; give the level another name in the run's spec"
                    )
