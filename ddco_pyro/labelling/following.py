"""What follows the cursor in a demonstration: its numbers, its paths in space and its pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import Observed, is_picture
from ddco_pyro.data.demonstration import DIMENSION_NAMES
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources import Source, open_source
from ddco_pyro.drawing.shown import frames, jpeg
from ddco_pyro.drawing.timeline import following
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import PathSpec

PICTURE_HEIGHT = 360
"""Rows of a picture, at most."""

AHEAD = 16
"""Pictures that are read together: a video is read in order."""

KEPT = 64
"""Such blocks of pictures in memory."""


class Following:
    """What follows the cursor.

    :param path: the demonstrations; their pictures are read when they are asked for.
    :param trajectory: ``report.trajectory`` of the run's spec.
    """

    def __init__(self, path: Path, demos: Demonstrations, trajectory: Sequence[PathSpec] | None) -> None:
        self.path, self.demos, self.paths, self.opened = path, demos, trajectory or (), ExitStack()
        known: dict[str, list[str]] = json.loads(str(demos.attributes.get(DIMENSION_NAMES, "{}")))
        named = ((key, n, name) for key, names in known.items() for n, name in enumerate(names))
        self.names = {f"{key}[{n}]": f"{key} {name}" for key, n, name in named}
        self.cameras, self.block = lru_cache(KEPT)(self._cameras), lru_cache(KEPT)(self._block)
        self.lock = Lock()

    @cached_property
    def source(self) -> Source:
        """The demonstrations, open."""
        return self.opened.enter_context(open_source(self.path))

    def _cameras(self, index: int) -> dict[str, Observed]:
        """The pictures of a demonstration by their names."""
        demo = self.demos[index]
        there = self.source.read(demo.name).observations if demo.name in self.source.names else {}
        return {key: array for key, array in there.items() if is_picture(array) and len(array) == len(demo)}

    def _block(self, index: int, camera: str, number: int) -> list[bytes]:
        """The pictures of some steps in order, as JPEG."""
        array = self.cameras(index)[camera]
        steps = np.arange(number * AHEAD, min((number + 1) * AHEAD, len(array)))
        height = min(PICTURE_HEIGHT, max(array.shape[1], 240))
        return [jpeg(picture) for picture in frames(array, steps, height)]

    def shown(self, index: int) -> dict[str, Any]:
        """Numbers and paths of a demonstration, and the names of its cameras."""
        demo = self.demos[index]
        (found,) = following([demo], [], len(demo), self.paths)
        if numbers := found.get("n"):
            numbers = {**numbers, "names": [self.names.get(name, name) for name in numbers["names"]]}
        with self.lock:
            cameras = [*self.cameras(index)]
        drawn = {key: found.get(key) for key in ("paths", "view")}
        return {"numbers": numbers, **drawn, "cameras": cameras}

    def picture(self, index: int, camera: int, step: int) -> bytes:
        """The picture of a step as JPEG.

        :raises BadInput: there is none.
        """
        with self.lock:
            cameras = [*self.cameras(index)]
            if not 0 <= camera < len(cameras) or not 0 <= step < len(self.demos[index]):
                raise BadInput(f"{self.demos.names[index]}: has no picture {camera} of step {step}")
            number, place = divmod(step, AHEAD)
            return self.block(index, cameras[camera], number)[place]

    def close(self) -> None:
        """Close the file of the pictures."""
        self.opened.close()
