"""Several files of demonstrations that are pooled, or a folder of them, such as one for each task."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstration import NOTHING, Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError, located
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.labels import BOUNDARY, LABEL_NAMES, SOURCE, UNKNOWN, label_names
from ddco_pyro.data.sources import Source, narrowed, open_source
from ddco_pyro.data.tasks import Where, task_of
from ddco_pyro.spec import TASK


def open_folder(path: Path) -> Iterator[Source]:
    """The files ``*.hdf5`` and ``*.h5`` of a folder, each of any format, pooled.

    :raises DemonstrationsError: a file cannot be read.
    """
    files = sorted((one.name for one in path.iterdir() if one.suffix in (".hdf5", ".h5")), key=natural)
    with open_pooled([path / file for file in files]) as source:
        yield source


@contextmanager
def open_pooled(
    paths: Sequence[Path], form: str | None = None, actions: Sequence[str] = (), where: Where = NOTHING
) -> Iterator[Source]:
    """Several files or folders, each as :func:`~ddco_pyro.data.sources.open_source` takes it, as one source.

    The name of a demonstration begins with that of its file, which is its task unless its attributes name
    another one. Labels are called as their names say; those without names are of their task: ``reach: 2`` is
    another one than ``push: 2``. Where a file lacks labels that another one has, they are unknown.

    :raises DemonstrationsError: a file cannot be read, or two files have one name.
    """
    if len({path.stem for path in paths}) < len(paths):
        twice = next(path for n, path in enumerate(paths) if path.stem in [one.stem for one in paths[:n]])
        raise DemonstrationsError(f"{twice}: another file is called {twice.stem}, too; rename one of both")
    with ExitStack() as stack:
        each = {path.stem: stack.enter_context(open_source(path, form, actions)) for path in paths}
        parts = {f"{stem}_{name}": (stem, name) for stem, source in each.items() for name in source.names}

        def stored(name: str) -> tuple[Demonstration, str]:
            """A demonstration as its file has it, and its task."""
            stem, own = parts[name]
            with located(each[stem].path):
                demo = each[stem].read(own)
            return demo, task_of(demo.attributes) or task_of(each[stem].attributes) or stem

        words: dict[str, dict[str, dict[int, str]]] = {}  # of each value, by labels and demonstration
        for name, (stem, _) in parts.items():
            with suppress(DemonstrationsError):  # reading it tells
                demo, task = stored(name)
                named = label_names(each[stem].attributes)
                for key, values in demo.labels.items():
                    if not key.endswith((BOUNDARY, SOURCE)):
                        known = dict(enumerate(named.get(key, ())))
                        there = (int(value) for value in np.unique(values) if value != UNKNOWN)
                        words.setdefault(key, {})[name] = {
                            value: known.get(value, f"{task}: {value}") for value in there
                        }
        called = {
            key: list(dict.fromkeys(word for own in known.values() for word in own.values()))
            for key, known in words.items()
        }

        def read(name: str) -> Demonstration:
            demo, task = stored(name)
            labels = {key: np.full(len(demo), UNKNOWN, np.int16) for key in words}
            for key in words.keys() & demo.labels.keys():
                for value, word in words[key].get(name, {}).items():
                    labels[key][demo.labels[key] == value] = called[key].index(word)
            attributes = {**demo.attributes, TASK: task}
            return Demonstration.stored(name, demo.observations, demo.actions, labels, attributes)

        masks: dict[str, tuple[str, ...]] = {}
        for stem, source in each.items():
            for mask, members in source.masks.items():
                masks[mask] = (*masks.get(mask, ()), *(f"{stem}_{name}" for name in members))
        rates = {source.frequency for source in each.values()}
        rate = rates.pop() if len(rates) == 1 else None
        attributes: dict[str, Attribute] = {LABEL_NAMES: json.dumps(called)} if called else {}
        yield narrowed(Source(tuple(parts), read, masks, rate, attributes, format="folder"), where)
