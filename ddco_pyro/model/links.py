"""Compiled links from network outputs to log-probabilities; torch's own take longer than inference on few columns.

torch computes the exponentials, many at once; the sums over columns are compiled. Each link also has a formula in
torch, which defines it and is used for second derivatives, on other devices and in exported programs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from ddco_pyro.model.tables import NEVER

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6), so no path's probability is ever exactly 0."""

Array = np.ndarray
Gradients = tuple[Tensor | None, ...]
Wanted = tuple[bool, ...]
"""Whether the gradient of each input is wanted."""

jit = numba.njit(cache=True, error_model="numpy")


def log_selection(logits: Tensor, control: int) -> Tensor:
    """Log-softmax over the last dimension, after ``control`` (0 or 1) impossible choices."""
    return _linked(_SELECTION, logits, torch.empty(control))


def log_termination(logits: Tensor) -> Tensor:
    """(log(1 - ψ), log ψ) [..., 2] of logits, which are bounded first."""
    return _linked(_TERMINATION, logits)


def weighted_squares(mean: Tensor, weight: Tensor, actions: Tensor) -> Tensor:
    """Σ_d w_d (a_d - μ_d)², [..., K], of means [..., K, A], weights [A], [K, A] or [..., K, A] and actions [..., A]."""
    actions = actions.to(mean.dtype)
    if actions.shape[:-1] != mean.shape[:-2] or weight.dim() > 2:
        return _squares_formula(mean, weight, actions)
    return _linked(_SQUARES, mean, weight, actions)


def bounded(logits: Tensor) -> Tensor:
    """Termination logits within ±``TERMINATION_BOUND``, by a scaled tanh."""
    return TERMINATION_BOUND * torch.tanh(logits / TERMINATION_BOUND)


class Link(NamedTuple):
    """A function of tensors, in torch (``formula``) and compiled.

    ``forward`` gives the value, then further tensors for ``backward``. ``backward`` takes which gradients are wanted,
    the gradient of the value, the inputs and those tensors. It returns the gradients of the first ``differentiable``
    inputs.
    """

    formula: Callable[..., Tensor]
    forward: Callable[..., tuple[Tensor, ...]]
    backward: Callable[..., Gradients]
    differentiable: int = 1


def _linked(link: Link, *inputs: Tensor) -> Tensor:
    if any(tensor.device.type != "cpu" for tensor in inputs) or torch.compiler.is_compiling():
        return link.formula(*inputs)
    value: Tensor = _Compiled.apply(link, *inputs)
    return value


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, link: Link, *inputs: Tensor) -> Tensor:
        value, *kept = link.forward(*inputs)
        ctx.link, ctx.inputs = link, len(inputs)
        ctx.save_for_backward(*inputs, *kept)
        return value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        link, saved, wanted = ctx.link, ctx.saved_tensors, ctx.needs_input_grad[1:]
        inputs, kept = saved[: ctx.inputs], saved[ctx.inputs :]
        if not torch.is_grad_enabled() and not any(wanted[link.differentiable :]):
            derivatives = link.backward(wanted, upstream.contiguous(), *inputs, *kept)
            return None, *derivatives, *(None,) * (ctx.inputs - len(derivatives))
        with torch.enable_grad():
            value = link.formula(*inputs)
        leaves = [tensor for tensor, needed in zip(inputs, wanted, strict=True) if needed]
        gradients = iter(torch.autograd.grad(value, leaves, upstream, create_graph=torch.is_grad_enabled()))
        return None, *(next(gradients) if needed else None for needed in wanted)


def _selection_forward(logits: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
    *batch, size = logits.shape
    value = logits.new_empty(*batch, len(control) + size)
    shares = torch.empty(value.numel() // max(value.shape[-1], 1), size, dtype=torch.float64)
    rows, out = _rows(logits, 1), _rows(value, 1)
    _below_largest(rows, shares.numpy())
    _normalise(rows, shares.exp_().numpy(), out)
    return value, shares


def _selection_backward(_: Wanted, upstream: Tensor, logits: Tensor, control: Tensor, shares: Tensor) -> Gradients:
    gradient = torch.empty_like(logits, memory_format=torch.contiguous_format)
    _normalise_gradient(_rows(upstream, 1), shares.numpy(), _rows(gradient, 1))
    return (gradient,)


@jit
def _below_largest(logits: Array, shares: Array) -> None:
    for row in range(logits.shape[0]):
        top = logits[row, 0]
        for j in range(1, logits.shape[1]):
            top = max(top, logits[row, j])
        for j in range(logits.shape[1]):
            shares[row, j] = np.float64(logits[row, j]) - top


@jit
def _normalise(logits: Array, shares: Array, value: Array) -> None:
    extra = value.shape[1] - logits.shape[1]
    for row in range(logits.shape[0]):
        total, largest = 0.0, 0
        for j in range(logits.shape[1]):
            total += shares[row, j]
            largest = j if shares[row, j] == 1.0 else largest
        normaliser = logits[row, largest] + np.log(total)
        value[row, :extra] = -np.inf
        for j in range(logits.shape[1]):
            value[row, extra + j] = logits[row, j] - normaliser
            shares[row, j] /= total


@jit
def _normalise_gradient(upstream: Array, shares: Array, gradient: Array) -> None:
    extra = upstream.shape[1] - gradient.shape[1]
    for row in range(gradient.shape[0]):
        total = 0.0
        for j in range(gradient.shape[1]):
            total += upstream[row, extra + j]
        for j in range(gradient.shape[1]):
            gradient[row, j] = upstream[row, extra + j] - shares[row, j] * total


def _termination_forward(logits: Tensor) -> tuple[Tensor, Tensor]:
    within = bounded(logits.detach())
    lost = within.abs().neg_().exp_().log1p_()
    value = within.new_empty(*within.shape, 2)
    _both(_rows(within, 0), _rows(lost, 0), _rows(value, 1))
    return value, within


def _termination_backward(_: Wanted, upstream: Tensor, logits: Tensor, within: Tensor) -> Gradients:
    gradient = torch.empty_like(logits, memory_format=torch.contiguous_format)
    _bounded_gradient(_rows(upstream, 1), _rows(within, 0), _rows(within.sigmoid(), 0), _rows(gradient, 0))
    return (gradient,)


@jit
def _both(within: Array, lost: Array, value: Array) -> None:
    for i in range(len(within)):
        value[i, 0] = min(-within[i], 0) - lost[i]
        value[i, 1] = min(within[i], 0) - lost[i]


@jit
def _bounded_gradient(upstream: Array, within: Array, ending: Array, gradient: Array) -> None:
    for i in range(len(within)):
        slope = 1.0 - (within[i] / TERMINATION_BOUND) ** 2
        gradient[i] = (upstream[i, 1] * (1.0 - ending[i]) - upstream[i, 0] * ending[i]) * slope


def _squares_forward(mean: Tensor, weight: Tensor, actions: Tensor) -> tuple[Tensor]:
    value = mean.new_empty(mean.shape[:-1])
    _sum_squares(_rows(mean, 2), _rows(weight.expand(mean.shape[-2:]), 1), _rows(actions, 1), _rows(value, 1))
    return (value,)


def _squares_backward(wanted: Wanted, upstream: Tensor, mean: Tensor, weight: Tensor, actions: Tensor) -> Gradients:
    weights = weight.expand(mean.shape[-2:])
    rows = _rows(upstream, 1), _rows(mean, 2), _rows(weights, 1), _rows(actions, 1)
    gradient = torch.empty_like(mean, memory_format=torch.contiguous_format)
    _mean_gradient(*rows, _rows(gradient, 2))
    if not wanted[1]:
        return gradient, None
    spread = torch.empty(mean.shape[-2:], dtype=torch.float64)
    _weight_gradient(*rows, spread.numpy())
    return gradient, spread.sum_to_size(weight.shape).to(weight.dtype)


@jit
def _sum_squares(mean: Array, weight: Array, actions: Array, value: Array) -> None:
    for row in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            total = 0.0
            for d in range(mean.shape[2]):
                error = np.float64(actions[row, d]) - mean[row, j, d]
                total += error * error * weight[j, d]
            value[row, j] = total


@jit
def _mean_gradient(upstream: Array, mean: Array, weight: Array, actions: Array, gradient: Array) -> None:
    for row in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            for d in range(mean.shape[2]):
                error = np.float64(actions[row, d]) - mean[row, j, d]
                gradient[row, j, d] = -2.0 * upstream[row, j] * weight[j, d] * error


@jit
def _weight_gradient(upstream: Array, mean: Array, weight: Array, actions: Array, gradient: Array) -> None:
    for j in range(mean.shape[1]):
        for d in range(mean.shape[2]):
            total = 0.0
            for row in range(mean.shape[0]):
                total += upstream[row, j] * (np.float64(actions[row, d]) - mean[row, j, d]) ** 2
            gradient[j, d] = total


def _rows(table: Tensor, columns: int) -> Array:
    """A table as an array, its dimensions before the last ``columns`` as one."""
    array = np.ascontiguousarray(table.detach().numpy())
    return array.reshape(-1, *array.shape[array.ndim - columns :])


def _selection_formula(logits: Tensor, control: Tensor) -> Tensor:
    return pad(logits.log_softmax(-1), (len(control), 0), value=NEVER)


def _termination_formula(logits: Tensor) -> Tensor:
    within = bounded(logits)
    return torch.stack([logsigmoid(-within), logsigmoid(within)], dim=-1)


def _squares_formula(mean: Tensor, weight: Tensor, actions: Tensor) -> Tensor:
    return ((actions.unsqueeze(-2) - mean).square() * weight).sum(-1)


_SELECTION = Link(_selection_formula, _selection_forward, _selection_backward)
_TERMINATION = Link(_termination_formula, _termination_forward, _termination_backward)
_SQUARES = Link(_squares_formula, _squares_forward, _squares_backward, 2)
