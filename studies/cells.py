"""Cells of a study: each is kept as JSON once it is done, and not done again by the same code and settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from provenance import Record, is_kept, text
from threadpoolctl import threadpool_limits

from ddco_pyro.data.files import write_text


def digest(settings: Mapping[str, Any]) -> str:
    """A folder's name for settings; others have others."""
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:8]


def kept(
    path: Path, settings: Mapping[str, Any], made_by: Record, work: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """A cell's provenance and results, as its JSON in ``path`` has them; ``work``, on one thread, is done only once.

    :param settings: what names the cell and decides its results; part of them.
    :param made_by: what was known of the code when the study began.
    """
    if path.exists():
        content: dict[str, Any] = json.loads(path.read_text())
        if is_kept(content, settings, made_by):
            return content
    torch.set_num_threads(1)
    with threadpool_limits(1):
        found = work()
    write_text(path, text({**settings, **found}, [made_by]))
    return dict(json.loads(path.read_text()))
