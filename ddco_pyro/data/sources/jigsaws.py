"""JIGSAWS, surgeons' demonstrations on a da Vinci robot (Gao and others 2014): text files in the official layout.

A task's folder has ``kinematics/AllGestures/NAME.txt``, one row of 76 numbers for each frame, 30 frames a second;
``transcriptions/NAME.txt``, rows ``FIRST LAST GESTURE`` whose frames count from 1, the last one included; and
``meta_file_TASK.txt``, a row of a name, a self-stated skill and a rating for each trial.

A row has 19 numbers for each of four arms: position [3] in m, rotation matrix [9], velocity [3] in m/s, angular
velocity [3] in rad/s, and the gripper's angle in rad. The order is master left, master right, and the instruments that
the files' own documentation calls slave left and slave right. The left master drives the *last* instrument: each
displacement of that one is half of the master's. Arms are named by the surgeon's hand here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.sources.recording import LABEL_NAMES, Recording

TRIALS = Path("kinematics", "AllGestures")
"""The folder of trials in that of a task."""

WIDTH, ARM = 76, 19
"""Numbers of a frame, and of an arm in it."""

HANDS = {"left": (0, 3), "right": (1, 2)}
"""The master and the instrument of each hand, by their place in a row."""

TRIAL = re.compile(r".*_(?P<surgeon>[A-Z])(?P<trial>\d{3})")


class Jigsaws:
    """The trials of one task.

    The control [14] is the motion of the surgeon's hands, which the robot repeats: for the left and the right hand
    velocity [3], angular velocity [3] and gripper angle of the master. Observations are position [3], rotation [9] and
    gripper angle [1] of each instrument. The instruments' velocities are left out: they are the control itself.
    ``labels/gesture`` is the place of a frame's gesture among those of the task, -1 for a frame without one.
    """

    format = "jigsaws"
    frequency: float | None = 30.0
    masks: Mapping[str, tuple[str, ...]] = {}

    def __init__(self, path: Path) -> None:
        trials = sorted((path / TRIALS).glob("*.txt"))
        self.names = tuple(f"demo_{number}" for number in range(len(trials)))
        self._trials = dict(zip(self.names, trials, strict=True))
        transcribed = {trial: path / "transcriptions" / trial.name for trial in trials}
        self._transcriptions = {trial: place for trial, place in transcribed.items() if place.is_file()}
        described = sorted(path.glob("meta_file_*.txt"))
        rows = [row.split() for place in described for row in place.read_text().splitlines()]
        self._about = {row[0]: row[1:] for row in rows if len(row) > 2}
        self.files = (*trials, *self._transcriptions.values(), *described)
        self._segments = {trial: _segments(place) for trial, place in self._transcriptions.items()}
        found = {gesture for segments in self._segments.values() for *_, gesture in segments}
        self._gestures = sorted(found, key=lambda gesture: (len(gesture), gesture))  # G2 before G11
        self.attributes: Mapping[str, Attribute] = {LABEL_NAMES: json.dumps({"gesture": self._gestures})}

    def recording(self, name: str) -> Recording:
        """One trial, with its surgeon's letter, its number, the self-stated skill and the rating as attributes.

        :raises DemonstrationsError: its file cannot be read.
        """
        trial = self._trials[name]
        try:
            rows = np.loadtxt(trial.read_text().splitlines(), ndmin=2) if trial.stat().st_size else np.empty((0, WIDTH))
        except ValueError as error:
            raise DemonstrationsError(f"{name}: {trial} is no table of numbers: {error}") from None
        if rows.shape[1] != WIDTH or not len(rows):
            width = f"has rows of {rows.shape[1]} numbers, where JIGSAWS has {WIDTH}" if rows.size else "is empty"
            raise DemonstrationsError(f"{name}: {trial} {width}")
        arms = rows.reshape(len(rows), -1, ARM)
        observations = {
            f"{hand}_{key}": arms[:, place, part]
            for hand, (_, place) in HANDS.items()
            for key, part in {"position": slice(3), "rotation": slice(3, 12), "gripper": slice(18, 19)}.items()
        }
        control = np.concatenate([arms[:, place, 12:] for place, _ in HANDS.values()], axis=1)
        gesture = np.full(len(rows), -1)
        for first, last, label in self._segments.get(trial, ()):
            gesture[first - 1 : last] = self._gestures.index(label)
        labels = {"gesture": gesture} if self._gestures else {}
        return Recording.of(name, observations, control, labels, self._facts(trial.stem))

    def _facts(self, trial: str) -> dict[str, Attribute]:
        facts: dict[str, Attribute] = {"file": trial}
        if named := TRIAL.fullmatch(trial):
            facts |= {"surgeon": named["surgeon"], "trial": int(named["trial"])}
        if about := self._about.get(trial):
            facts |= {"skill": about[0], "rating": float(about[1])}
        return facts


def _segments(path: Path) -> list[tuple[int, int, str]]:
    """The first frame, the last frame and the gesture of each segment in a transcription."""
    segments = []
    for number, row in enumerate(filter(None, map(str.split, path.read_text().splitlines())), 1):
        if len(row) != 3 or not (row[0].isdigit() and row[1].isdigit()) or not 0 < int(row[0]) <= int(row[1]):
            raise DemonstrationsError(f"{path}: row {number} is no FIRST LAST GESTURE: {' '.join(row)}")
        segments.append((int(row[0]), int(row[1]), row[2]))
    return segments
