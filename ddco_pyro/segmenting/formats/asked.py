"""What a format is asked to write, and how it names and orders subtasks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ddco_pyro.data.labels import SOURCE, UNKNOWN
from ddco_pyro.data.sources import Source
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting.segments import SOURCES, Segmented, Segments

Run = tuple[int, int, int]
"""An option that stays active: (option, first step, step after the last)."""


@dataclass(frozen=True)
class Asked:
    """The arguments of ``segment`` that a format uses.

    :param option: the option of ``segment`` that asks for the format, such as ``--csv``.
    :param out: the file or folder to write.
    :param demos: the path of the demonstrations; ``source`` is the same, open.
    :param level: the level whose options are subtasks.
    :param annotator: who labelled; empty where no one did.
    :param same_order: leave out demonstrations whose options follow another order than most, rather than refuse.
    """

    option: str
    out: Path
    fit: Fit
    run: Path
    demos: Path
    source: Source
    level: str
    same_order: bool = False
    annotator: str = ""

    @cached_property
    def names(self) -> list[str]:
        """The subtask of each choice of the level, control (0) first."""
        return self.names_of(self.level)

    def names_of(self, level: str) -> list[str]:
        """The name of each choice of a level, control (0) first."""
        names = self.fit.names[level]
        return [name_in_level(option, level, names) for option in range(len(names))]

    def runs(self, demo: Segments) -> list[Run]:
        """The subtasks of a demonstration: its level's options, where the same option chosen anew stays one run.

        There is none where a person left steps open.
        """
        return [run for run in demo.levels[self.level].runs(anew=False) if run[0] != UNKNOWN]

    def said_by(self, demo: Segments, start: int, stop: int) -> str | None:
        """Who says what steps of the level are, one of :data:`~ddco_pyro.segmenting.SOURCES`; None without a person."""
        known = demo.sources.get(self.level + SOURCE)
        return None if known is None else SOURCES[known[start:stop].min()]

    def order(self, segmented: Segmented) -> list[int]:
        """The options that are active at all, by how far through a demonstration they are active on average."""
        places: dict[int, list[float]] = {}
        for demo in segmented.segments:
            options = demo.levels[self.level].options
            for option in np.unique(options[options != UNKNOWN]).tolist():
                places.setdefault(option, []).append(float(np.flatnonzero(options == option).mean()) / len(options))
        return sorted(places, key=lambda option: float(np.mean(places[option])))
