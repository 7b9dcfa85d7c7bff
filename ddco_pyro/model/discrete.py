"""Emissions of controls that take a few values: switches and discrete actions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, one_hot, pad
from torch.special import ndtr

from ddco_pyro.model.emissions import Kind
from ddco_pyro.model.tables import NEVER


@dataclass(frozen=True)
class Binary(Kind):
    """Switches, each of them on (1) with probability logistic(y), off (0) otherwise.

    :param logits: y, [..., K, A].
    """

    logits: Tensor

    def by_dimension(self, actions: Tensor) -> Tensor:
        """Logarithms of the probabilities of the switches' positions, [..., K, A]; -inf for anything but 0 and 1."""
        actions = actions.unsqueeze(-2)
        position = logsigmoid(torch.where(actions > 0.5, self.logits, -self.logits))
        return torch.where((actions == 0) | (actions == 1), position, NEVER)

    @property
    def mode(self) -> Tensor:
        """The more likely position."""
        return (self.logits > 0).to(self.logits.dtype)

    def draw(self, noise: Tensor) -> Tensor:
        """On where Φ(z) is less than the probability of it."""
        return (ndtr(noise).unsqueeze(-2) < self.logits.sigmoid()).to(self.logits.dtype)

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences, ½ Σ (p_i - p_j)(y_i - y_j)."""
        first, second = self.logits[..., i, :].double(), self.logits[..., j, :].double()
        return 0.5 * ((first.sigmoid() - second.sigmoid()) * (first - second)).sum(-1)


@dataclass(frozen=True)
class Categorical(Kind):
    """One of C discrete actions, as its index (A = 1) or, where A = C, as a row with a single 1.

    :param logits: [..., K, C].
    :param rows: whether actions are rows; a tensor with one truth value.
    """

    logits: Tensor
    rows: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return torch.Size([*self.logits.shape[:-1], self.logits.shape[-1] if bool(self.rows) else 1])

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log softmax(logits)[a], [..., K, A]: in the first dimension, 0 in the others; -inf for no such action."""
        classes = self.logits.shape[-1]
        index = actions.argmax(-1, keepdim=True) if bool(self.rows) else actions.clamp(0, classes - 1).long()
        meant = one_hot(index.squeeze(-1), classes) if bool(self.rows) else index
        possible = (actions == meant).all(-1, keepdim=True).unsqueeze(-2)
        log_probs = self.logits.log_softmax(-1)
        chosen = log_probs.gather(-1, index.unsqueeze(-2).expand(*log_probs.shape[:-1], 1))
        return pad(torch.where(possible, chosen, NEVER), (0, self.shape[-1] - 1))

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return self.by_dimension(actions)[..., 0]

    @property
    def mode(self) -> Tensor:
        """The most likely action."""
        return self._action(self.logits.argmax(-1))

    def draw(self, noise: Tensor) -> Tensor:
        """The first action up to which the probabilities sum to more than Φ(z) of the first number."""
        total = self.logits.double().softmax(-1).cumsum(-1)
        uniform = ndtr(noise[..., :1].double()).unsqueeze(-2)
        return self._action((total <= uniform * total[..., -1:]).sum(-1).clamp(max=total.shape[-1] - 1))

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences."""
        first, second = (self.logits[..., caller, :].double().log_softmax(-1) for caller in (i, j))
        return 0.5 * ((first.exp() - second.exp()) * (first - second)).sum(-1)

    def _action(self, index: Tensor) -> Tensor:
        actions = one_hot(index, self.logits.shape[-1]) if bool(self.rows) else index.unsqueeze(-1)
        return actions.to(self.logits.dtype)
