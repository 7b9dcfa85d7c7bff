"""Networks of one's own, the only code that a spec can name and that making its model executes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ddco_pyro.spec.messages import SpecError
from ddco_pyro.spec.networks import SETTINGS
from ddco_pyro.spec.whole import Spec


def own_networks(spec: Spec) -> dict[str, str]:
    """Key path to ``module:Class`` of every network that is not this library's."""
    return dict(_own(spec.model_dump(), ""))


def refuse_own_networks(spec: Spec, path: str | Path, allowed: bool) -> None:
    """See to it that no code is executed that nobody allowed.

    :param path: the spec's file, for the message.
    :raises SpecError: the spec names a network of one's own, and that is not allowed.
    """
    for place, name in own_networks(spec).items():
        if not allowed:
            raise SpecError(
                f"{path}: {place}: {name!r} is code that would be executed; if you know it, allow it with --allow-code "
                "(in Python: allow_code=True)"
            )


def _own(data: Any, place: str) -> Iterator[tuple[str, str]]:
    if isinstance(data, dict):
        for key, value in data.items():
            below = f"{place}.{key}" if place else str(key)
            if str(key).rpartition(".")[2] == "network":  # the keys of a selection's grid are key paths
                names = value if isinstance(value, list | tuple) else [value]
                yield from ((below, name) for name in names if isinstance(name, str) and name not in SETTINGS)
            elif key != "options":  # keyword arguments of such a network
                yield from _own(value, below)
    elif isinstance(data, list | tuple):
        for number, value in enumerate(data):
            yield from _own(value, f"{place}.{number}")
