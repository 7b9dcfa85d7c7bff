"""The AHMM with its latents eliminated, as a distribution: for Pyro models with priors and guides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from ddco_pyro.inference import log_likelihood
from ddco_pyro.model.ahmm import complete, draw
from ddco_pyro.model.outputs import Decision, Outputs


class EliminatedAHMM(TorchDistribution):
    """The controls of N demonstrations given their observations: Σ_ζ p(ζ, a | s), without the dynamics (§4.1).

    ``pyro.sample("controls", EliminatedAHMM(hierarchy(batch.inputs), log_volume, batch.lengths), obs=batch.actions)``
    in a plate over demonstrations takes the place of the enumerated model :func:`ddco_pyro.model.ahmm.ahmm`. Its
    gradient is the posterior; second derivatives are refused.

    :param outputs: what the networks say about the observations; the batch shape is [N], the event shape [T, A].
    :param log_volume: that of the control's scaling, so that densities are in the control's own units.
    :param lengths: steps of each demonstration, [N]; whatever a value holds beyond is ignored.
    """

    arg_constraints: ClassVar = {}
    support = constraints.independent(constraints.real, 2)

    def __init__(
        self, outputs: Outputs, log_volume: Tensor, lengths: Tensor, validate_args: bool | None = None
    ) -> None:
        self.outputs, self.log_volume, self.lengths = outputs, log_volume, lengths
        means = [one.mean for one in outputs.decisions if one.mean is not None]
        number, steps, _, size = means[0].shape
        super().__init__(torch.Size([number]), torch.Size([steps, size]), validate_args=validate_args)

    def log_prob(self, value: Tensor) -> Tensor:
        """log p(a | s) of controls [N, T, A] in scaled units, [N] nats."""
        return log_likelihood(self.outputs.tables(value, self.log_volume), self.lengths)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> EliminatedAHMM:
        """The same distribution: it is as large as its demonstrations."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise ValueError(
                f"a batch of {len(self.lengths)} demonstrations cannot be expanded to {tuple(batch_shape)}"
            )
        return self

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Controls [N, T, A] in scaled units along the same observations; 0 past the lengths."""
        if tuple(sample_shape):
            raise ValueError("one draw at a time: sample_shape is not supported")
        with torch.no_grad():
            nothing = torch.zeros(*self.batch_shape, *self.event_shape)
            chain = complete(self.outputs.tables(nothing, self.log_volume), self.lengths)
            choices = draw(chain)
            alive = torch.arange(self.event_shape[0]) < self.lengths[:, None]
            return torch.where(alive.unsqueeze(-1), self._act(choices), 0.0)

    def _act(self, choices: tuple[Tensor, ...]) -> Tensor:
        """The control of whoever acts, [N, T, A]: the lowest level whose choice is not 0, else the meta-policy."""
        control = _normal(self.outputs.decisions[-1], torch.zeros(self.lengths.shape + self.event_shape[:1]).long())
        for level in range(len(choices) - 1, -1, -1):
            chosen = choices[level]
            own = _normal(self.outputs.decisions[level], (chosen - 1).clamp(min=0))
            control = torch.where((chosen > 0).unsqueeze(-1), own, control)
        return control


def _normal(decision: Decision, actor: Tensor) -> Tensor:
    """Draws of a level's Gaussian control, [N, T, A]; NaN where it emits none."""
    if decision.mean is None:
        return torch.full((*actor.shape, len(decision.std)), torch.nan)
    index = actor[..., None, None].expand(*actor.shape, 1, decision.mean.shape[-1])
    return torch.normal(decision.mean.gather(2, index).squeeze(2), decision.std)
