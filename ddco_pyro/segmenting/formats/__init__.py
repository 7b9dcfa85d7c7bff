"""Writers of segments: a class for each, in modules of their own; ``FORMATS`` of ``cli/runs.py`` lists them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ddco_pyro.data.labels import SOURCE, UNKNOWN
from ddco_pyro.data.sources import Source
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting import SOURCES, Segmented, Segments

Run = tuple[int, int, int]
"""An option that stays active: (option, first step, step after the last)."""


@dataclass(frozen=True)
class Asked:
    """The arguments of ``segment`` that writers use.

    :param demos: the path of the demonstrations; ``source`` is the same, open.
    :param level: the level whose options are subtasks.
    :param baselines: names of further labels, ``<level>_<baseline>``.
    :param overwrite: replace a file that is no labelled copy of the demonstrations.
    :param same_order: leave out demonstrations whose options follow another order than most, rather than refuse.
    """

    fit: Fit
    run: Path
    demos: Path
    source: Source
    level: str
    baselines: tuple[str, ...] = ()
    overwrite: bool = False
    same_order: bool = False

    @cached_property
    def names(self) -> list[str]:
        """The subtask of each choice of the level, control (0) first."""
        names = self.fit.names[self.level]
        return [name_in_level(option, self.level, names) for option in range(len(names))]


class Writer(ABC):
    """Writes segments in one format.

    :param option: the option of ``segment`` that asks for it, such as ``--csv``.
    """

    def __init__(self, option: str, out: Path, asked: Asked) -> None:
        self.option, self.out, self.asked = option, out, asked

    def check(self) -> None:  # noqa: B027  (most formats refuse nothing)
        """Refuse, before any demonstration is segmented, a file or folder that cannot be written.

        :raises BadInput: the demonstrations or the existing ``out`` do not fit the format.
        """

    @abstractmethod
    def write(self, segmented: Segmented) -> str:
        """Write the file or folder, whole or not at all.

        :return: what was written, for the console.
        :raises BadInput: the segments cannot be written in this format.
        """

    def runs(self, demo: Segments) -> list[Run]:
        """The subtasks of a demonstration: its level's options, where the same option chosen anew stays one run.

        There is none where a person left steps open.
        """
        return [run for run in demo.levels[self.asked.level].runs(anew=False) if run[0] != UNKNOWN]

    def source(self, demo: Segments, start: int, stop: int) -> str | None:
        """Who says what steps of the level are, one of :data:`~ddco_pyro.segmenting.SOURCES`; None without a person."""
        known = demo.baselines.get(self.asked.level + SOURCE)
        return None if known is None else SOURCES[known[start:stop].min()]

    def order(self, segmented: Segmented) -> list[int]:
        """The options that are active at all, by how far through a demonstration they are active on average."""
        places: dict[int, list[float]] = {}
        for demo in segmented.segments:
            options = demo.levels[self.asked.level].options
            for option in np.unique(options[options != UNKNOWN]).tolist():
                places.setdefault(option, []).append(float(np.flatnonzero(options == option).mean()) / len(options))
        return sorted(places, key=lambda option: float(np.mean(places[option])))
