"""The declarative spec: YAML in, one frozen and fully validated :class:`Spec` out. Nothing else reads YAML.

An unknown key, a wrong type or a value out of range is a :class:`SpecError` with one line for each problem.
"""

from ddco_pyro.spec.hierarchy import BaselineSpec, HierarchySpec, LevelSpec
from ddco_pyro.spec.messages import SpecError
from ddco_pyro.spec.networks import Activation, ConvolutionLayer, MetaPolicySpec, NetworkSpec, PolicySpec, Pool
from ddco_pyro.spec.reading import dump_spec, load_spec, spec_schema
from ddco_pyro.spec.settings import (
    STEP,
    AugmentSpec,
    ControlSpec,
    DemonstrationsSpec,
    InferenceSpec,
    LearnedStd,
    ObservationSpec,
    OptionExecution,
    PartSpec,
    ReportSpec,
    RolloutSpec,
    SelectionSpec,
)
from ddco_pyro.spec.training import DurationSpec, LabelsSpec, OptimizerSpec, RidgeSpec, TrainingSpec
from ddco_pyro.spec.user_code import user_code
from ddco_pyro.spec.whole import Spec, parse_spec, with_overrides

__all__ = [
    "STEP",
    "Activation",
    "AugmentSpec",
    "BaselineSpec",
    "ControlSpec",
    "ConvolutionLayer",
    "DemonstrationsSpec",
    "DurationSpec",
    "HierarchySpec",
    "InferenceSpec",
    "LabelsSpec",
    "LearnedStd",
    "LevelSpec",
    "MetaPolicySpec",
    "NetworkSpec",
    "ObservationSpec",
    "OptimizerSpec",
    "OptionExecution",
    "PartSpec",
    "PolicySpec",
    "Pool",
    "ReportSpec",
    "RidgeSpec",
    "RolloutSpec",
    "SelectionSpec",
    "Spec",
    "SpecError",
    "TrainingSpec",
    "dump_spec",
    "load_spec",
    "parse_spec",
    "spec_schema",
    "user_code",
    "with_overrides",
]
