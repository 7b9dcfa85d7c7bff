"""Discovery of deep continuous options (DDCO) as a Pyro model."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ddco_pyro import encoding, inference
    from ddco_pyro.acting.controller import Controller
    from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
    from ddco_pyro.fitting.fit import Fit, fit, load
    from ddco_pyro.spec import Spec, load_spec

__all__ = [
    "Controller",
    "Demonstration",
    "Demonstrations",
    "Fit",
    "Spec",
    "encoding",
    "fit",
    "inference",
    "load",
    "load_spec",
]

_MODULES = {
    "Controller": "acting.controller",
    "Demonstration": "data.demonstrations",
    "Demonstrations": "data.demonstrations",
    "Fit": "fitting.fit",
    "Spec": "spec",
    "fit": "fitting.fit",
    "load": "fitting.fit",
    "load_spec": "spec",
}


def __getattr__(name: str) -> Any:
    """Imports what is asked for when it is asked for: torch takes seconds, and ``--help`` needs none of it."""
    if name in ("encoding", "inference"):
        return importlib.import_module(f"ddco_pyro.{name}")
    if name in _MODULES:
        return getattr(importlib.import_module(f"ddco_pyro.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'ddco_pyro' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
