"""Discrete actions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot, pad
from torch.special import ndtr

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import Emission, Information, Part, phi
from ddco_pyro.model.tables import NEVER


def categorical_control(part: Part, logits: np.ndarray, _: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A discrete action, as its value or as a row."""
    index = int(logits.argmax())
    if z is not None:
        total = np.exp(logits - logits.max()).cumsum()
        index = min(int((total <= phi(z[0]) * total[-1]).sum()), len(total) - 1)
    return np.array([part["values"][index]]) if part["values"] else np.eye(len(logits))[index]


@dataclass(frozen=True)
class Categorical(Emission):
    """One of C discrete actions, as its index (A = 1) or, where A = C, as a row with a single 1.

    :param logits: [..., K, C].
    :param rows: whether actions are rows; a tensor with one truth value.
    """

    logits: Tensor
    rows: Tensor
    helpers: ClassVar = (phi,)
    control: ClassVar = staticmethod(categorical_control)

    @classmethod
    def of(
        cls, part: ControlPart, numbers: Tensor, parameters: Tensor, log_scale: Tensor, ends: tuple[Tensor, Tensor]
    ) -> Emission:
        return Categorical(numbers, torch.tensor(not part.values))

    @classmethod
    def size(cls, part: ControlPart) -> int:
        return len(part.values) or len(part.dims)

    @classmethod
    def possible(cls, part: ControlPart, scaled: np.ndarray) -> np.ndarray:
        """Known indices, or rows with a single 1."""
        if part.values:
            return ~np.isnan(scaled)
        rows: np.ndarray = ((scaled == 0) | (scaled == 1)) & (scaled.sum(1, keepdims=True) == 1)
        return rows

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        yield Information.of_logits(slice(0, self.numbers), acting, self.logits.softmax(-1))

    @property
    def shape(self) -> torch.Size:
        return torch.Size([*self.logits.shape[:-1], self.logits.shape[-1] if bool(self.rows) else 1])

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log softmax(logits)[a], [..., K, A]: in the first dimension, 0 in the others; -inf for no such action."""
        index, possible = self._index(actions)
        log_probs = self.logits.log_softmax(-1)
        chosen = log_probs.gather(-1, index.unsqueeze(-2).expand(*log_probs.shape[:-1], 1))
        return pad(torch.where(possible.unsqueeze(-2), chosen, NEVER), (0, self.shape[-1] - 1))

    def tensors(self) -> tuple[Tensor, ...]:
        """The logits; ``rows`` is a truth value, whatever its type."""
        return (self.logits,)

    def _index(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """The index of each action [..., A], and whether there is such an action, [..., 1]."""
        classes = self.logits.shape[-1]
        index = actions.argmax(-1, keepdim=True) if bool(self.rows) else actions.clamp(0, classes - 1).long()
        meant = one_hot(index.squeeze(-1), classes) if bool(self.rows) else index
        return index, (actions == meant).all(-1, keepdim=True)

    def log_density(self, actions: Tensor) -> Tensor:
        return self.by_dimension(actions)[..., 0]

    @property
    def mode(self) -> Tensor:
        return self._action(self.logits.argmax(-1))

    def draw(self, noise: Tensor) -> Tensor:
        """The first action up to which the probabilities sum to more than Φ(z) of the first number."""
        total = self.logits.double().softmax(-1).cumsum(-1)
        uniform = ndtr(noise[..., :1].double()).unsqueeze(-2)
        return self._action((total <= uniform * total[..., -1:]).sum(-1).clamp(max=total.shape[-1] - 1))

    def divergence(self, i: int) -> Tensor:
        """½ Σ (p_i - p_j)(log p_i - log p_j)."""
        second = self.logits.double().log_softmax(-1)
        first = second[..., i : i + 1, :]
        return 0.5 * ((first.exp() - second.exp()) * (first - second)).sum(-1)

    def _action(self, index: Tensor) -> Tensor:
        actions = one_hot(index, self.logits.shape[-1]) if bool(self.rows) else index.unsqueeze(-1)
        return actions.to(self.logits.dtype)
