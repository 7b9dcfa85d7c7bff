"""Discovery of deep continuous options (DDCO) as a Pyro model."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ddco_pyro import encoding, inference
    from ddco_pyro.acting.controller import Controller
    from ddco_pyro.acting.monitor import Monitor
    from ddco_pyro.cli.console import Progress
    from ddco_pyro.comparison import compare
    from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
    from ddco_pyro.estimator import OptionSegmenter
    from ddco_pyro.exporting import export
    from ddco_pyro.fitting.fit import fit
    from ddco_pyro.fitting.fitted import Fit, load
    from ddco_pyro.inference.marginal import EliminatedAHMM
    from ddco_pyro.segmenting import segment
    from ddco_pyro.selection import select
    from ddco_pyro.spec import Spec, load_spec

_PLACES = {
    "Controller": "acting.controller",
    "Demonstration": "data.demonstrations",
    "Demonstrations": "data.demonstrations",
    "EliminatedAHMM": "inference.marginal",
    "Fit": "fitting.fitted",
    "Monitor": "acting.monitor",
    "OptionSegmenter": "estimator",
    "Progress": "cli.console",
    "Spec": "spec",
    "compare": "comparison",
    "export": "exporting",
    "fit": "fitting.fit",
    "load": "fitting.fitted",
    "load_spec": "spec",
    "segment": "segmenting",
    "select": "selection",
}
_ROOMS = ("encoding", "inference")

__all__ = [
    "Controller",
    "Demonstration",
    "Demonstrations",
    "EliminatedAHMM",
    "Fit",
    "Monitor",
    "OptionSegmenter",
    "Progress",
    "Spec",
    "compare",
    "encoding",
    "export",
    "fit",
    "inference",
    "load",
    "load_spec",
    "segment",
    "select",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use: torch takes seconds to import, and ``--help`` does not need it."""
    if name in _ROOMS:
        return importlib.import_module(f"ddco_pyro.{name}")
    if name in _PLACES:
        return getattr(importlib.import_module(f"ddco_pyro.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'ddco_pyro' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
