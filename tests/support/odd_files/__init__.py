"""Odd and hostile files, each with what commands say of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    make: Callable[[Path], Path]
    says: str | None
