"""The networks of a hierarchy and the tables that they give: levels of options under a meta-policy (paper
§4).

A flat policy is a hierarchy without option levels, whose meta-policy emits the control.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ddco_pyro.data.controls import (
    ControlDimension,
    ControlPart,
    all_constant,
    all_gaussian,
    control_dimensions,
    control_parts,
    same,
)
from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.data.tasks import known_tasks
from ddco_pyro.model.batch import STEPS_AT_ONCE, Batch
from ddco_pyro.model.controls import ControlScaling, ControlStd
from ddco_pyro.model.encoder import ObservationEncoder, Shapes
from ddco_pyro.model.networks import Inputs, InputShape, Network, State, States, build, named
from ddco_pyro.model.networks.perceptrons import linear_maps
from ddco_pyro.model.networks.probe import training_bytes
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.recogniser import Recogniser
from ddco_pyro.model.seeding import HOST
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import LevelSpec, PolicySpec, Spec
from ddco_pyro.spec.networks import Network as AnyNetworkSpec
from ddco_pyro.spec.networks import PerTimestepSpec

BYTES_AT_ONCE = 256 * 10**6
"""Most bytes that networks take for the steps that go through them together, at least one step."""

NARROW = 1000
"""Networks that take fewer bytes for a step go through twice as many steps together: the cache has room."""

PART_OF_A_GPU = 0.1
"""Share of a GPU's whole memory that networks take in place of that, so that GPUs of one kind cut alike."""

TRUNK = "trunk"
"""The name of the trunk, and of its features as a vector that the other networks read."""

RawOutputs = Sequence[Tensor]
"""The outputs of networks [N, T, K, F]: policy and, where it has one, termination of each level, lowest
first, and the meta-policy's."""


@dataclass(frozen=True)
class Dimensions:
    """Shapes of the observations by name, control dimensions A, and steps of the longest demonstration.

    :param constant: control dimensions that are constant in all demonstrations, with their values; the model
        leaves them out.
    :param control: statistics of each control dimension in the demonstrations; empty where they are unknown.
    :param parts: the parts of the control in a fitted model; None before they are decided.
    :param tasks: of the numbers of the built-in observation ``task``.
    """

    shapes: Shapes
    control_size: int
    steps: int
    constant: Mapping[int, float] = field(default_factory=dict)
    control: tuple[ControlDimension, ...] = field(default=(), compare=False)
    parts: tuple[ControlPart, ...] | None = None
    tasks: tuple[str, ...] = ()

    @classmethod
    def of(cls, demonstrations: Demonstrations, relative_to: str | None = None) -> Dimensions:
        """The dimensions of these demonstrations.

        :param relative_to: the spec's ``control.relative_to``.
        :raises DemonstrationsError: every dimension of the control is constant.
        """
        control = control_dimensions({demo.name: demo.controls(relative_to) for demo in demonstrations})
        constant = {dimension.number: dimension.minimum for dimension in control if dimension.constant}
        if len(constant) == len(control):
            raise DemonstrationsError(all_constant(control))
        shapes, size = demonstrations.observation_shapes, demonstrations.control_size
        tasks = known_tasks(demonstrations.attributes)
        return cls(shapes, size, max(demonstrations.lengths), constant, control, tasks=tasks)

    def like(self, model: Hierarchy, name: str) -> Dimensions:
        """With the kinds of control of a fitted model, which is to be the prior of another one.

        :param name: of the model, for errors.
        :raises DemonstrationsError: observations or the control have other shapes, or a dimension varies here
            alone.
        """
        there = model.dimensions
        sizes = {f"obs/{key}": (tuple(self.shapes[key]), shape) for key, shape in there.shapes.items()}
        for place, (ours, theirs) in (sizes | {"actions": (self.control_size, there.control_size)}).items():
            if ours != theirs:
                raise DemonstrationsError(f"{place}: has shape {ours} at each step, and in {name} {theirs}")
        for dimension, value in there.constant.items():
            if not same(np.array(self.constant.get(dimension, np.nan)), np.array(value)):
                text = f"control dimension {dimension} is not always {value:g}, as in {name}"
                raise DemonstrationsError(f"{text}; the library's tasks have to vary it")
        return replace(self, steps=there.steps, constant=there.constant, parts=there.parts)


class Caller(nn.Module):
    """K policies over the options of the level below, the physical control, or both (§4.2).

    The outputs of their network are the log-probabilities y_0 (control), y_1, ..., y_k, then the numbers of
    the control, then y of every σ that depends on the state.
    """

    def __init__(
        self, policy: PolicySpec, options: int, shape: InputShape, scaling: ControlScaling, copies: int
    ) -> None:
        super().__init__()
        self.options, self.copies = options, copies
        self.emits_control = "control" in policy.emits
        self.emits_options = "options" in policy.emits and options > 0
        logits = options + self.emits_control if self.emits_options else 0
        std = ControlStd(scaling, copies) if self.emits_control else None
        of_state = 0 if std is None else len(std.of_state)
        self.sizes = (logits, scaling.numbers + of_state if self.emits_control else 0)
        self.network = build(policy, shape, sum(self.sizes), copies)
        if of_state:
            self.network.begin_at(of_state)
        self.std = std

    def forward(self, raw: Tensor, scaling: ControlScaling, std: Tensor | None = None) -> CallerOutputs:
        """The policies at every step, from the outputs of their network [N, T, K, F].

        :param std: σ, the result of :meth:`ControlStd.table`, if it is known.
        """
        logits, numbers = raw.split(self.sizes, dim=-1) if all(self.sizes) else (raw, raw)
        choices = logits if self.emits_options else None
        if self.std is None:
            return CallerOutputs(self.options, choices, None)
        of_state = len(self.std.of_state)
        means, of_std = numbers.split([scaling.numbers, of_state], dim=-1) if of_state else (numbers, None)
        return CallerOutputs(self.options, choices, scaling.emission(means, self.std(of_std, std)), numbers)


class Level(nn.Module):
    """The k options of one level: policies π (above the lowest level η) and terminations ψ.

    ``termination`` is None where every option ends after every step (ψ = 1).

    :param shape: of what its networks read.
    """

    def __init__(
        self, place: str, spec: LevelSpec, options_below: int, shape: InputShape, scaling: ControlScaling
    ) -> None:
        super().__init__()
        self.count = spec.count
        with named(f"{place}.policy"):
            self.policy = Caller(spec.policy, options_below, shape, scaling, spec.count)
        self.termination: Network | None = None
        if isinstance(spec.termination, AnyNetworkSpec):
            with named(f"{place}.termination"):
                self.termination = build(spec.termination, shape, 1, spec.count)


class Hierarchy(nn.Module):
    """Levels of options, lowest first, and the meta-policy on top.

    :ivar dimensions: of what the networks read, with the kinds of control as they are decided.
    :raises ShapeError: a network cannot read these observations.
    """

    power: Tensor
    """β of :class:`~ddco_pyro.model.tables.Tables`, a number."""

    def __init__(self, spec: Spec, dimensions: Dimensions) -> None:
        super().__init__()
        size, constant, steps = dimensions.control_size, dimensions.constant, dimensions.steps
        self.steps, self.device = steps, HOST
        self.encoder = ObservationEncoder(spec.observations, dimensions.shapes, dimensions.tasks)
        # nothing is latent in a flat policy
        power = spec.control.power if spec.hierarchy is not None else 1.0
        self.register_buffer("power", torch.tensor(power, dtype=torch.float64))
        parts = dimensions.parts
        if parts is None and dimensions.control:
            parts = control_parts(spec.control, dimensions.control)
        parts = all_gaussian([d for d in range(size) if d not in constant]) if parts is None else parts
        self.dimensions = replace(dimensions, shapes=self.encoder.shapes, parts=parts)
        self.scaling = scaling = ControlScaling(spec.control, size, dict(constant), parts)
        self.input_shape = self.encoder.shape(steps)
        self.trunk: Network | None = None
        if spec.hierarchy is not None and spec.hierarchy.trunk is not None:
            with named("hierarchy.trunk"):
                self.trunk = build(spec.hierarchy.trunk, self.input_shape, None, 1)
        shape = self.read_shape
        levels, below = [], 0
        for number, level in enumerate(spec.levels):
            levels.append(Level(f"hierarchy.levels.{number}", level, below, shape, scaling))
            below = level.count
        self.levels = nn.ModuleList(levels)
        with named("hierarchy.meta_policy" if levels else "baseline.policy"):
            self.meta_policy = Caller(_meta_policy(spec), below, shape, scaling, copies=1)
        self.recogniser: Recogniser | None = None
        if spec.hierarchy is not None and (labels := spec.training.labels) is not None and labels.recogniser:
            place = 1 + [each.name for each in spec.hierarchy.levels].index(labels.level)
            self.recogniser = Recogniser(
                place, levels[place - 1].count, self.input_shape, len(scaling.varying)
            )

    def place(self, device: torch.device) -> Hierarchy:
        """Move the networks alone to a device. Their callers give and get tensors on the host."""
        if device != self.device:
            _ = self.step_bytes  # counted on the host
            for network in self.networks().values():
                network.to(device)
            self.device = device
        return self

    @property
    def depth(self) -> int:
        """The number D of option levels."""
        return len(self.levels)

    def named_callers(self) -> dict[str, Caller]:
        """The policies of each level, lowest first, and the meta-policy, by place as in :meth:`networks`."""
        levels = {
            f"levels.{number}.policy": level.policy for number, level in enumerate(self.option_levels())
        }
        return levels | {"meta_policy": self.meta_policy}

    def option_levels(self) -> list[Level]:
        return [level for level in self.levels if isinstance(level, Level)]

    def networks(self) -> dict[str, Network]:
        """Every network by its place here, such as ``levels.0.policy``."""
        each = {} if self.trunk is None else {TRUNK: self.trunk}
        for number, level in enumerate(self.option_levels()):
            place = f"levels.{number}"
            each[f"{place}.policy"] = level.policy.network
            each |= {} if level.termination is None else {f"{place}.termination": level.termination}
        return each | {"meta_policy": self.meta_policy.network}

    def begin_terminations(self, logit: float = 0.0) -> None:
        """Have every ψ start at 1/2, or at a logit's value; those of a user's network keep their start."""
        for level in self.option_levels():
            if level.termination is not None:
                level.termination.begin_at(1, logit)

    @property
    def read_shape(self) -> InputShape:
        """The shapes of what all networks but the trunk read: the observations, or the trunk's features."""
        if self.trunk is None:
            return self.input_shape
        return InputShape({TRUNK: self.trunk.features}, {}, self.steps)

    @cached_property
    def step_bytes(self) -> int:
        """Bytes that all networks take for a step in training."""
        shapes = dict.fromkeys(self.networks().values(), self.read_shape)
        return training_bytes(shapes | ({} if self.trunk is None else {self.trunk: self.input_shape}))

    @property
    def steps_in_memory(self) -> int:
        """Most steps of a trajectory in a chunk of time, for training within the memory that is allowed."""
        most: float = BYTES_AT_ONCE
        if self.device.type == "cuda":
            most = PART_OF_A_GPU * torch.cuda.get_device_properties(self.device).total_memory
        return max(1, int(most) // max(1, self.step_bytes))

    @property
    def steps_at_once(self) -> int:
        """Most steps of several trajectories that go through the networks together."""
        return min(STEPS_AT_ONCE * (2 if self.step_bytes < NARROW else 1), self.steps_in_memory)

    def tabulate(self, batch: Batch) -> Tables:
        """The tables of a batch: every network once, over all options, steps and trajectories."""
        outputs: Outputs = self(batch.inputs)
        return outputs.tables(batch.actions)

    def recognised(self, tables: Tables, batch: Batch) -> Tables:
        """The tables of a batch with the evidence of the recogniser, where there is one."""
        if self.recogniser is None:
            return tables
        return tables.with_evidence(self.recogniser.level, self.recogniser.evidence(batch))

    def forward(self, inputs: Inputs, discovering: int | None = None) -> Outputs:
        """The outputs for these observations, which begin with the first step of their trajectories.

        Trajectories longer than :attr:`steps_in_memory` go through the networks in chunks of time. Only the
        raw outputs and the states between chunks are kept; for the gradient each chunk is computed again, the
        last first.

        :param discovering: d gives levels 1 to d alone under a uniform meta-policy (layer-wise training, SM
            2.3).
        """
        chunks = list(inputs.chunks(self.steps_in_memory // inputs.batch[0]))
        if len(chunks) == 1:
            return self._outputs(self._run_networks(inputs, None, discovering)[0], discovering)
        each: list[RawOutputs] = []
        states: States | None = None
        there = torch.empty(0, device=self.device)  # checkpoint draws again the random numbers of this device
        for chunk in chunks:
            raw, states = checkpoint(
                self._run_networks, chunk, states, discovering, there, use_reentrant=False
            )
            each.append(raw)
        return self._outputs([torch.cat(parts, dim=1) for parts in zip(*each, strict=True)], discovering)

    def advance(self, inputs: Inputs, states: States | None) -> tuple[Outputs, dict[str, State]]:
        """The outputs for these observations, and the networks' states after them, by :meth:`networks`'
        names.

        :param states: after the observations before; None at the first step.
        """
        raw, after = self._run_networks(inputs, states)
        return self._outputs(raw), after

    def initial_states(self, trajectories: int) -> dict[str, State]:
        """The states of all networks before the first step, by :meth:`networks`' names."""
        return {place: network.initial_state(trajectories) for place, network in self.networks().items()}

    def _run_networks(
        self, inputs: Inputs, before: States | None, discovering: int | None = None, _: Tensor | None = None
    ) -> tuple[RawOutputs, dict[str, State]]:
        """The networks' outputs, on the host, and their states after them, on the networks' device."""
        inputs, states = inputs.loaded().to(self.device), before or self.initial_states(inputs.batch[0])
        after: dict[str, State] = {}
        raw: list[Tensor] = []
        linear = linear_maps(self.networks(), inputs) if self.trunk is None else {}

        def run(place: str, network: Network, seen: Inputs) -> Tensor:
            output, after[place] = (linear[place], ()) if place in linear else network(seen, states[place])
            return output

        read = inputs
        if self.trunk is not None:
            read = Inputs({TRUNK: run(TRUNK, self.trunk, inputs).squeeze(2)}, {}, inputs.time)
        for number, level in enumerate(self.option_levels()[:discovering]):
            place = f"levels.{number}"
            raw.append(run(f"{place}.policy", level.policy.network, read))
            if level.termination is not None:
                raw.append(run(f"{place}.termination", level.termination, read))
        if not discovering:
            raw.append(run("meta_policy", self.meta_policy.network, read))
        return [output.to(HOST) for output in raw], after

    def _outputs(self, raw: RawOutputs, discovering: int | None = None) -> Outputs:
        """The outputs as logits and emissions of each level."""
        levels, each = self.option_levels()[:discovering], iter(raw)
        callers, endings = [], []
        for level in levels:
            callers.append(level.policy(next(each), self.scaling))
            endings.append(None if level.termination is None else next(each).squeeze(-1))
        if discovering:  # under a meta-policy that selects each option with the same probability
            count = levels[-1].count
            last = CallerOutputs(count, torch.zeros(*raw[-1].shape[:2], 1, count), None)
        else:
            last = self.meta_policy(raw[-1], self.scaling)
        return Outputs((*callers, last), tuple(endings), self.power)


def _meta_policy(spec: Spec) -> PolicySpec:
    """The meta-policy, or the flat policy, which emits the control."""
    if spec.hierarchy is not None:
        return spec.hierarchy.meta_policy
    assert spec.baseline is not None  # a spec has one or the other
    policy = spec.baseline.policy
    if spec.baseline.kind == "per_timestep":
        kept = {"hidden": ()} | policy.model_dump(exclude={"network"})  # a linear policy has no hidden layers
        policy = PerTimestepSpec(network="per_timestep", **kept)
    return policy.model_copy(update={"emits": ("control",)})
