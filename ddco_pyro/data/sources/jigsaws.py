"""JIGSAWS, surgeons' demonstrations on a da Vinci robot (Gao and others 2014), in its official text files.

A task's folder has ``kinematics/AllGestures/NAME.txt``, one row of 76 numbers for each frame, 30 frames a
second; ``transcriptions/NAME.txt``, rows ``FIRST LAST GESTURE`` whose frames count from 1, the last one
included; and ``meta_file_TASK.txt``, a row of a name, a self-stated skill and a rating for each trial.

A row has 19 numbers for each of four arms: position [3] in m, rotation matrix [9], velocity [3] in m/s,
angular velocity [3] in rad/s, and the gripper's angle in rad. The order is master left, master right, and the
instruments that the files' own documentation calls slave left and slave right. The left master drives the
*last* instrument: each displacement of that one is half the master's. Arms are named by the surgeon's hand.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstration import Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.labels import LABEL_NAMES
from ddco_pyro.data.sources import Source

WIDTH, ARM = 76, 19
"""Numbers of a frame, and of an arm in it."""

HANDS = {"left": (0, 3), "right": (1, 2)}
"""The master and the instrument of each hand, by their place in a row."""

PARTS = {"position": slice(3), "rotation": slice(3, 12), "gripper": slice(18, 19)}
"""What is observed of an instrument, by its place in the numbers of an arm."""

TRIAL = re.compile(r".*_(?P<surgeon>[A-Z])(?P<trial>\d{3})")


def open_jigsaws(path: Path) -> Iterator[Source]:
    """The trials of one task.

    The control [14] is the motion of the surgeon's hands, which the robot repeats: for the left and the right
    hand velocity [3], angular velocity [3] and gripper angle of the master. Observations are position [3],
    rotation [9] and gripper angle [1] of each instrument. The instruments' velocities are left out: they are
    the control itself. ``labels/gesture`` is the place of a frame's gesture among those of the task, -1 for a
    frame without one. Attributes are the surgeon's letter, the trial's number, the self-stated skill, rating.

    :raises DemonstrationsError: a transcription cannot be read; at reading a trial, its file cannot.
    """
    files = sorted((path / "kinematics/AllGestures").glob("*.txt"))
    trials = {f"demo_{n}": trial for n, trial in enumerate(files)}
    transcriptions = [path / "transcriptions" / trial.name for trial in trials.values()]
    described = sorted(path.glob("meta_file_*.txt"))
    segments = {place.name: _segments(place) for place in transcriptions if place.is_file()}
    found = {gesture for each in segments.values() for *_, gesture in each}
    gestures = sorted(found, key=lambda gesture: (len(gesture), gesture))  # G2 before G11
    rows = [row.split() for place in described for row in place.read_text().splitlines()]
    about = {row[0]: row[1:] for row in rows if len(row) > 2}

    def read(name: str) -> Demonstration:
        trial = trials[name]
        arms = _arms(trial, name)
        observations = dict[str, np.ndarray]()
        for hand, (_, place) in HANDS.items():
            observations |= {f"{hand}_{key}": arms[:, place, part] for key, part in PARTS.items()}
        control = np.concatenate([arms[:, place, 12:] for place, _ in HANDS.values()], axis=1)
        gesture = np.full(len(arms), -1)
        for first, last, label in segments.get(trial.name, ()):
            gesture[first - 1 : last] = gestures.index(label)
        facts: dict[str, Attribute] = {"file": trial.stem}
        if named := TRIAL.fullmatch(trial.stem):
            facts |= {"surgeon": named["surgeon"], "trial": int(named["trial"])}
        if said := about.get(trial.stem):
            facts |= {"skill": said[0], "rating": float(said[1])}
        labels = {"gesture": gesture} if gestures else {}
        return Demonstration.stored(name, observations, control, labels, facts)

    yield Source(tuple(trials), read, {}, 30.0, {LABEL_NAMES: json.dumps({"gesture": gestures})})


def _arms(trial: Path, name: str) -> np.ndarray:
    """The numbers of each arm in each frame, [T, 4, 19]."""
    try:
        lines = trial.read_text().splitlines()
        rows = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, WIDTH))
    except ValueError as error:
        raise DemonstrationsError(f"{name}: {trial} is no table of numbers: {error}") from None
    if rows.shape[1] != WIDTH or not len(rows):
        width = f"has rows of {rows.shape[1]} numbers, where JIGSAWS has {WIDTH}" if rows.size else "is empty"
        raise DemonstrationsError(f"{name}: {trial} {width}")
    return rows.reshape(len(rows), -1, ARM)


def _segments(path: Path) -> list[tuple[int, int, str]]:
    """The first frame, the last frame and the gesture of each segment in a transcription."""
    segments = []
    for number, row in enumerate(filter(None, map(str.split, path.read_text().splitlines())), 1):
        if len(row) != 3 or not (row[0].isdigit() and row[1].isdigit()) or not 0 < int(row[0]) <= int(row[1]):
            raise DemonstrationsError(f"{path}: row {number} is no FIRST LAST GESTURE: {' '.join(row)}")
        segments.append((int(row[0]), int(row[1]), row[2]))
    return segments
