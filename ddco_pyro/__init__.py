"""Discovery of deep continuous options (DDCO) as a Pyro model."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ddco_pyro import encoding as encoding
    from ddco_pyro import inference as inference
    from ddco_pyro.acting.controller import Controller as Controller
    from ddco_pyro.acting.monitor import Monitor as Monitor
    from ddco_pyro.cli.console import Progress as Progress
    from ddco_pyro.comparison import compare as compare
    from ddco_pyro.data.demonstrations import Demonstration as Demonstration
    from ddco_pyro.data.demonstrations import Demonstrations as Demonstrations
    from ddco_pyro.exporting import export as export
    from ddco_pyro.fitting.estimator import OptionSegmenter as OptionSegmenter
    from ddco_pyro.fitting.fit import fit as fit
    from ddco_pyro.fitting.fitted import Fit as Fit
    from ddco_pyro.fitting.fitted import load as load
    from ddco_pyro.inference.marginal import EliminatedAHMM as EliminatedAHMM
    from ddco_pyro.segmenting.segments import segment as segment
    from ddco_pyro.selection import select as select
    from ddco_pyro.spec import Spec as Spec
    from ddco_pyro.spec import load_spec as load_spec

_PLACES = {
    "Controller": "acting.controller",
    "Demonstration": "data.demonstrations",
    "Demonstrations": "data.demonstrations",
    "EliminatedAHMM": "inference.marginal",
    "Fit": "fitting.fitted",
    "Monitor": "acting.monitor",
    "OptionSegmenter": "fitting.estimator",
    "Progress": "cli.console",
    "Spec": "spec",
    "compare": "comparison",
    "export": "exporting",
    "fit": "fitting.fit",
    "load": "fitting.fitted",
    "load_spec": "spec",
    "segment": "segmenting.segments",
    "select": "selection",
}
_ROOMS = ("encoding", "inference")

__all__ = [*_PLACES, *_ROOMS]


def __getattr__(name: str) -> Any:
    """Import a public name on first use: torch takes seconds to import, and ``--help`` does not need it."""
    if name in _ROOMS:
        return importlib.import_module(f"ddco_pyro.{name}")
    if name in _PLACES:
        return getattr(importlib.import_module(f"ddco_pyro.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'ddco_pyro' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
