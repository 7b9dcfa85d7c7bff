"""Seeds of torch's random numbers, on the host and on the networks' device.

``torch.manual_seed`` would seed the generators of all GPUs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

HOST = torch.device("cpu")
"""The device of tables, inference and emissions; only networks can be on another."""


def seed(value: int, device: torch.device = HOST) -> None:
    """Seed the generators of the host and of ``device``."""
    torch.default_generator.manual_seed(value)
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.manual_seed(value)


@contextmanager
def seeded(value: int, device: torch.device = HOST) -> Iterator[None]:
    """Seed the generators within the block, and restore them afterwards."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        seed(value, device)
        yield
