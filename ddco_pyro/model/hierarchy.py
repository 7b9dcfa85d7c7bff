"""The networks of a hierarchy and the tables they give: levels of options under a meta-policy (paper §4).

A baseline is a hierarchy without option levels whose meta-policy emits control.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ddco_pyro.data.controls import ControlPart, all_gaussian
from ddco_pyro.data.memory import share
from ddco_pyro.model.controls import ControlScaling, ControlStd
from ddco_pyro.model.encoding import STEPS_AT_ONCE, Batch, ObservationEncoder, Shapes
from ddco_pyro.model.networks import Inputs, InputShape, begin_at_zero, build, build_trunk, named
from ddco_pyro.model.networks.activations import training_bytes
from ddco_pyro.model.networks.state import Carried, State, States, Trunk, remembers
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.seeding import HOST
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import ControlSpec, LevelSpec, NetworkSpec, Spec
from ddco_pyro.spec.networks import Network, PerTimestepSpec

BYTES_AT_ONCE = 256 * 10**6
"""Most bytes that networks take for the steps that go through them together, one step at least; less where less memory
is allowed (:func:`ddco_pyro.data.memory.share`)."""

PART_OF_A_GPU = 0.1
"""The same of the memory of a GPU, whatever else is there: GPUs of one kind cut alike."""

Emits = Literal["options", "control"]

Answers = Sequence[Tensor]
"""The outputs of networks [N, T, K, F]: policy and, where it has one, termination of each level, lowest first, and the
meta-policy's."""


class Caller(nn.Module):
    """K policies over the options of the level below, the physical control, or both (§4.2).

    One network gives the log-probabilities y_0 (control), y_1, ..., y_k and the numbers of the control of each; last
    come those of every σ that depends on the state.
    """

    def __init__(
        self,
        network: NetworkSpec,
        emits: tuple[Emits, ...],
        options: int,
        shape: InputShape | Trunk,
        control: ControlSpec,
        scaling: ControlScaling,
        copies: int,
    ) -> None:
        super().__init__()
        self.options = options
        self.emits_control = "control" in emits
        self.emits_options = "options" in emits and options > 0
        logits = options + self.emits_control if self.emits_options else 0
        std = ControlStd(control, scaling, copies) if self.emits_control else None
        seen = 0 if std is None else len(std.seen)
        self.sizes = (logits, scaling.numbers + seen if self.emits_control else 0)
        self.network = build(network, shape, sum(self.sizes), copies)
        if seen:
            begin_at_zero(self.network, seen)
        self.std = std

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        """Models that have a σ also where no control is emitted are read without it."""
        if self.std is None:
            for name in [name for name in state_dict if name.startswith(f"{prefix}std.")]:
                del state_dict[name]
        super()._load_from_state_dict(state_dict, prefix, *others)

    def forward(self, said: Tensor, scaling: ControlScaling) -> CallerOutputs:
        """What the callers say at every step, given what their network says, [N, T, K, outputs]."""
        logits, numbers = said.split(self.sizes, dim=-1) if all(self.sizes) else (said, said)
        choices = logits if self.emits_options else None
        if self.std is None:
            return CallerOutputs(self.options, choices, None)
        seen = len(self.std.seen)
        means, of_std = numbers.split([scaling.numbers, seen], dim=-1) if seen else (numbers, None)
        return CallerOutputs(self.options, choices, scaling.emission(means, self.std(of_std)), numbers)


class Level(nn.Module):
    """The k options of one level: their policies π (or, above the lowest level, η) and terminations ψ, which read the
    observations, or the features of a trunk that they share.

    ``termination`` is None where every option ends after every step (ψ = 1).

    :param shape: of the observations, or the hierarchy's trunk.
    """

    def __init__(
        self,
        place: str,
        spec: LevelSpec,
        options_below: int,
        shape: InputShape | Trunk,
        control: ControlSpec,
        scaling: ControlScaling,
    ) -> None:
        super().__init__()
        self.count = spec.count
        seen = shape
        if spec.trunk is not None:
            with named(f"{place}.trunk"):
                seen = build_trunk(spec.trunk, shape, spec.count)
        self.trunk = seen.network if isinstance(seen, Trunk) and seen is not shape else None
        with named(f"{place}.policy"):
            self.policy = Caller(spec.policy, spec.policy.emits, options_below, seen, control, scaling, spec.count)
        self.termination: nn.Module | None = None
        if isinstance(spec.termination, Network):
            with named(f"{place}.termination"):
                self.termination = build(spec.termination, seen, 1, spec.count)


class Hierarchy(nn.Module):
    """Levels of options, lowest first, and the meta-policy on top.

    :param shapes: shapes of the observations by name, without time.
    :param control_size: A, the number of control dimensions.
    :param steps: the longest demonstration, for per-timestep networks.
    :param constant: the control dimensions that are no part of the model, and the values that are emitted for them.
    :param parts: how the other control dimensions are modelled; by default all of them are Gaussian.
    :raises ShapeError: where a network cannot read these observations.
    :raises SpecError: where a user's network does not take its options.
    """

    def __init__(
        self,
        spec: Spec,
        shapes: Shapes,
        control_size: int,
        steps: int,
        constant: Mapping[int, float] = MappingProxyType({}),
        parts: tuple[ControlPart, ...] | None = None,
    ) -> None:
        super().__init__()
        self.steps, self.device = steps, HOST
        self._reduced = spec.training.precision == "bfloat16"
        self.encoder = ObservationEncoder(spec.observations, shapes)
        varying = [dimension for dimension in range(control_size) if dimension not in constant]
        parts = all_gaussian(varying) if parts is None else parts
        self.scaling = scaling = ControlScaling(spec.control, control_size, dict(constant), parts)
        self.input_shape = seen = self.encoder.shape(steps)
        shape: InputShape | Trunk = seen
        if spec.hierarchy is not None and spec.hierarchy.trunk is not None:
            with named("hierarchy.trunk"):
                shape = build_trunk(spec.hierarchy.trunk, seen, 1)
        self.trunk = shape.network if isinstance(shape, Trunk) else None
        levels, below = [], 0
        for number, level in enumerate(spec.hierarchy.levels if spec.hierarchy else ()):
            levels.append(Level(f"hierarchy.levels.{number}", level, below, shape, spec.control, scaling))
            below = level.count
        self.levels = nn.ModuleList(levels)
        network, emits = _meta_policy(spec)
        with named("hierarchy.meta_policy" if levels else "baseline.policy"):
            self.meta_policy = Caller(network, emits, below, shape, spec.control, scaling, copies=1)

    def place(self, device: torch.device) -> Hierarchy:
        """Have the networks, and nothing else, on a device. Whatever calls them gives and gets tensors on the host."""
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

    def callers(self) -> list[Caller]:
        """Who chooses: the policies of each level, lowest first, and the meta-policy."""
        return [*(level.policy for level in self.option_levels()), self.meta_policy]

    def option_levels(self) -> list[Level]:
        """The levels of options, lowest first."""
        return [level for level in self.levels if isinstance(level, Level)]

    def networks(self) -> dict[str, nn.Module]:
        """Every network by its place here."""
        each: dict[str, nn.Module] = {} if self.trunk is None else {"trunk": self.trunk}
        for number, level in enumerate(self.option_levels()):
            if level.trunk is not None:
                each[f"levels.{number}.trunk"] = level.trunk
            each[f"levels.{number}.policy"] = level.policy.network
            if level.termination is not None:
                each[f"levels.{number}.termination"] = level.termination
        return each | {"meta_policy": self.meta_policy.network}

    def named_networks(self) -> Iterator[tuple[str, nn.Module]]:
        """Every network by its place in the spec."""
        if self.trunk is not None:
            yield "hierarchy.trunk", self.trunk
        for number, level in enumerate(self.option_levels()):
            if level.trunk is not None:
                yield f"hierarchy.levels.{number}.trunk", level.trunk
            yield f"hierarchy.levels.{number}.policy", level.policy
            if level.termination is not None:
                yield f"hierarchy.levels.{number}.termination", level.termination
        yield "hierarchy.meta_policy" if self.depth else "baseline.policy", self.meta_policy

    @cached_property
    def step_bytes(self) -> int:
        """Bytes that all networks take for a step in training."""
        return training_bytes(self.networks().values(), self.input_shape)

    @property
    def steps_in_memory(self) -> int:
        """Steps that networks can be trained on at a time: longer trajectories are processed in chunks of time."""
        return max(1, int(_bytes_at_once(self.device)) // max(1, self.step_bytes))

    @property
    def steps_at_once(self) -> int:
        """Steps of several trajectories that go through the networks together, where these are short enough."""
        return min(STEPS_AT_ONCE, self.steps_in_memory)

    def forward(self, inputs: Inputs, discovering: int | None = None) -> Outputs:
        """What the networks say about these observations, from the first step of their trajectories on.

        What is too long for :attr:`steps_in_memory` goes through them in chunks of time, of which nothing is kept but
        the answers and the states between; for the gradient, each chunk is computed again, the last first.

        :param discovering: d gives levels 1 to d alone under a uniform meta-policy (layer-wise training, SM 2.3).
        """
        chunks = self.chunks(inputs)
        if len(chunks) == 1:
            return self.advance(inputs, None, discovering)[0]
        answers: list[Answers] = []
        states: States | None = None
        there = torch.empty(0, device=self.device)  # the device whose random numbers are drawn again
        for chunk in chunks:
            said, states = checkpoint(self._answers, chunk, states, discovering, there, use_reentrant=False)
            answers.append(said)
        return self._outputs([torch.cat(each, dim=1) for each in zip(*answers, strict=True)], discovering)

    def chunks(self, inputs: Inputs) -> list[Inputs]:
        """The chunks of time in which they go through the networks; a single one where they are short enough."""
        return list(inputs.chunks(self.steps_in_memory // inputs.batch[0]))

    def advance(
        self, inputs: Inputs, states: States | None, discovering: int | None = None
    ) -> tuple[Outputs, dict[str, State]]:
        """What the networks say about these observations, and their states after them, by :meth:`networks`' names.

        :param states: those after the observations before; None at the first step.
        """
        answers, after = self._answers(inputs, states, discovering)
        return self._outputs(answers, discovering), after

    def _answers(
        self, inputs: Inputs, states: States | None, discovering: int | None, _: Tensor | None = None
    ) -> tuple[Answers, dict[str, State]]:
        """The networks' own outputs, and their states after them, which stay where the networks are."""
        inputs, carried, answers = inputs.loaded().to(self.device), Carried(states), []
        reduced = self._reduced and self.training
        with torch.autocast(self.device.type, torch.bfloat16) if reduced else nullcontext():
            given = inputs if self.trunk is None else carried.answer("trunk", self.trunk, inputs)
            for number, level in enumerate(self.option_levels()[:discovering]):
                place, trunk = f"levels.{number}", level.trunk
                seen = given if trunk is None else carried.answer(f"{place}.trunk", trunk, given)
                answers.append(carried.answer(f"{place}.policy", level.policy.network, seen))
                if level.termination is not None:
                    answers.append(carried.answer(f"{place}.termination", level.termination, seen))
            if not discovering:
                answers.append(carried.answer("meta_policy", self.meta_policy.network, given))
        if reduced or self.device != HOST:
            answers = [said.float().to(HOST) if reduced else said.to(HOST) for said in answers]
        return answers, carried.after

    def _outputs(self, answers: Answers, discovering: int | None) -> Outputs:
        """What the networks' outputs stand for."""
        levels, said = self.option_levels()[:discovering], iter(answers)
        callers, endings = [], []
        for level in levels:
            callers.append(level.policy(next(said), self.scaling))
            endings.append(None if level.termination is None else next(said).squeeze(-1))
        top = answers[-1]
        last = _uniform(top, levels[-1].count) if discovering else self.meta_policy(top, self.scaling)
        return Outputs((*callers, last), tuple(endings))

    def initial_states(self, trajectories: int) -> dict[str, State]:
        """The states of the networks that remember before the first step, by name."""
        each = self.networks().items()
        return {name: network.initial_state(trajectories) for name, network in each if remembers(network)}

    def tabulate(self, batch: Batch, discovering: int | None = None) -> Tables:
        """The tables of a batch: every network once, over all options, steps and trajectories."""
        outputs: Outputs = self(batch.inputs, discovering)
        return outputs.tables(batch.actions)


def _bytes_at_once(device: torch.device) -> float:
    if device.type == "cuda":
        return PART_OF_A_GPU * torch.cuda.get_device_properties(device).total_memory
    return min(BYTES_AT_ONCE, share())


def _meta_policy(spec: Spec) -> tuple[NetworkSpec, tuple[Emits, ...]]:
    if spec.hierarchy is not None:
        return spec.hierarchy.meta_policy, spec.hierarchy.meta_policy.emits
    assert spec.baseline is not None  # a spec has one or the other
    policy = spec.baseline.policy
    if spec.baseline.kind == "per_timestep":
        kept = {"hidden": ()} | policy.model_dump(exclude={"network"})  # a linear policy has no hidden layers
        policy = PerTimestepSpec(network="per_timestep", **kept)
    return policy, ("control",)


def _uniform(like: Tensor, options: int) -> CallerOutputs:
    """A meta-policy that selects each of the k options with probability 1/k, at as many steps [N, T, ...]."""
    return CallerOutputs(options, torch.zeros(*like.shape[:2], 1, options), None)
