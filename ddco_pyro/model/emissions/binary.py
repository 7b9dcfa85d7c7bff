"""Switches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.special import ndtr

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.emissions.base import Emission, Information, Part, log_logistic, phi
from ddco_pyro.model.tables import NEVER


def of_switch(first: Tensor, second: Tensor) -> Tensor:
    """The divergence ½ (p_i - p_j)(y_i - y_j) of two switches; torch's own may be infinite by rounding."""
    return 0.5 * (first.sigmoid() - second.sigmoid()) * (first - second)


def binary_control(part: Part, logits: np.ndarray, _: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """The position of each switch."""
    on = logits > 0 if z is None else np.array([phi(value) for value in z]) < 1 / (1 + np.exp(-logits))
    low, high = (np.array(ends) for ends in part["ends"])
    return np.where(on, high, low)


@dataclass(frozen=True)
class Binary(Emission):
    """Switches, each on (1) with probability logistic(y) and off (0) otherwise.

    :param logits: y, [..., K, A].
    """

    logits: Tensor
    helpers: ClassVar = (phi,)
    control: ClassVar = staticmethod(binary_control)

    @classmethod
    def possible(cls, part: ControlPart, scaled: np.ndarray) -> np.ndarray:
        """Both positions."""
        positions: np.ndarray = (scaled == 0) | (scaled == 1)
        return positions

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """p (1 - p) of each switch."""
        p = self.logits.sigmoid()
        yield Information(slice(0, self.numbers), acting.unsqueeze(-1) * p * (1 - p))

    def by_dimension(self, actions: Tensor) -> Tensor:
        """The log-probability of each switch's position, [..., K, A]; -inf for values other than 0 and 1."""
        actions = actions.unsqueeze(-2).to(self.logits.dtype)
        position, known = log_logistic((2 * actions - 1) * self.logits), (actions == 0) | (actions == 1)
        return position if bool(known.all()) else torch.where(known, position, NEVER)

    @property
    def mode(self) -> Tensor:
        """The more likely position."""
        return (self.logits > 0).to(self.logits.dtype)

    def draw(self, noise: Tensor) -> Tensor:
        """On where Φ(z) is less than logistic(y)."""
        return (ndtr(noise).unsqueeze(-2) < self.logits.sigmoid()).to(self.logits.dtype)

    def divergence(self, i: int) -> Tensor:
        """½ Σ (p_i - p_j)(y_i - y_j)."""
        logits = self.logits.double()
        return of_switch(logits[..., i : i + 1, :], logits).sum(-1)
