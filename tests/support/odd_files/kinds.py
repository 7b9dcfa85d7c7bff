"""Files that are in order as HDF5 and odd in what they hold: masks, labels, layouts of pictures, controls."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from odd_files import Row

NUMBER = 5
"""Demonstrations of a file."""

Arrays = dict[str, Any]
Change = Callable[[Arrays, int], None]
Masks = dict[str, list[bytes]]


def arrays(number: int) -> Arrays:
    """Those of an ordinary demonstration: the control drives ``pose`` to the origin."""
    noise = np.random.default_rng(number)
    steps = 6 + number % 3
    pose = noise.normal(size=(steps, 3))
    return {"actions": -pose[:, :2] + 0.1 * noise.normal(size=(steps, 2)), "obs/pose": pose}


def write(path: Path, change: Change | None = None, masks: Masks | None = None, number: int = NUMBER) -> Path:
    """A file of demonstrations ``demo_0``, ``demo_1``, ..., each of them changed."""
    with h5py.File(path, "w") as file:
        for index in range(number):
            made = arrays(index)
            if change is not None:
                change(made, index)
            for place, values in made.items():
                file[f"data/demo_{index}/{place}"] = values
        for mask, names in (masks or {}).items():
            file[f"mask/{mask}"] = np.array(names, dtype="S")
    return path


def _row(change: Change | None = None, says: str | None = None, **more: Any) -> Row:
    return Row(lambda folder: write(folder / "demos.hdf5", change, **more), says)


def put(place: str, values: Callable[[int, int], Any]) -> Change:
    """A change: at ``place`` are these values of (steps, number of the demonstration)."""

    def change(made: Arrays, number: int) -> None:
        made[place] = values(len(made["actions"]), number)

    return change


def alone(place: str, values: Callable[[int, int], Any]) -> Change:
    """The same, and no other observation."""

    def change(made: Arrays, number: int) -> None:
        put(place, values)(made, number)
        del made["obs/pose"]

    return change


def padded(made: Arrays, number: int) -> None:
    for place, values in made.items():
        made[place] = np.concatenate([values, np.repeat(values[-1:], 4, axis=0)])


def twins(made: Arrays, number: int) -> None:
    if number == NUMBER - 1:
        made.update(arrays(0))


def leaked(made: Arrays, number: int) -> None:
    made["obs/command"] = made["actions"].astype(np.float32)


def only_leaked(made: Arrays, number: int) -> None:
    leaked(made, number)
    del made["obs/pose"]


def with_switch(values: Callable[[int, int], Any]) -> Change:
    """A third control dimension with these values of (steps, number of the demonstration)."""

    def change(made: Arrays, number: int) -> None:
        switch = np.asarray(values(len(made["actions"]), number), dtype=float)
        made["actions"] = np.column_stack([made["actions"].astype(float), switch])

    return change


def _half(steps: int) -> np.ndarray:
    return np.arange(steps) < steps // 2


def _another_size(made: Arrays, number: int) -> None:
    leaked(made, number)
    made["actions"] = made["actions"][:, : 2 - (number == 2)]


def _huge(made: Arrays, number: int) -> None:
    made["actions"] = made["actions"].astype(np.float32)
    made["obs/huge"] = np.full((len(made["actions"]), 1), 1e39 + number)


def one_step(made: Arrays, number: int) -> None:
    for place, values in made.items():
        made[place] = values[:1]


def _integers(steps: int, number: int, least: int, most: int, columns: int | None = 1) -> np.ndarray:
    size = steps if columns is None else (steps, columns)
    drawn = np.random.default_rng(number).integers(least, most + 1, size)
    if columns is None:
        drawn[: most + 1 - least] = np.arange(least, most + 1)[:steps]
    return drawn


def _bytes(*shape: int, dtype: str = "u1") -> Callable[[int, int], np.ndarray]:
    high = np.iinfo(dtype).max
    random = np.random.default_rng
    return lambda steps, number: random(number).integers(0, high, (steps, *shape)).astype(dtype)


ROWS: dict[str, Row] = {
    # --- which demonstrations there are to train with and to validate with
    "masks overlap": _row(
        says="demo_1 is in mask/train and in mask/valid",
        masks={"train": [b"demo_0", b"demo_1", b"demo_2"], "valid": [b"demo_1", b"demo_3"]},
    ),
    "a mask names a stranger": _row(
        says="valid: there is no demonstration 'demo_9'", masks={"valid": [b"demo_9"]}
    ),
    "an empty mask": _row(says="no demonstration is left to validate with", masks={"valid": []}),
    "a mask of all": _row(
        says="no demonstration is left to train with",
        masks={"valid": [b"demo_%d" % n for n in range(NUMBER)]},
    ),
    "one to train with": _row(
        says="1 demonstration is left to train with", masks={"train": [b"demo_1"], "valid": [b"demo_2"]}
    ),
    "one demonstration": _row(says="holds 1 demonstration", number=1),
    # --- labels
    "labels of a column": _row(put("labels/phase", lambda steps, number: _half(steps)[:, None].astype(int))),
    "labels of text": _row(put("labels/phase", lambda steps, number: [b"reach"] * steps)),
    "labels in some demonstrations": _row(
        lambda made, number: (
            put("labels/phase", lambda steps, n: _half(steps).astype(int))(made, number) if number else None
        )
    ),
    # --- pictures
    "channels first": _row(put("obs/camera", _bytes(3, 12, 10))),
    "grey": _row(put("obs/camera", _bytes(12, 10))),
    "grey alone": _row(alone("obs/camera", _bytes(12, 10))),
    "16-bit depth": _row(put("obs/depth", _bytes(12, 10, dtype="u2"))),
    "16-bit depth alone": _row(
        alone("obs/depth", _bytes(12, 10, dtype="u2")), says="no observation can be used"
    ),
    # --- controls
    "integers -1, 0, 1": _row(put("actions", lambda steps, number: _integers(steps, number, -1, 1))),
    "integers [T]": _row(put("actions", lambda steps, number: _integers(steps, number, 0, 3, None))),
    "integers of two columns": _row(put("actions", lambda steps, number: _integers(steps, number, -1, 2, 2))),
    "floats [T]": _row(
        put("actions", lambda steps, number: _half(steps).astype("f4")),
        says=r"actions is float32 of shape \[steps\]",
    ),
    "a switch padded by zeros": _row(
        with_switch(lambda steps, n: np.where(np.arange(steps) < steps - 2, np.where(_half(steps), -1, 1), 0))
    ),
    "two conventions of a switch": _row(
        with_switch(lambda steps, number: np.where(_half(steps), -1 if number < 3 else 0, 1))
    ),
    "controls of another size in one": _row(
        _another_size, says=r"actions (is in 4 of 5 demonstra|has shape \(1,\))"
    ),
    "a number that single precision does not hold": _row(_huge),
    "no control that moves": _row(
        put("actions", lambda steps, number: np.ones((steps, 2))), says="every dimension is constant"
    ),
    # --- what is there twice
    "equal tails": _row(padded),
    "a demonstration twice": _row(twins),
    "an observation that is the control": _row(leaked),
    "nothing but the control": _row(only_leaked, says="no observation can be used"),
    "demonstrations of one step": _row(one_step),
}
