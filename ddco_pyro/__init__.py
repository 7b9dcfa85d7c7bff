"""Discovery of deep continuous options (DDCO) as a Pyro model."""

from ddco_pyro.controller import Controller
from ddco_pyro.demonstrations import Demonstration, Demonstrations
from ddco_pyro.run import Fit, load
from ddco_pyro.spec import Spec, load_spec

__all__ = ["Controller", "Demonstration", "Demonstrations", "Fit", "Spec", "load", "load_spec"]
