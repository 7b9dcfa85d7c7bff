"""What follows the cursor in a demonstration: its numbers, its paths in space and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.drawing.shown import frames, jpeg, stored_pictures
from ddco_pyro.drawing.timeline import following
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import PathSpec

PICTURE_HEIGHT = 240
"""Rows of a picture."""


class Following:
    """What follows the cursor.

    :param path: the file of the demonstrations; its pictures are read when they are asked for.
    :param trajectory: ``report.trajectory`` of the run's spec.
    """

    def __init__(self, path: Path, demos: Demonstrations, trajectory: Sequence[PathSpec] | None) -> None:
        self.path, self.demos, self.paths, self.opened = path, demos, trajectory or (), ExitStack()

    @cached_property
    def pictures(self) -> list[Observed]:
        """Of each demonstration; empty where there are none."""
        source = self.opened.enter_context(open_source(self.path))
        return stored_pictures(source, dict(zip(self.demos.names, self.demos.lengths, strict=True)))

    def shown(self, index: int) -> dict[str, Any]:
        """Numbers and paths of a demonstration, and how many pictures it has."""
        demo = self.demos[index]
        (found,) = following([demo], [], len(demo), self.paths)
        pictures = len(self.pictures[index]) if self.pictures else 0
        return {"numbers": found.get("n"), "paths": found.get("paths"), "view": found.get("view"), "pictures": pictures}

    def picture(self, index: int, step: int) -> bytes:
        """The picture of a step as JPEG.

        :raises BadInput: there is none.
        """
        if not self.pictures or not 0 <= step < len(self.demos[index]):
            raise BadInput(f"{self.demos.names[index]}: has no picture of step {step}")
        return jpeg(frames(self.pictures[index], [step], PICTURE_HEIGHT)[0])

    def close(self) -> None:
        """Close the file of the pictures."""
        self.opened.close()
