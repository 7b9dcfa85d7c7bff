"""Files of segments: labels in HDF5 demonstrations, and tables with a row for each step in CSV and Parquet."""

from __future__ import annotations

import csv
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import DemonstrationsError, opened, written
from ddco_pyro.drawing.words import option_name
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented, Segments

BOUNDARY = "_boundary"
OURS = "segmented_by"
"""Attribute of labels written by this library; other labels are never replaced."""

SIGNATURE = "ddco-pyro"

COPIED = "segmented_from"
"""Attribute of a labelled copy: digests of the file that was copied."""


def labels_of(demo: Segments) -> dict[str, np.ndarray]:
    """Labels of a demonstration: ``<level>``, its options [T], and ``<level>_boundary``, 1 at each new choice [T].

    Baselines likewise, with ``<level>_<baseline>`` as name.
    """
    labels = {}
    each = {name: (level.options, level.boundaries) for name, level in demo.levels.items()}
    each |= {name: (kinds, np.diff(kinds, prepend=0) != 0) for name, kinds in demo.baselines.items()}
    for name, (options, boundaries) in each.items():
        labels[name] = options.astype(np.int16)
        labels[name + BOUNDARY] = boundaries.astype(np.int8)
    return labels


def check_labels(path: Path, given: Iterable[str], names: Iterable[str]) -> None:
    """Check that demonstrations in ``path`` can be given these labels and their boundaries.

    :param given: levels, and ``<level>_<baseline>`` for baselines.
    :raises BadInput: a demonstration has labels of that name from another source.
    """
    labels = [label for name in given for label in (name, name + BOUNDARY)]
    with opened(path) as file:
        for name in names:
            group = file["data"][name].get("labels", {})
            for label in labels:
                if label in group and group[label].attrs.get(OURS) != SIGNATURE:
                    raise BadInput(
                        f"{path}: {name}: labels/{label} exists and was not written by ddco-pyro segment; give the "
                        "level another name in the run's spec"
                    )


def check_copy(path: Path, out: Path) -> None:
    """Check that ``out`` does not exist or is a labelled copy of ``path``.

    :raises BadInput: ``out`` is something else.
    """
    if out.exists() and _copied_from(out)[:1] != _version(path)[:1]:
        raise BadInput(
            f"--out {out}: exists and is not a labelled copy of {path}; choose another --out, or replace the file with "
            "--overwrite"
        )


def write_labels(path: Path, out: Path, segmented: Segmented) -> None:
    """Write the labels into ``out``, which is ``path`` itself or becomes a copy of it, whole or not at all.

    Labels of the same name are replaced. A file that has these very labels is not written again. For a copy, ``path``
    must also be unchanged since it was copied.
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
    """Digests of a file's path, and of its size and time."""
    stat = path.stat()
    facts = (str(path.resolve()), f"{stat.st_size} {stat.st_mtime_ns}")
    return [hashlib.sha256(os.fsencode(fact)).hexdigest() for fact in facts]


def _copied_from(copy: Path) -> list[str]:
    """The :func:`_version` of the file that a labelled copy was made of; empty for other files."""
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


# --- tables -----------------------------------------------------------------------------------------------------------

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a text that a spreadsheet may execute as a formula."""


def cell(value: Any) -> Any:
    """A value for CSV: an apostrophe goes before a text that a spreadsheet would execute."""
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value


def columns(segmented: Segmented) -> list[str]:
    """Names of the columns: for each level the option, whether it is a new choice, probability, name; baselines."""
    levels = [f"{name}{suffix}" for name in segmented.counts for suffix in ("", BOUNDARY, "_probability", "_name")]
    return [
        "demonstration",
        "step",
        *(["seconds"] if segmented.frequency else []),
        *levels,
        *segmented.segments[0].baselines,
    ]


def rows(segmented: Segmented) -> Iterator[list[Any]]:
    """A row for each step of each demonstration."""
    for demo in segmented.segments:
        for step in range(len(demo)):
            row: list[Any] = [demo.name, step, *([step / segmented.frequency] if segmented.frequency else [])]
            for name, level in demo.levels.items():
                option = int(level.options[step])
                row += [option, int(level.boundaries[step]), float(level.probability[step])]
                row.append(option_name(option, segmented.names.get(name, ())))
            yield row + [int(kinds[step]) for kinds in demo.baselines.values()]


def write_csv(path: Path, segmented: Segmented) -> None:
    """Write the table as CSV, whole or not at all."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        for row in chain([columns(segmented)], rows(segmented)):
            writer.writerow(map(cell, row))


def write_parquet(path: Path, segmented: Segmented) -> None:
    """Write the table as Parquet, whole or not at all.

    :raises BadInput: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise BadInput("--parquet needs pyarrow; install it with: pip install 'ddco-pyro[lerobot]'") from None
    values = zip(*rows(segmented), strict=True)
    table = pyarrow.table({name: list(column) for name, column in zip(columns(segmented), values, strict=True)})
    with whole_file(path) as temporary:
        parquet.write_table(table, temporary)
