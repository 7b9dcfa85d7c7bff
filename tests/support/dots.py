"""Demonstrations of a dot that moves through pictures, and where it is."""

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations

SIZE, STEPS = 20, 8


def dots(places):
    """Pictures [T, H, W, 2] of a dot at places [T, 2] from -1 to 1, on a grey ground."""
    axis = np.linspace(-1, 1, SIZE)
    distance = (axis[:, None] - places[:, :1, None]) ** 2 + (axis - places[:, 1:, None]) ** 2
    return np.stack([255 * np.exp(-distance / 0.03), np.full_like(distance, 80)], -1).astype(np.uint8)


def followed(number, seed=0):
    """A dot moves along a line through a picture; ``place`` is where it is, from -1 to 1."""
    random, demos = np.random.default_rng(seed), []
    for n in range(number):
        steps = STEPS + n % 3
        place = np.linspace(*random.uniform(-0.8, 0.8, (2, 2)), steps)
        pictures = dots(place)
        observations = {"camera": pictures, "other": pictures[:, ::5, ::5], "place": place}
        labels = {"phase": np.arange(steps) % 2}
        demos.append(Demonstration(f"demo_{n}", observations, place[:, ::-1], labels, {"seed": n}))
    names = [demo.name for demo in demos]
    split = {"train": tuple(names[: -number // 4]), "valid": tuple(names[-number // 4 :])}
    return Demonstrations(tuple(demos), split, {"task": "dots", "control_frequency": 20})


def together(demos, key):
    """An observation of all demonstrations, one after the other."""
    return np.concatenate([demo.observations[key] for demo in demos])
