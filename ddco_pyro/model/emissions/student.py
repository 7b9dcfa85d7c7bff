"""A continuous control with heavy tails: one latent scale stretches the errors of all dimensions of a step.

    a = μ + σ z / √τ,    z ~ N(0, 1) in each dimension,    τ ~ Gamma(ν/2, ν/2) once in each step.

So a ~ t_ν(μ, σ²), the multivariate Student t (Lange, Little and Taylor 1989). A step with large errors has a small
expected precision E[τ | a] = (ν + A) / (ν + Σ_d r_d²) of its residuals r = (a - μ) / σ, and counts so much less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy import special
from torch import Tensor
from torch.distributions import Gamma, kl_divergence
from torch.special import ndtr, polygamma

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import Emission, Information, Parameter, Part, phi
from ddco_pyro.model.emissions.gaussian import Gaussian, continuous_control
from ddco_pyro.spec import ControlSpec


def gamma_quantile(shape: float, share: float) -> float:
    """The number below which a Gamma variate of this shape and rate 1 is with this probability."""

    def below(x: float) -> float:
        term = total = math.exp(shape * math.log(x) - x - math.lgamma(shape + 1))
        step = shape
        while term > 1e-17 * total:
            step += 1
            term *= x / step
            total += term
        return total

    low, high = -700.0, math.log(shape + 60 + 20 * math.sqrt(shape))  # logarithms
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if below(math.exp(middle)) < share else (low, middle)
    return math.exp(high)


def student_control(part: Part, mean: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A mean, or a draw around it, in the control's own units; the last of ``z`` decides the scale, ν is after σ."""
    if z is None:
        return continuous_control(part, mean, std[:-1], None)
    stretch = math.sqrt(std[-1] / (2 * gamma_quantile(std[-1] / 2, phi(z[-1]))))
    return continuous_control(part, mean, std[:-1] * stretch, z[:-1])


@dataclass(frozen=True)
class Student(Gaussian):
    """A multivariate Student t with a diagonal scale.

    Divergences are those of controls together with their latent scales: upper bounds of those of the controls alone.

    :param freedom: ν, [1], [K, 1] or [..., K, 1].
    """

    freedom: Tensor
    further_noise: ClassVar[int] = 1
    helpers: ClassVar = (phi, gamma_quantile, continuous_control)
    control: ClassVar = staticmethod(student_control)

    @classmethod
    def of(
        cls, part: ControlPart, numbers: Tensor, parameters: Tensor, log_scale: Tensor, ends: tuple[Tensor, Tensor]
    ) -> Emission:
        """The numbers are μ; the parameters are σ, then ν."""
        size = len(part.dims)
        return Student(numbers, parameters[..., :size], log_scale, parameters[..., size : size + 1])

    @classmethod
    def further_parameters(cls, spec: ControlSpec, part: ControlPart) -> list[Parameter]:
        """ν, which the options of a level share."""
        named = next((own.freedom for own in spec.parts if set(own.dims) & set(part.dims)), None)
        freedom = spec.freedom if named is None else named
        return [Parameter(None, 1.0, 4.0) if freedom == "learn" else Parameter(freedom)]

    @property
    def parameters(self) -> int:
        """A + 1."""
        return self.mean.shape[-1] + 1

    def log_density(self, actions: Tensor) -> Tensor:
        """log t_ν(a; μ, σ²), float64 [..., K]."""
        size, nu = self.mean.shape[-1], self.freedom.double().squeeze(-1)
        tail = 0.5 * (nu + size) * (self._residuals(actions).square().sum(-1) / nu).log1p()
        constant = torch.lgamma((nu + size) / 2) - torch.lgamma(nu / 2) - 0.5 * size * (nu * math.pi).log()
        return constant - tail - (self.std.double().log() + self.log_scale).sum(-1)

    def by_dimension(self, actions: Tensor) -> Tensor:
        """The log-density of each dimension given those before it, float64 [..., K, A]."""
        squares, nu = self._residuals(actions).square().cumsum(-1), self.freedom.double()
        known = nu + torch.arange(self.mean.shape[-1])  # degrees of freedom, once the dimensions before are known
        before = torch.cat([torch.zeros_like(squares[..., :1]), squares[..., :-1]], -1)
        gammas = torch.lgamma((known + 1) / 2) - torch.lgamma(known / 2)
        tails = 0.5 * known * (before / nu).log1p() - 0.5 * (known + 1) * (squares / nu).log1p()
        return tails + gammas - 0.5 * (nu * math.pi).log() - self.std.double().log() - self.log_scale

    def _residuals(self, actions: Tensor) -> Tensor:
        return (actions.double().unsqueeze(-2) - self.mean.double()) / self.std.double()

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """That of a normal whose errors count with their expected precisions; and Fisher's of log ν."""
        size, nu = self.mean.shape[-1], self.freedom.double()
        precision = (nu.squeeze(-1) + size) / (nu.squeeze(-1) + self._residuals(actions).square().sum(-1))
        yield Information(slice(0, size), acting * precision, std=tuple(range(size)), count=acting)
        curve = 0.25 * (polygamma(1, nu / 2) - polygamma(1, (nu + size) / 2))
        curve = curve - size * (nu + size + 4) / (2 * nu * (nu + size) * (nu + size + 2))
        yield Information(slice(size, size), acting * (nu.square() * curve).squeeze(-1), std=(size,))

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ z / √τ, where Φ of the last number is the share of Gamma variates below ντ / 2."""
        share = ndtr(noise[..., -1:].double()).unsqueeze(-2)
        nu = self.freedom.detach().double()
        stretch = (nu / (2 * torch.as_tensor(special.gammaincinv((nu / 2).numpy(), share.numpy())))).sqrt()
        return self.mean + self.std * (noise[..., :-1].unsqueeze(-2) * stretch).to(self.mean.dtype)

    def relative_entropies(self, i: int) -> tuple[Tensor, Tensor]:
        """Of controls and latent scales together: those of the normals, as E[τ] = 1, and those of τ."""
        nu = self.freedom.double().expand(*self.mean.shape[:-1], 1)[..., 0] / 2
        every = Gamma(nu, nu, validate_args=False)
        first = Gamma(nu[..., i : i + 1], nu[..., i : i + 1], validate_args=False)
        to, back = super().relative_entropies(i)
        return to + kl_divergence(first, every), back + kl_divergence(every, first)
