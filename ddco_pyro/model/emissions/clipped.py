"""A continuous control that reaches its bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import LOG_2PI, Emission
from ddco_pyro.model.emissions.gaussian import Gaussian


@dataclass(frozen=True)
class Clipped(Gaussian):
    """A continuous control that reaches its bounds: a = min(max(z, low), high) of z ~ N(μ, σ²), a censored normal.

    Within its bounds a control has the normal's density. On a bound, or beyond, it has the probability Φ of what lies
    there. That is a mass, whatever the units: densities and masses are different measures. Divergences are those of
    the normals before clipping, upper bounds of those after.

    :param low: the lower bound of each dimension in scaled units, -inf for none, [A]; ``high`` likewise.
    """

    low: Tensor
    high: Tensor

    @classmethod
    def of(
        cls, part: ControlPart, numbers: Tensor, parameters: Tensor, log_scale: Tensor, ends: tuple[Tensor, Tensor]
    ) -> Emission:
        """The clipped normal distribution; a normal one where no bound is finite."""
        normal = Gaussian(numbers, parameters[..., : len(part.dims)], log_scale)
        return Clipped(normal.mean, normal.std, log_scale, *ends) if part.bounded else normal

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return self._summed(self._each(actions))

    def _each(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²) within the bounds, log Φ of what lies beyond on a bound, [..., K·A]."""
        side = self._repeated((actions <= self.low).float() - (actions >= self.high).float()).flatten()
        on = side.nonzero().squeeze(1)  # log Φ is computed on bounds alone
        errors = self._errors(actions.clamp(self.low, self.high))
        mass = log_ndtr(errors.flatten().index_select(0, on) * side[on]).to(errors.dtype)
        each = self._scored(errors)
        return each.flatten().index_copy(0, on, mass).reshape(each.shape)

    @property
    def mode(self) -> Tensor:
        return self.mean.clamp(self.low, self.high)

    def draw(self, noise: Tensor) -> Tensor:
        return super().draw(noise).clamp(self.low, self.high)


TAIL = -30.0
"""Below, log Φ is computed by its asymptotic series: erfc ends at -37."""


def log_ndtr(values: Tensor) -> Tensor:
    """log Φ(x) in float64, with a gradient that is finite however small x is.

    torch's own takes ten times as long, gives NaN in float32, and loses its gradient to rounding from -1e8 on.
    """
    x = values.double()
    within = (0.5 * torch.erfc(x.clamp(min=TAIL) * -math.sqrt(0.5))).log()
    if not bool((x < TAIL).any()):
        return within
    tail = x.clamp(max=TAIL)
    r = tail.square().reciprocal()
    series = -0.5 * tail.square() - (-tail).log() - 0.5 * LOG_2PI + (-r * (1 - 3 * r * (1 - 5 * r))).log1p()
    return torch.where(x < TAIL, series, within)
