"""The declarative spec: YAML in, one frozen and validated :class:`Spec` out.

An unknown key, a wrong type or a value out of range is a :class:`SpecError` with one line for each problem.
"""

from ddco_pyro.spec.base import SpecError
from ddco_pyro.spec.model import BaselineSpec, HierarchySpec, LevelSpec
from ddco_pyro.spec.networks import Activation, ConvolutionLayer, NetworkSpec, PolicySpec, Pool
from ddco_pyro.spec.settings import (
    DISCRETE,
    EACH,
    STEP,
    TASK,
    ControlSpec,
    DemonstrationsSpec,
    Kind,
    LearnedStd,
    ObservationSpec,
    OptionExecution,
    PathSpec,
    RolloutSpec,
)
from ddco_pyro.spec.spec import Spec, parse_spec, with_overrides
from ddco_pyro.spec.training import OptimizerSpec, RidgeSpec, Start, TrainingSpec
from ddco_pyro.spec.yaml import dump_spec, load_spec, spec_schema, user_code
