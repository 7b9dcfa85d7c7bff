"""A control that is often exactly one value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor
from torch.special import ndtr

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import Emission, Given, Information, Part, log_logistic, phi
from ddco_pyro.model.emissions.binary import of_switch
from ddco_pyro.model.emissions.clipped import Clipped
from ddco_pyro.model.emissions.gaussian import Gaussian, continuous_control


def hurdle_control(part: Part, numbers: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """The exact value, at which scaled units are 0, or a continuous control; the last of ``z`` decides."""
    exactly = numbers[0] >= 0 if z is None else phi(z[-1]) < 1 / (1 + np.exp(-numbers[0]))
    if exactly:
        return np.array(part["shift"])
    return continuous_control(part, numbers[1:], std, None if z is None else z[:-1])


@dataclass(frozen=True)
class Hurdle(Emission):
    """A two-part control: exactly one value with probability p = logistic(y), continuous otherwise (a hurdle
    model).

    All dimensions are at their values at once, or none is. The value is 0 in scaled units, and no other
    control is, so the comparison is exact at any scale.

    :param logit: y, [..., K, 1].
    :param slab: the continuous part.
    """

    logit: Tensor
    slab: Gaussian
    further_noise: ClassVar[int] = 1
    helpers: ClassVar = (phi, continuous_control)
    control: ClassVar = staticmethod(hurdle_control)

    @classmethod
    def of(cls, given: Given) -> Self:
        return cls(given.numbers[..., :1], Clipped.of(given._replace(numbers=given.numbers[..., 1:])))

    @classmethod
    def size(cls, part: ControlPart) -> int:
        return 1 + len(part.dims)

    @property
    def shape(self) -> torch.Size:
        return self.slab.shape

    @property
    def numbers(self) -> int:
        return 1 + self.slab.numbers

    @property
    def parameters(self) -> int:
        return self.slab.parameters

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """That of the switch, and that of the slab in steps away from the value."""
        p = self.logit.sigmoid()
        yield Information(slice(0, 1), acting.unsqueeze(-1) * p * (1 - p))
        for own in self.slab.information(acting * ~_at_value(actions), actions):
            yield own.moved(1, 0)

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s), [..., K, A], each with an equal share of the part's log-probability."""
        at = _at_value(actions).unsqueeze(-1)
        return self._part(at) / self.shape[-1] + torch.where(at, 0.0, self.slab.by_dimension(actions))

    def log_density(self, actions: Tensor) -> Tensor:
        """log p at the value, log (1 - p) and the slab's log-density elsewhere, [..., K]."""
        at = _at_value(actions)
        return self._part(at.unsqueeze(-1)).squeeze(-1) + torch.where(at, 0.0, self.slab.log_density(actions))

    def _part(self, at: Tensor) -> Tensor:
        """The log-probability of being at the value, or of not being there, [..., K, 1]."""
        return log_logistic(torch.where(at, self.logit, -self.logit))

    @property
    def mode(self) -> Tensor:
        return torch.where(self.logit >= 0, 0.0, self.slab.mode)

    def draw(self, noise: Tensor) -> Tensor:
        """The value where Φ(z) of the last number is below p, elsewhere what the slab draws."""
        at = ndtr(noise[..., -1:]).unsqueeze(-2) < self.logit.sigmoid()
        return torch.where(at, 0.0, self.slab.draw(noise[..., :-1]))

    def divergence(self, i: int) -> Tensor:
        """That of the parts, and that of the slabs weighted by 1 - p."""
        logits = self.logit[..., 0].double()
        logit, (to, back) = logits[..., i : i + 1], self.slab.relative_entropies(i)
        return of_switch(logit, logits) + 0.5 * ((-logit).sigmoid() * to + (-logits).sigmoid() * back)


def _at_value(actions: Tensor) -> Tensor:
    """Whether a hurdle's controls [..., A] are at its value, [..., 1]."""
    return (actions == 0).all(-1, keepdim=True)
