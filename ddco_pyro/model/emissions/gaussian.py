"""A free continuous control."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from torch import Tensor

from ddco_pyro.model.emissions.base import LOG_2PI, Emission, Given, Information, Part, over_dimensions


def continuous_control(part: Part, mean: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A mean, or a draw around it, within the bounds there are, in the control's own units."""
    value = mean if z is None else mean + std * z
    scale, shift = np.array(part["scale"]), np.array(part["shift"])
    control: np.ndarray = value * scale + shift
    for ends, side in zip(part["ends"], (-1, 1), strict=True):
        for place, end in enumerate(ends):
            if end is not None and side * np.float32(value[place]) >= side * np.float32(
                (end - shift[place]) / scale[place]
            ):
                control[place] = end
    return control


@dataclass(frozen=True)
class Gaussian(Emission):
    """A free continuous control, a ~ N(μ, σ²), with independent dimensions (§4.2).

    :param mean: μ, [..., K, A].
    :param std: σ, [A]; [K, A] for a σ of each caller; [..., K, A] for a σ that depends on the state.
    :param log_scale: logarithms of the control's units, [A].
    """

    mean: Tensor
    std: Tensor
    log_scale: Tensor
    control: ClassVar = staticmethod(continuous_control)

    @classmethod
    def of(cls, given: Given) -> Self:
        return cls(given.numbers, given.std, given.log_scale)

    @property
    def parameters(self) -> int:
        return self.mean.shape[-1]

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²), [..., K, A]."""
        return self._scored(self._errors(actions))

    def log_density(self, actions: Tensor) -> Tensor:
        """log N(a; μ, σ²), [..., K]."""
        return -0.5 * over_dimensions(self._errors(actions).square()) - self._offset().sum(-1)

    def _scored(self, errors: Tensor) -> Tensor:
        return -0.5 * errors.square() - self._offset()

    def _offset(self) -> Tensor:
        """log σ √2π in the control's own units, [A], [K, A] or [..., K, A]."""
        units = (self.log_scale + 0.5 * LOG_2PI).to(self.std.dtype)  # float64 would make all of it float64
        return (self.std.log() + units).to(self.mean.dtype)

    def _errors(self, actions: Tensor) -> Tensor:
        """(a_d - μ_d) / σ_d, [..., K, A]."""
        return (actions.unsqueeze(-2).to(self.mean.dtype) - self.mean) * (1 / self.std).to(self.mean.dtype)

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """That of a normal; of a clipped one the M-step takes censored moments, by Fisher's identity."""
        yield Information(slice(0, self.numbers), acting, std=tuple(range(self.mean.shape[-1])))

    @property
    def mode(self) -> Tensor:
        return self.mean

    def draw(self, noise: Tensor) -> Tensor:
        return self.mean + self.std * noise.unsqueeze(-2)

    def divergence(self, i: int) -> Tensor:
        """½ Σ (μ_i - μ_j)² / σ² where callers share σ."""
        to, back = self.relative_entropies(i)
        return 0.5 * (to + back)

    def relative_entropies(self, i: int) -> tuple[Tensor, Tensor]:
        """KL(π_i ‖ π_j) and KL(π_j ‖ π_i) of caller i and each caller j, float64 [..., K] nats."""
        mean = self.mean.double()
        variance = self.std.double().square().expand(*self.std.shape[:-2], *self.shape[-2:])
        square, ratio = (mean - mean[..., i : i + 1, :]).square(), variance / variance[..., i : i + 1, :]
        to = (square / variance).sum(-1) + (1 / ratio + ratio.log() - 1).sum(-1)
        back = (square / variance[..., i : i + 1, :]).sum(-1) + (ratio - ratio.log() - 1).sum(-1)
        return 0.5 * to, 0.5 * back
