"""The likelihood by either engine, and the check of one against the other that precedes every fit."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import pyro
import torch
from pyro.ops.contract import contract_tensor_tree
from torch import Tensor

from ddco_pyro.inference import fused, logspace
from ddco_pyro.model.ahmm import Scored, Steps, ahmm
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables, complete

Engine = Literal["fused", "enumerate"]

TRAJECTORIES = 3
"""Trajectories of a fit that the engines are compared on."""

STEPS = 12
"""First steps of those trajectories that the engines are compared on."""

TOLERANCE = 1e-6
"""Largest relative difference between engines that agree."""


def log_likelihood(tables: Tables, lengths: Tensor, engine: Engine = "fused") -> Tensor:
    """log p(ξ) of each trajectory in nats, [N] float64, differentiable in the tables; -inf where ξ is
    impossible.

    Without dynamics: p(ξ) is Σ_ζ p(ζ, a | s) of §4.1. The fused engine is differentiable once.

    :param lengths: steps of each trajectory, int64 [N]; steps beyond are ignored.

    >>> import torch
    >>> from ddco_pyro.inference import log_likelihood
    >>> from ddco_pyro.model.tables import Tables
    >>> tables = Tables(  # one level of two options, which always end: log 0.5 and log 1 for each step
    ...     selection=(torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 4, 1, 3),),  # control, options 1, 2
    ...     termination=(torch.tensor([0.0, 1.0]).log().expand(1, 4, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(torch.tensor([1.0, 3.0]).log().expand(1, 4, 2), torch.full((1, 4, 1), -torch.inf)),
    ... )
    >>> log_likelihood(tables, torch.tensor([4])).exp()  # (0.5 · 1 + 0.5 · 3) ** 4
    tensor([16.0000], dtype=torch.float64)
    """
    if engine == "enumerate":
        return enumerated(tables, lengths)
    if lengths.device.type == "cpu" and tables.depth:  # else nothing is latent
        settings = tables.depth, tables.power, tables.logits
        return fused.Eliminate.apply(*settings, lengths, *tables.leaves())  # type: ignore[no-any-return]
    return logspace.log_likelihood(complete(tables, lengths))


class EngineCheck(NamedTuple):
    """Largest relative differences between the engines, in the log-likelihood and in its gradient."""

    value: float
    gradient: float

    @property
    def agrees(self) -> bool:
        """Whether both differences are within the tolerance (NaN is not)."""
        return self.value <= TOLERANCE and self.gradient <= TOLERANCE


def compare_engines(outputs: Outputs, actions: Tensor, lengths: Tensor) -> EngineCheck:
    """Compare value and gradient of the fused engine with Pyro's enumeration of the program, in float64.

    Gradients are with respect to the networks' outputs. The fused engine eliminates logits and densities; the
    program scores the controls [N, T, A] by the emissions themselves.
    """
    controls = actions.double()

    def by_program(said: Outputs) -> Tensor:
        return enumerated(said.tables(controls), lengths, said.emissions, controls)

    truth, slopes = _with_gradient(outputs, by_program)
    value, gradient = _with_gradient(outputs, lambda said: log_likelihood(said.logits(controls), lengths))
    return EngineCheck(
        float((value - truth).abs() / truth.abs().clamp(min=1.0)),
        float((gradient - slopes).abs().max() / slopes.abs().max().clamp(min=1.0)),
    )


def _with_gradient(outputs: Outputs, engine: Callable[[Outputs], Tensor]) -> tuple[Tensor, Tensor]:
    """The sum of an engine's log-likelihoods, and its gradient, flat."""
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        leaves.append(tensor.detach().double().requires_grad_())
        return leaves[-1]

    value = engine(outputs.map(leaf)).sum()
    gradients = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    return value.detach(), torch.cat([gradient.flatten() for gradient in gradients])


# --- Pyro's enumeration -------------------------------------------------------------------------------------


def enumerated(
    tables: Tables,
    lengths: Tensor,
    emissions: Sequence[Steps | None] | None = None,
    actions: Tensor | None = None,
) -> Tensor:
    """log p(ξ) of each trajectory, [N] float64, differentiable in the tables.

    This is the elimination of ``TraceEnum_ELBO`` without its sum over the plate of demonstrations.

    :param emissions: score the controls ``actions`` [N, T, A] in place of the tables' densities.
    """
    if emissions is None:
        emissions, actions = known_controls(tables)
    chain = complete(tables, lengths)
    unused = ~chain.alive[..., None, None]  # may hold NaN
    chain = replace(chain, selection=tuple(table.masked_fill(unused, 0.0) for table in chain.selection))
    # the plate has dimension -1
    with pyro.poutine.enum(first_available_dim=-2), pyro.poutine.trace() as traced:
        ahmm(chain, emissions, actions)
    trace = traced.trace
    trace.compute_log_prob()
    trace.pack_tensors()
    factors: list[Any] = [
        site["packed"]["log_prob"] for site in trace.nodes.values() if "log_prob" in site.get("packed", {})
    ]
    enumerated = set("".join(factor._pyro_dims for factor in factors)) - {*trace.plate_to_symbol.values()}
    (parts,) = contract_tensor_tree(OrderedDict([(frozenset(), factors)]), enumerated).values()
    total: Tensor = sum(parts)
    return total.expand(len(lengths))


def known_controls(tables: Tables) -> tuple[list[Scored], Tensor]:
    """Emissions and controls for :func:`ddco_pyro.model.ahmm.ahmm` where tables hold the densities."""
    return [Scored(table) for table in tables.control], torch.empty(*tables.control[-1].shape[:2], 0)
