"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

A kind is a class of its own file, under the name that ``spec.Kind`` lists.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import get_args

import numpy as np

from ddco_pyro.model.emissions.base import Emission, Given, Information, Part
from ddco_pyro.model.emissions.binary import Binary
from ddco_pyro.model.emissions.categorical import Categorical
from ddco_pyro.model.emissions.clipped import Clipped
from ddco_pyro.model.emissions.gaussian import Gaussian
from ddco_pyro.model.emissions.hurdle import Hurdle
from ddco_pyro.model.emissions.product import Product
from ddco_pyro.spec import Kind

KINDS: dict[str, type[Emission]] = {
    kind: getattr(import_module(f"{__name__}.{kind}"), kind.capitalize())
    for kind in get_args(Kind)
    if kind != "auto"
}
"""The class of each kind of control part."""

CONTROLS: dict[str, Callable[[Part, np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]] = {
    kind: emission.control for kind, emission in KINDS.items()
}
"""The control of a caller by numpy alone, as :attr:`Emission.control` has it."""
