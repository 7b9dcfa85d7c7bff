"""torch's random numbers by a seed, on the host and on the device that networks are on, and on no other.

``torch.manual_seed`` seeds the generators of all GPUs, also where nothing is drawn there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

HOST = torch.device("cpu")
"""Where everything but networks is: tables, inference, emissions and their spreads."""


def seed(value: int, device: torch.device = HOST) -> None:
    """What is drawn from here on, on the host and on ``device``, follows from ``value``."""
    torch.default_generator.manual_seed(value)
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.manual_seed(value)


@contextmanager
def seeded(value: int, device: torch.device = HOST) -> Iterator[None]:
    """The same inside; behind it, generators are as they were."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        seed(value, device)
        yield
