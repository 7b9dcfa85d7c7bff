"""Writers of segments: a class for each format, in a module of its own; ``cli/runs.py`` lists them as options."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ddco_pyro.data.sources import Source
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting import Segmented, Segments

Run = tuple[int, int, int]
"""An option that stays active: (option, first step, step after the last)."""


@dataclass(frozen=True)
class Asked:
    """The arguments of ``segment`` that writers use.

    :param demos: the path of the demonstrations; ``source`` is the same, open.
    :param level: the level whose options are subtasks.
    :param baselines: names of further labels, ``<level>_<baseline>``.
    :param lerobot_format: the first version of LeRobot that reads its subtasks.
    :param same_order: leave out demonstrations whose options follow another order than most.
    """

    fit: Fit
    run: Path
    demos: Path
    source: Source
    level: str
    baselines: tuple[str, ...] = ()
    overwrite: bool = False
    lerobot_format: str = "0.6"
    same_order: bool = False

    @cached_property
    def names(self) -> list[str]:
        """The subtask of each choice of the level, control (0) first."""
        names = self.fit.names[self.level]
        return [name_in_level(option, self.level, names) for option in range(len(names))]

    @cached_property
    def without(self) -> str:
        """The observations that writers of demonstrations leave out, in words; empty without any."""
        first = self.source.recording(self.source.names[0])
        keys = [f"obs/{key}" for key in first.observations if key not in first.numbers]
        return f", without {', '.join(keys)} (no numbers)" if keys else ""


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
        """The subtasks of a demonstration: its level's options, where the same option chosen anew stays one run."""
        return demo.levels[self.asked.level].runs(anew=False)

    def order(self, segmented: Segmented) -> list[int]:
        """The options that are active at all, by how far through a demonstration they are active on average."""
        places: dict[int, list[float]] = {}
        for demo in segmented.segments:
            options = demo.levels[self.asked.level].options
            for option in np.unique(options).tolist():
                places.setdefault(option, []).append(float(np.flatnonzero(options == option).mean()) / len(options))
        return sorted(places, key=lambda option: float(np.mean(places[option])))

    def progress(self, runs: list[Run], order: list[int]) -> np.ndarray:
        """(k + τ) / K of each step: option k of K in the order, τ from 0 at its run's first step to 1 at its last."""
        parts = [
            order.index(option) + (np.linspace(0, 1, stop - start) if stop - start > 1 else np.ones(1))
            for option, start, stop in runs
        ]
        return np.concatenate(parts) / len(order)

    def one_order(self, segmented: Segmented) -> tuple[list[str], dict[str, list[Run]]]:
        """The subtasks that demonstrations go through, and the runs of each demonstration that does so.

        A subtask that occurs twice has a number the second time, such as ``grasp_2``. The first one lasts at least two
        steps: MimicGen looks for the step where its signal rises.

        :raises BadInput: a demonstration has other subtasks than most, and none may be left out.
        """
        runs = {demo.name: self.runs(demo) for demo in segmented.segments}
        subtasks = {name: [self.asked.names[option] for option, _, _ in each] for name, each in runs.items()}
        ((common, count),) = Counter(map(tuple, subtasks.values())).most_common(1)
        problems = {}
        for name, each in runs.items():
            if tuple(subtasks[name]) != common:
                most = f"those of {count} of {len(runs)} demonstrations are {', '.join(common)}"
                problems[name] = f"its subtasks are {', '.join(subtasks[name])}, and {most}"
            elif each[0][2] == 1:
                problems[name] = f"its first subtask, {common[0]}, lasts one step, whose end cannot be marked"
        if len(common) == 1:
            raise BadInput(f"{self.option}: most demonstrations have one subtask, {common[0]}: there is no end to mark")
        if problems and not (self.asked.same_order and len(problems) < len(runs)):
            name, problem = next(iter(problems.items()))
            raise BadInput(
                f"{self.option}: {name}: {problem}; --same-order leaves such demonstrations out ({len(problems)} of "
                f"{len(runs)})"
            )
        names = [
            f"{name}_{common[:place].count(name) + 1}" if name in common[:place] else name
            for place, name in enumerate(common)
        ]
        return names, {name: each for name, each in runs.items() if name not in problems}
