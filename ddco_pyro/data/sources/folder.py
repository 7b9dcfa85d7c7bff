"""A folder of HDF5 files that are pooled, such as one for each task."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.sources import Source, open_source
from ddco_pyro.data.sources.metadata import inside


@contextmanager
def open_folder(path: Path) -> Iterator[Source]:
    """The files ``*.hdf5`` and ``*.h5`` of a folder, each of any format.

    The name of a demonstration begins with that of its file, which is its attribute ``task``, too.

    :raises DemonstrationsError: a file cannot be read, or lies elsewhere.
    """
    files = sorted((one.name for one in path.iterdir() if one.suffix in (".hdf5", ".h5")), key=natural)
    with ExitStack() as stack:
        each = {Path(file).stem: stack.enter_context(open_source(inside(path, file))) for file in files}
        parts = {f"{task}_{name}": (task, name) for task, source in each.items() for name in source.names}

        def read(name: str) -> Demonstration:
            task, own = parts[name]
            demo = each[task].read(own)
            about = {**demo.attributes, "task": task}
            return Demonstration.stored(name, demo.observations, demo.actions, demo.labels, about)

        masks: dict[str, tuple[str, ...]] = {}
        for task, source in each.items():
            for mask, names in source.masks.items():
                masks[mask] = (*masks.get(mask, ()), *(f"{task}_{name}" for name in names))
        rates = {source.frequency for source in each.values()}
        rate = rates.pop() if len(rates) == 1 else None
        yield Source(tuple(parts), read, tuple(path / file for file in files), masks, rate)
