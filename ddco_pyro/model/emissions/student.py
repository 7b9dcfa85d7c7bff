"""A continuous control with heavy tails: one latent scale stretches the errors of all dimensions of a step.

    a = μ + σ z / √τ,    z ~ N(0, 1) in each dimension,    τ ~ Gamma(ν/2, ν/2) once in each step,    ν = 4.

So a ~ t_ν(μ, σ²), the multivariate Student t (Lange, Little and Taylor 1989). A step with large errors has a
small expected precision E[τ | a] = (ν + A) / (ν + Σ_d r_d²) of its residuals r = (a - μ) / σ, and counts so
much less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.model.emissions.base import Information, Part, over_dimensions
from ddco_pyro.model.emissions.gaussian import Gaussian, continuous_control

NU = 4
"""ν, the degrees of freedom."""


def student_control(part: Part, mean: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A mean, or a draw around it, in the control's own units; the last of ``z`` decide the scale."""
    if z is None:
        return continuous_control(part, mean, std, None)
    return continuous_control(part, mean, std / np.sqrt(np.square(z[len(mean) :]).mean()), z[: len(mean)])


@dataclass(frozen=True)
class Student(Gaussian):
    """A multivariate Student t with a diagonal scale.

    Divergences are those of controls together with their latent scales, which are those of the normals, as
    E[τ] = 1: upper bounds of those of the controls alone.
    """

    further_noise: ClassVar[int] = NU
    helpers: ClassVar = (continuous_control,)
    control: ClassVar = staticmethod(student_control)

    def log_density(self, actions: Tensor) -> Tensor:
        """log t_ν(a; μ, σ²), float64 [..., K]."""
        size = self.mean.shape[-1]
        tail = 0.5 * (NU + size) * (over_dimensions(self._residuals(actions).square()) / NU).log1p()
        constant = math.lgamma((NU + size) / 2) - math.lgamma(NU / 2) - 0.5 * size * math.log(NU * math.pi)
        return constant - tail - (self.std.double().log() + self.log_scale).sum(-1)

    def by_dimension(self, actions: Tensor) -> Tensor:
        """The log-density of each dimension given those before it, float64 [..., K, A]."""
        squares = self._residuals(actions).square().cumsum(-1)
        # degrees of freedom, once the dimensions before are known
        known = NU + torch.arange(self.mean.shape[-1], dtype=torch.float64)
        before = torch.cat([torch.zeros_like(squares[..., :1]), squares[..., :-1]], -1)
        gammas = torch.lgamma((known + 1) / 2) - torch.lgamma(known / 2)
        tails = 0.5 * known * (before / NU).log1p() - 0.5 * (known + 1) * (squares / NU).log1p()
        return tails + gammas - 0.5 * math.log(NU * math.pi) - self.std.double().log() - self.log_scale

    def _residuals(self, actions: Tensor) -> Tensor:
        return (actions.double().unsqueeze(-2) - self.mean.double()) / self.std.double()

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """That of a normal whose errors count with their expected precisions."""
        size = self.mean.shape[-1]
        precision = (NU + size) / (NU + over_dimensions(self._residuals(actions).square()))
        yield Information(slice(0, size), acting * precision, std=tuple(range(size)), count=acting)

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ z / √τ, where τ is the mean square of the last ν numbers, a χ² variate divided by ν."""
        z, squares = noise[..., :-NU], noise[..., -NU:].double().square()
        return self.mean + self.std * (z * squares.mean(-1, keepdim=True).rsqrt()).unsqueeze(-2).to(
            self.mean.dtype
        )
