"""A continuous control that reaches its bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ddco_pyro.model.emissions.base import LOG_2PI, Given, over_dimensions
from ddco_pyro.model.emissions.gaussian import Gaussian
from ddco_pyro.model.tables import by_step, by_trajectory


@dataclass(frozen=True)
class Clipped(Gaussian):
    """A continuous control that reaches its bounds: a = min(max(z, low), high) of z ~ N(μ, σ²), a censored
    normal.

    Within its bounds a control has the normal's density. On a bound, or beyond, it has the probability Φ of
    what lies there. That is a mass, whatever the units: densities and masses are different measures.
    Divergences are those of the normals before clipping, upper bounds of those after.

    :param low: the lower bound of each dimension in scaled units, -inf for none, [A]; ``high`` likewise.
    """

    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, given: Given) -> Gaussian:  # type: ignore[override]
        """The clipped normal distribution; a normal one where no bound is finite."""
        if not given.part.bounded:
            return Gaussian.of(given)
        return cls(given.numbers, given.std, given.log_scale, given.low, given.high)

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return over_dimensions(self.by_dimension(actions))

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²) within the bounds, log Φ of what lies beyond on a bound, [..., K, A]."""
        errors, before = self._errors(actions.clamp(self.low, self.high)), actions.dim() - 1
        each = by_step(self._scored(errors), before)
        low, high = (by_step(on, before).flatten() for on in (actions <= self.low, actions >= self.high))
        place = torch.from_numpy(np.flatnonzero((low ^ high).numpy()))  # log Φ is computed on bounds alone
        places = (place + len(low) * torch.arange(len(each)).unsqueeze(1)).flatten()
        beyond = by_step(errors, before).flatten().index_select(0, places)
        mass = LogNormal.apply(beyond * (low[place] * 2.0 - 1).repeat(len(each)))
        return by_trajectory(each.flatten().index_copy(0, places, mass).view(each.shape), before)

    @property
    def mode(self) -> Tensor:
        return self.mean.clamp(self.low, self.high)

    def draw(self, noise: Tensor) -> Tensor:
        return super().draw(noise).clamp(self.low, self.high)


TAIL = {torch.float32: -12.0, torch.float64: -30.0}
"""Below, log Φ is computed by its asymptotic series: erfc ends at -13 and at -37."""


class LogNormal(torch.autograd.Function):
    """log Φ(x), [M], with the gradient φ(x) / Φ(x), which is finite however small x is; differentiable once.

    torch's own takes ten times as long, gives NaN in float32, and loses its gradient to rounding from -1e8
    on.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        mass = 0.5 * torch.erfc(x * -math.sqrt(0.5))
        below = (x < TAIL[x.dtype]).nonzero().squeeze(1)
        tail = x[below]
        r = tail.square().reciprocal()
        series = 1 - r * (1 - 3 * r * (1 - 5 * r * (1 - 7 * r)))
        ctx.save_for_backward(x, mass, below, -tail / series)
        return mass.log().index_copy_(0, below, (series / -tail).log() - 0.5 * tail.square() - 0.5 * LOG_2PI)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        x, mass, below, slopes = ctx.saved_tensors
        density = x.square().add_(LOG_2PI).mul_(-0.5).exp_()
        return density.div_(mass).index_copy_(0, below, slopes).mul_(upstream)
