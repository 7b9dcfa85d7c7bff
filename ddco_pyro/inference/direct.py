"""The fused engine without tables in between: from what the networks say to log p(ξ), and straight back (§4.1).

The posteriors that :mod:`ddco_pyro.inference.fused` finds weight the gradients of the networks' own numbers. This is
what training runs; value and gradient are those of the tables' path.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddco_pyro.inference import fused, links
from ddco_pyro.inference.once import once
from ddco_pyro.inference.structure import Structure, structure
from ddco_pyro.inference.threads import as_many_threads_as_torch
from ddco_pyro.model.outputs import TERMINATION_BOUND, Decision, Outputs, bounded


def log_likelihood(outputs: Outputs, actions: Tensor, log_volume: Tensor, lengths: Tensor) -> Tensor:
    """log p(ξ) of each trajectory, [N] float64 nats, differentiable once in the outputs.

    :param actions: the controls [N, T, A] in scaled units.
    :param log_volume: that of the control's scaling, so that densities are in the control's own units.
    :param lengths: steps of each trajectory, [N]; whatever lies beyond is ignored.
    """
    if outputs.endings and actions.device.type == "cpu" and not actions.requires_grad:
        leaves = [None if leaf is None else leaf.contiguous() for leaf in outputs.leaves()]
        value, exact = _Direct.apply(actions.contiguous(), float(log_volume), lengths, outputs.options, *leaves)
        if bool(exact.all()):
            found: Tensor = value
            return found
    return fused.log_likelihood(outputs.tables(actions, log_volume), lengths)


class _Direct(torch.autograd.Function):
    """Log-likelihoods, and whether they are exact; backward, the posteriors weight each network's own gradient."""

    @staticmethod
    def forward(
        ctx: Any, actions: Tensor, log_volume: float, lengths: Tensor, options: tuple[int, ...], *leaves: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        outputs, shape = Outputs.of(options, leaves), structure(tuple(1 + k for k in options[1:]))
        with as_many_threads_as_torch():
            emission, shift = _densities(outputs, actions, log_volume, lengths)
            rows = _selections(outputs, shape), _terminations(outputs), emission
        nothing = emission.new_empty(*emission.shape[:2], 0)
        value, exact, posterior, _ = fused.run(shape, rows, nothing, lengths)
        ctx.options, ctx.shape = options, shape
        ctx.save_for_backward(actions, *rows, *posterior, *leaves)
        ctx.mark_non_differentiable(exact)
        return value + shift, exact

    @staticmethod
    @once
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        actions, *saved = ctx.saved_tensors
        rows, posterior, outputs = saved[:3], saved[3:6], Outputs.of(ctx.options, saved[6:])
        with as_many_threads_as_torch():
            logits = _logits_gradients(outputs, ctx.shape, rows[0], posterior[0], upstream)
            endings = _ending_gradients(outputs, rows[1], posterior[1], upstream)
            means, stds = _gaussian_gradients(outputs, actions, posterior[2], upstream)
        return None, None, None, None, *logits, *means, *stds, *endings


def _selections(outputs: Outputs, shape: Structure) -> Tensor:
    """η of every level, [N, T, Σ callers·C_d]."""
    callers = [*(size - 1 for size in shape.sizes[1:]), 1]
    columns = sum(size * number for size, number in zip(shape.sizes, callers, strict=True))
    rows = torch.empty(*outputs.endings[0].shape[:2], columns, dtype=torch.float64)
    each = list(zip(outputs.decisions[1:], shape.selects, shape.sizes, callers, strict=True))
    for decision, first, choices, number in each:
        if decision.logits is not None:
            links.shifted_logits(decision.logits.numpy(), first, choices, rows.numpy())
        else:
            rows[..., first : first + number * choices] = torch.tensor([0.0, *[-torch.inf] * (choices - 1)] * number)
    rows.exp_()
    for _, first, choices, number in each:
        links.normalised(number, first, choices, rows.numpy())
    return rows


def _terminations(outputs: Outputs) -> Tensor:
    """(1 - ψ, ψ) of every level, [N, T, Σ 2·k_d]."""
    logits = (bounded(ending) for ending in outputs.endings)
    return torch.cat([torch.stack([-logit, logit], -1).flatten(2).double() for logit in logits], -1).sigmoid_()


def _densities(outputs: Outputs, actions: Tensor, log_volume: float, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """π(a | s) of every caller, scaled at each step, [N, T, 1 + Σ k_d]; the logarithms of the scales in sum, [N]."""
    number, steps = actions.shape[:2]
    rows = torch.full((number, steps, 1 + sum(outputs.options)), -torch.inf, dtype=torch.float64)
    for decision, first in zip(outputs.decisions, _columns(outputs), strict=True):
        if decision.mean is not None:
            constant = float(decision.log_constant(log_volume))
            precision = _precision(decision).numpy()
            links.log_gaussian(actions.numpy(), decision.mean.numpy(), precision, constant, first, rows.numpy())
    shift = rows.new_empty(number)
    links.shifted_densities(rows.numpy(), lengths.numpy(), shift.numpy())
    return rows.exp_(), shift


def _columns(outputs: Outputs) -> tuple[int, ...]:
    """The first column of each level's callers in a row of densities."""
    starts = [0]
    for ending in outputs.endings:
        starts.append(starts[-1] + ending.shape[-1])
    return tuple(starts)


def _precision(decision: Decision) -> Tensor:
    """1/σ², float64 [A]."""
    return decision.std.double().square().reciprocal()


def _logits_gradients(
    outputs: Outputs, shape: Structure, rows: Tensor, posterior: Tensor, upstream: Tensor
) -> list[Tensor | None]:
    found: list[Tensor | None] = [None]  # the lowest level selects nothing
    for decision, first, choices in zip(outputs.decisions[1:], shape.selects, shape.sizes, strict=True):
        gradient = None if decision.logits is None else torch.empty_like(decision.logits)
        if gradient is not None:
            links.logits_gradient(rows.numpy(), posterior.numpy(), upstream.numpy(), first, choices, gradient.numpy())
        found.append(gradient)
    return found


def _ending_gradients(outputs: Outputs, rows: Tensor, posterior: Tensor, upstream: Tensor) -> list[Tensor]:
    found, first = [], 0
    for ending in outputs.endings:
        gradient = torch.empty_like(ending)
        links.ending_gradient(rows.numpy(), posterior.numpy(), upstream.numpy(), first, gradient.numpy())
        found.append(gradient.mul_(1 - (bounded(ending) / TERMINATION_BOUND).square()))
        first += 2 * ending.shape[-1]
    return found


def _gaussian_gradients(
    outputs: Outputs, actions: Tensor, posterior: Tensor, upstream: Tensor
) -> tuple[list[Tensor | None], list[Tensor | None]]:
    means: list[Tensor | None] = []
    stds: list[Tensor | None] = []
    for decision, first in zip(outputs.decisions, _columns(outputs), strict=True):
        if decision.mean is None:
            means.append(None)
            stds.append(None)
            continue
        gradient, spread = torch.empty_like(decision.mean), posterior.new_empty(len(actions), actions.shape[-1])
        links.gaussian_gradient(
            actions.numpy(), decision.mean.numpy(), _precision(decision).numpy(), posterior.numpy(), upstream.numpy(),
            first, gradient.numpy(), spread.numpy(),
        )  # fmt: skip
        means.append(gradient)
        stds.append((spread.sum(0) / decision.std).to(decision.std.dtype))
    return means, stds
