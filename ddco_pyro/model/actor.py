"""The control of whoever acts, as a distribution: what the Pyro program scores or draws at each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from ddco_pyro.model.tables import NEVER


@dataclass(frozen=True)
class Scored:
    """Controls of which only log-densities [..., K] are known: they have no dimensions, and cannot be drawn.

    With it the Pyro program of :mod:`ddco_pyro.model.ahmm` runs on :class:`ddco_pyro.model.tables.Tables`.
    """

    table: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, 0]."""
        return torch.Size([*self.table.shape, 0])

    def log_density(self, actions: Tensor) -> Tensor:
        """What is known, whatever the controls."""
        return self.table

    def steps(self) -> list[Scored]:
        """The same at each step."""
        return [Scored(table) for table in self.table.unbind(1)]


class Acting(TorchDistribution):
    """The control of whoever acts: the lowest level whose choice is not 0, else the meta-policy.

    :param emissions: of each level's options at one step, lowest first, the meta-policy's last, [N, K, A]; None for
        callers that emit no control, which the lowest level's always do.
    :param choices: (h^1, ..., h^D), each [..., N].
    """

    arg_constraints: ClassVar = {}
    support = constraints.real_vector

    def __init__(
        self,
        emissions: tuple[Any, ...],
        choices: tuple[Tensor, ...],
        validate_args: bool | None = None,
    ) -> None:
        self.emissions, self.choices = emissions, choices
        *batch, _, size = emissions[0].shape
        shape = torch.broadcast_shapes(batch, *(choice.shape for choice in choices))
        super().__init__(shape, torch.Size([size]), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Acting:
        """The same for choices of a larger batch."""
        return Acting(self.emissions, tuple(choice.expand(batch_shape) for choice in self.choices), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """log π(a | s) of who acts; -inf for joint choices that cannot be."""
        control = torch.zeros((), dtype=torch.bool)
        impossible = control
        for choice in reversed(self.choices):
            impossible = impossible | (control & (choice > 0))
            control = control | (choice == 0)
        densities = [
            None if emission is None else emission.log_density(value).double().unsqueeze(-1)
            for emission in self.emissions
        ]
        density = self._of_actor(densities, NEVER).squeeze(-1)
        return torch.where(impossible, NEVER, density).expand(self.batch_shape)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A control of who acts, [..., N, A] in scaled units."""
        return self.draw(torch.randn(*sample_shape, *self.batch_shape, self.noise))

    @property
    def noise(self) -> int:
        """How many standard normal numbers a control is drawn from."""
        number: int = self.emissions[0].noise
        return number

    def draw(self, noise: Tensor) -> Tensor:
        """The control [..., N, A] that standard normal numbers [..., N, noise] stand for."""
        with torch.no_grad():
            draws = [None if emission is None else emission.draw(noise) for emission in self.emissions]
            return self._of_actor(draws, torch.nan)

    @property
    def mode(self) -> Tensor:
        """The most likely control of who acts, [..., N, A] in scaled units."""
        return self._of_actor([None if emission is None else emission.mode for emission in self.emissions], torch.nan)

    def _of_actor(self, values: Sequence[Tensor | None], missing: float) -> Tensor:
        """Of values [..., N, K, E] of each level's callers those of who acts, [..., N, E]."""
        acting = torch.tensor([missing], dtype=torch.float64) if values[-1] is None else values[-1][..., 0, :]
        for own, choice in zip(reversed(values[:-1]), reversed(self.choices), strict=True):
            option = (
                torch.tensor([missing], dtype=torch.float64)
                if own is None
                else _of_caller(own, (choice - 1).clamp(min=0))
            )
            acting = torch.where((choice > 0).unsqueeze(-1), option, acting)
        return acting


def _of_caller(values: Tensor, caller: Tensor) -> Tensor:
    """Of values [..., K, E] those of one caller, [..., E]."""
    shape = torch.broadcast_shapes(values.shape[:-2], caller.shape)
    index = caller.expand(shape)[..., None, None].expand(*shape, 1, values.shape[-1])
    return values.expand(*shape, *values.shape[-2:]).gather(-2, index).squeeze(-2)
