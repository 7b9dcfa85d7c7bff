"""Demonstrations of something that moves."""

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations


def made(number=8, size=3):
    rng = np.random.default_rng(0)
    demos = []
    for n in range(number):
        steps = 12 + n
        place = np.cumsum(rng.normal(size=(steps, size)), axis=0)
        phase = (np.arange(steps) >= steps // 2).astype(int)
        actions = np.where(phase[:, None], 1.0, -1.0) * place[:, :2] + 0.1 * rng.normal(size=(steps, 2))
        demos.append(Demonstration(f"demo_{n}", {"place": place}, actions, {"phase": phase}))
    return Demonstrations(tuple(demos))


def recorded(**keys):
    """Demonstrations of these observations, key to an array [T, ...] for each demonstration."""
    rows = [dict(zip(keys, values, strict=True)) for values in zip(*keys.values(), strict=True)]
    return Demonstrations(
        tuple(
            Demonstration(f"demo_{n}", row, np.sin(np.arange(len(row[next(iter(keys))]))[:, None]))
            for n, row in enumerate(rows)
        )
    )


def reaches(number=6, steps=40):
    """Smooth reaches from scattered starts by scattered ways: positions [T, 3] of each."""
    rng, time = np.random.default_rng(0), np.linspace(0, 1, steps)[:, None]
    eased = 10 * time**3 - 15 * time**4 + 6 * time**5
    return [rng.normal(size=3) + eased * 2 * rng.normal(size=3) for _ in range(number)]
