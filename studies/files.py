"""Files of demonstrations as the world of a study (``world: files:WORLD``): a task is the path of a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput


class Files:
    """Every training seed draws demonstrations of a file; seeds share some. Nothing acts."""

    methods = ()

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Write ``count`` demonstrations, as :func:`drawn` gives them."""
        drawn(Path(task), seeds.start, count).write(path)


def drawn(file: Path, seed: int, count: int) -> Demonstrations:
    """So many demonstrations of a file in a random order, named by their places.

    :raises BadInput: the file has fewer.
    """
    demos = Demonstrations.read(file)
    if len(demos) < count:
        raise BadInput(
            f"{file}: has {len(demos)} demonstrations, but the study needs {count}; lower counts or held_out"
        )
    order = np.random.default_rng(seed).permutation(len(demos))[:count].tolist()
    each = (replace(demos[place], name=f"demo_{number}") for number, place in enumerate(order))
    return Demonstrations(tuple(each), attributes=demos.attributes)


WORLD = Files()
