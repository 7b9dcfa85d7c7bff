"""Discrete actions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.special import ndtr

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import Emission, Information, Part, phi
from ddco_pyro.model.tables import NEVER


def categorical_control(part: Part, logits: np.ndarray, _: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """The value of a discrete action."""
    index = int(logits.argmax())
    if z is not None:
        total = np.exp(logits - logits.max()).cumsum()
        index = min(int((total <= phi(z[0]) * total[-1]).sum()), len(total) - 1)
    return np.array([part["values"][index]])


@dataclass(frozen=True)
class Categorical(Emission):
    """One of C discrete actions, as its index (A = 1).

    :param logits: [..., K, C].
    """

    logits: Tensor
    helpers: ClassVar = (phi,)
    control: ClassVar = staticmethod(categorical_control)

    @classmethod
    def size(cls, part: ControlPart) -> int:
        return len(part.values)

    @classmethod
    def possible(cls, part: ControlPart, scaled: np.ndarray) -> np.ndarray:
        """Known indices."""
        return ~np.isnan(scaled)

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        yield Information.of_logits(slice(0, self.numbers), acting, self.logits.softmax(-1))

    @property
    def shape(self) -> torch.Size:
        return torch.Size([*self.logits.shape[:-1], 1])

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log softmax(logits)[a], [..., K, 1]; -inf for no such action."""
        log_probs, index = self.logits.log_softmax(-1), actions.clamp(0, self.logits.shape[-1] - 1).long()
        chosen = log_probs.gather(-1, index.unsqueeze(-2).expand(*log_probs.shape[:-1], 1))
        return torch.where((actions == index).unsqueeze(-2), chosen, NEVER)

    @property
    def mode(self) -> Tensor:
        return self.logits.argmax(-1, keepdim=True).to(self.logits.dtype)

    def draw(self, noise: Tensor) -> Tensor:
        """The first action up to which the probabilities sum to more than Φ(z) of the first number."""
        total = self.logits.double().softmax(-1).cumsum(-1)
        uniform = ndtr(noise[..., :1].double()).unsqueeze(-2)
        index = (total <= uniform * total[..., -1:]).sum(-1, keepdim=True)
        return index.clamp(max=total.shape[-1] - 1).to(self.logits.dtype)

    def divergence(self, i: int) -> Tensor:
        """½ Σ (p_i - p_j)(log p_i - log p_j)."""
        second = self.logits.double().log_softmax(-1)
        first = second[..., i : i + 1, :]
        return 0.5 * ((first.exp() - second.exp()) * (first - second)).sum(-1)
