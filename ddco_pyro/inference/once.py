"""Gradients that have no derivative of their own, and say so."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

Gradients = tuple[Tensor | None, ...]


def once(backward: Callable[..., Gradients]) -> Callable[..., Gradients]:
    """A backward whose result refuses to be differentiated, whatever it is differentiated by.

    torch's ``once_differentiable`` refuses only where what comes from above requires a gradient; the derivative with
    respect to the saved inputs would silently be 0. So the inputs must be among the saved tensors.
    """

    @wraps(backward)
    def guarded(ctx: Any, *upstream: Tensor) -> Gradients:
        with torch.no_grad():
            gradients = backward(ctx, *upstream)
        if not torch.is_grad_enabled():
            return gradients
        inputs = [tensor for tensor in (*upstream, *ctx.saved_tensors) if tensor is not None and tensor.requires_grad]
        return tuple(None if gradient is None else _Refuse.apply(gradient, *inputs) for gradient in gradients)

    return guarded


class _Refuse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradient: Tensor, *inputs: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Any:
        raise RuntimeError(
            "the fused engine's gradient is the posterior, which it cannot differentiate again: "
            "use engine='enumerate' where second derivatives are needed"
        )
