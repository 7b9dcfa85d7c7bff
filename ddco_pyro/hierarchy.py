"""The networks of a hierarchy and the tables they give: levels of options under a meta-policy (paper §4).

A baseline is a hierarchy without option levels whose meta-policy emits control.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid, softplus

from ddco_pyro.ahmm import NEVER, Tables
from ddco_pyro.encoding import Batch, ControlScaling, ObservationEncoder, Shapes
from ddco_pyro.networks import Inputs, InputShape, ShapeError, build
from ddco_pyro.spec import ControlSpec, LearnedStd, LevelSpec, NetworkSpec, Spec

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6), so no path's probability is ever exactly 0."""

INITIAL_STD = 0.5
"""A learned standard deviation starts here, in scaled units."""

Emits = Literal["options", "control"]


@dataclass(frozen=True)
class Decision:
    """What the K callers of one level say: ``selection`` log η [N, T, K, 1 + k] and the ``mean`` control [N, T, K, A]
    with its ``std`` [A], both in scaled units; None for what they do not emit.
    """

    selection: Tensor | None
    mean: Tensor | None
    std: Tensor


@dataclass(frozen=True)
class Outputs:
    """What all networks say about a batch, before any control is known; levels lowest first, the top caller last."""

    decisions: tuple[Decision, ...]
    termination: tuple[Tensor, ...]

    def tables(self, actions: Tensor, log_volume: Tensor) -> Tables:
        """The tables for controls [N, T, A] in scaled units; densities in the control's own units."""
        selection = tuple(one.selection for one in self.decisions if one.selection is not None)
        control = tuple(_log_density(one, actions, log_volume) for one in self.decisions)
        return Tables(selection, self.termination, control)


class Caller(nn.Module):
    """K policies over the options of the level below, the physical control, or both (§4.2).

    One network gives the log-probabilities y_0 (control), y_1, ..., y_k and the mean control μ of each.
    """

    def __init__(
        self,
        network: NetworkSpec,
        emits: tuple[Emits, ...],
        options: int,
        shape: InputShape,
        control: ControlSpec,
        control_size: int,
        copies: int,
    ) -> None:
        super().__init__()
        self.options = options
        self.emits_control = "control" in emits
        self.emits_options = "options" in emits and options > 0
        self.hybrid = self.emits_control and self.emits_options
        logits = options + self.hybrid if self.emits_options else 0
        self.sizes = (logits, control_size if self.emits_control else 0)
        self.network = build(network, shape, sum(self.sizes), copies)
        self.std = ControlStd(control, control_size)

    def forward(self, inputs: Inputs) -> Decision:
        """Log-probabilities of the choices and mean controls for every step of the inputs."""
        logits, mean = self.network(inputs).split(self.sizes, dim=-1)
        selection = self._selection(logits) if self.options else None
        return Decision(selection, mean if self.emits_control else None, self.std())

    def _selection(self, logits: Tensor) -> Tensor:
        if self.hybrid:
            return logits.log_softmax(-1)
        control = logits.new_full((*logits.shape[:-1], 1), NEVER if self.emits_options else 0.0)
        options = logits.log_softmax(-1) if self.emits_options else control + NEVER
        return torch.cat([control, options.expand(*logits.shape[:-1], self.options)], dim=-1)


class ControlStd(nn.Module):
    """The standard deviation σ of the Gaussian control, [A] in scaled units: fixed, or learned above a floor.

    The options of a level share it: otherwise one of them collects the steps where the control hardly varies (a
    saturated actuator), whatever the skill (see docs/decisions.md).
    """

    fixed: Tensor

    def __init__(self, spec: ControlSpec, size: int) -> None:
        super().__init__()
        self.floor = spec.std.floor if isinstance(spec.std, LearnedStd) else None
        if isinstance(spec.std, LearnedStd):
            start = math.log(math.expm1(max(INITIAL_STD - spec.std.floor, 1e-3)))
            self.raw = nn.Parameter(torch.full((size,), start))
        else:
            self.register_buffer("fixed", torch.full((size,), float(spec.std)), persistent=False)

    def forward(self) -> Tensor:
        """σ [A]."""
        return self.fixed if self.floor is None else self.floor + softplus(self.raw)


class Level(nn.Module):
    """The k options of one level: their policies π (or, above the lowest level, η) and terminations ψ."""

    def __init__(
        self,
        place: str,
        spec: LevelSpec,
        options_below: int,
        shape: InputShape,
        control: ControlSpec,
        control_size: int,
    ) -> None:
        super().__init__()
        self.count = spec.count
        with _named(f"{place}.policy"):
            self.policy = Caller(
                spec.policy, spec.policy.emits or _default(options_below), options_below, shape, control, control_size,
                spec.count,
            )  # fmt: skip
        with _named(f"{place}.termination"):
            self.termination = build(spec.termination, shape, 1, spec.count)

    def log_termination(self, inputs: Inputs) -> Tensor:
        """(log(1 - ψ), log ψ), [N, T, k, 2]."""
        logit = TERMINATION_BOUND * torch.tanh(self.termination(inputs).squeeze(-1) / TERMINATION_BOUND)
        return torch.stack([logsigmoid(-logit), logsigmoid(logit)], dim=-1)


@contextmanager
def _named(place: str) -> Iterator[None]:
    """Errors about a network say where in the spec it stands."""
    try:
        yield
    except ShapeError as error:
        raise ShapeError(f"{place}: {error}") from error


def _default(options_below: int) -> tuple[Emits, ...]:
    return ("options",) if options_below else ("control",)


class Hierarchy(nn.Module):
    """Levels of options, lowest first, and the meta-policy on top.

    :param shapes: shapes of the observations by name, without time.
    :param control_size: A, the number of control dimensions.
    :param steps: the longest demonstration, for per-timestep networks.
    :raises ShapeError: where a network cannot read these observations.
    """

    def __init__(self, spec: Spec, shapes: Shapes, control_size: int, steps: int) -> None:
        super().__init__()
        self.encoder = ObservationEncoder(spec.observations, shapes)
        self.scaling = ControlScaling(spec.control, control_size)
        shape = self.encoder.shape(steps)
        levels, below = [], 0
        for number, level in enumerate(spec.hierarchy.levels if spec.hierarchy else ()):
            levels.append(Level(f"hierarchy.levels.{number}", level, below, shape, spec.control, control_size))
            below = level.count
        self.levels = nn.ModuleList(levels)
        network, emits = _meta_policy(spec)
        with _named("hierarchy.meta_policy" if levels else "baseline.policy"):
            self.meta_policy = Caller(network, emits, below, shape, spec.control, control_size, copies=1)

    @property
    def depth(self) -> int:
        """The number D of option levels."""
        return len(self.levels)

    def _levels(self) -> list[Level]:
        return [level for level in self.levels if isinstance(level, Level)]

    def named_networks(self) -> Iterator[tuple[str, nn.Module]]:
        """Every network by its place in the spec."""
        for number, level in enumerate(self._levels()):
            yield f"hierarchy.levels.{number}.policy", level.policy
            yield f"hierarchy.levels.{number}.termination", level.termination
        yield "hierarchy.meta_policy" if self.depth else "baseline.policy", self.meta_policy

    def forward(self, inputs: Inputs, discovering: int | None = None) -> Outputs:
        """What the networks say about these observations.

        :param discovering: d gives levels 1 to d alone under a uniform meta-policy (layer-wise training, SM 2.3).
        """
        levels = self._levels()[:discovering]
        decisions = [level.policy(inputs) for level in levels]
        top = _uniform(inputs, levels[-1].count, decisions[0].std) if discovering else self.meta_policy(inputs)
        return Outputs((*decisions, top), tuple(level.log_termination(inputs) for level in levels))

    def tabulate(self, batch: Batch, discovering: int | None = None) -> Tables:
        """The tables of a batch: every network once, over all options, steps and trajectories."""
        return self(batch.inputs, discovering).tables(batch.actions, self.scaling.log_volume)


def _meta_policy(spec: Spec) -> tuple[NetworkSpec, tuple[Emits, ...]]:
    if spec.hierarchy is not None:
        return spec.hierarchy.meta_policy, spec.hierarchy.meta_policy.emits
    assert spec.baseline is not None  # a spec has one or the other
    policy = spec.baseline.policy
    if spec.baseline.kind == "per_timestep":
        policy = NetworkSpec(network="per_timestep", hidden=policy.hidden, dropout=policy.dropout)
    return policy, ("control",)


def _uniform(inputs: Inputs, options: int, like: Tensor) -> Decision:
    """A meta-policy that selects each of the k options with probability 1/k."""
    selection = like.new_full((*inputs.batch, 1, 1 + options), -math.log(options))
    selection[..., 0] = NEVER
    return Decision(selection, None, like)


def _log_density(decision: Decision, actions: Tensor, log_volume: Tensor) -> Tensor:
    """log N(a; μ, σ²) of each caller, [N, T, K], in the control's own units; -inf where it emits no control."""
    if decision.mean is None:
        selection = decision.selection
        assert selection is not None  # a caller emits something
        return selection.new_full(selection.shape[:-1], NEVER)
    error = actions.unsqueeze(2) - decision.mean
    normaliser = decision.std.log().sum(-1) + 0.5 * math.log(2 * math.pi) * actions.shape[-1] + log_volume
    return error.square() @ (-0.5 / decision.std.square()).to(error.dtype) - normaliser
