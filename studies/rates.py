"""How a rate, as :func:`ddco_pyro.simulation.episodes.rate` gives it, stands on a page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def shown(rate: Mapping[str, Any]) -> str:
    """A rate with its counts and 95 % interval; a dash where nothing was tried."""
    if not rate["trials"]:
        return "-"
    low, high = rate["interval"]
    return f"{rate['rate']:.1%} ({rate['successes']} of {rate['trials']}; {low:.1%} to {high:.1%})"
