"""The abstract hidden Markov model of DDCO (paper §4.1, §4.2), for any number of option levels, as a Pyro
program.

:mod:`ddco_pyro.model.tables` numbers the levels and their choices. The networks' outputs are given; the
program draws the options and the control of the acting caller. The engines in :mod:`ddco_pyro.inference`
eliminate its latents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import pyro
import torch
from numpy import broadcast_shapes  # torch's imports sympy
from pyro.distributions import TorchDistribution
from pyro.ops.indexing import Vindex
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import one_hot

from ddco_pyro.model.emissions import Emission
from ddco_pyro.model.tables import NEVER, Chain


class Tabulated(TorchDistribution):
    """A choice among C whose log-probabilities [..., C] are used as they stand.

    Unlike ``Categorical`` it neither renormalises nor replaces -inf, so the gradient of a marginal likelihood
    with respect to a table is the posterior probability of its entries.
    """

    arg_constraints: ClassVar = {"logits": constraints.real_vector}
    has_enumerate_support = True

    def __init__(self, logits: Tensor, validate_args: bool | None = None) -> None:
        self.logits = logits
        super().__init__(logits.shape[:-1], validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        return constraints.integer_interval(0, self.logits.shape[-1] - 1)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Tabulated:
        return Tabulated(self.logits.expand(*batch_shape, -1), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        return Vindex(self.logits)[..., value.long()]

    def enumerate_support(self, expand: bool = True) -> Tensor:
        values = torch.arange(self.logits.shape[-1], device=self.logits.device)
        values = values.reshape((-1,) + (1,) * len(self.batch_shape))
        return values.expand((-1, *self.batch_shape)) if expand else values

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        return torch.distributions.Categorical(logits=self.logits, validate_args=False).sample(
            torch.Size(sample_shape)
        )


@dataclass(frozen=True)
class Scored:
    """Controls with known log-densities [..., K] and without dimensions; they cannot be drawn.

    The program runs on :class:`ddco_pyro.model.tables.Tables` with these in place of emissions.
    """

    table: Tensor

    @property
    def shape(self) -> torch.Size:
        return torch.Size([*self.table.shape, 0])

    def log_density(self, actions: Tensor) -> Tensor:
        return self.table

    def steps(self) -> list[Scored]:
        return [Scored(table) for table in self.table.unbind(1)]


Steps = Emission | Scored
"""What the program scores or draws a control with at each step."""


class Acting(TorchDistribution):
    """The control of the acting caller: of the lowest level whose choice is not 0, else of the meta-policy.

    :param emissions: of each level's options at one step, lowest first, the meta-policy's last, [N, K, A];
        None for callers that emit no control. The lowest level's callers always do.
    :param choices: (h^1, ..., h^D), each [..., N].
    """

    arg_constraints: ClassVar = {}
    support = constraints.real_vector

    def __init__(
        self, emissions: tuple[Any, ...], choices: tuple[Tensor, ...], validate_args: bool | None = None
    ) -> None:
        self.emissions, self.choices = emissions, choices
        *batch, _, size = emissions[0].shape
        shape = broadcast_shapes(batch, *(choice.shape for choice in choices))
        super().__init__(torch.Size(shape), torch.Size([size]), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Acting:
        return Acting(
            self.emissions, tuple(choice.expand(batch_shape) for choice in self.choices), validate_args=False
        )

    def log_prob(self, value: Tensor) -> Tensor:
        """log π(a | s) of the acting caller; -inf for impossible joint choices."""
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
        """A control of the acting caller, [..., N, A] in scaled units."""
        return self.draw(torch.randn(*sample_shape, *self.batch_shape, self.noise))

    @property
    def noise(self) -> int:
        number: int = self.emissions[0].noise
        return number

    def draw(self, noise: Tensor) -> Tensor:
        """The control [..., N, A] that standard normal numbers [..., N, noise] stand for."""
        with torch.no_grad():
            draws = [None if emission is None else emission.draw(noise) for emission in self.emissions]
            return self._of_actor(draws, torch.nan)

    @property
    def mode(self) -> Tensor:
        """The most likely control of the acting caller, [..., N, A] in scaled units."""
        return self._of_actor(
            [None if emission is None else emission.mode for emission in self.emissions], torch.nan
        )

    def _of_actor(self, values: Sequence[Tensor | None], missing: float) -> Tensor:
        """The acting caller's part [..., N, E] of values [..., N, K, E] of each level's callers."""
        none = torch.tensor([missing], dtype=torch.float64)
        acting = none if values[-1] is None else values[-1][..., 0, :]
        for own, choice in zip(reversed(values[:-1]), reversed(self.choices), strict=True):
            option = none if own is None else _of_caller(own, (choice - 1).clamp(min=0))
            acting = torch.where((choice > 0).unsqueeze(-1), option, acting)
        return acting


def _of_caller(values: Tensor, caller: Tensor) -> Tensor:
    """One caller's part [..., E] of values [..., K, E]."""
    shape = broadcast_shapes(values.shape[:-2], caller.shape)
    index = caller.expand(shape)[..., None, None].expand(*shape, 1, values.shape[-1])
    return values.expand(*shape, *values.shape[-2:]).gather(-2, index).squeeze(-2)


def choose(t: int, now: Chain, previous: tuple[Tensor, ...] | None) -> tuple[Tensor, ...]:
    """Sample sites ``b_{d}_{t}`` and ``h_{d}_{t}``: the choices (h^1, ..., h^D) at t, given those at t - 1.

    Terminations go bottom-up and selections top-down; without ``previous`` (t = 0) everything is selected.
    P(b_t, h_t | h_{t-1}, s_t) of §4.1, applied at every level.
    """
    rows = torch.arange(len(now.alive))
    terminated = [] if previous is None else _terminate(t, now, previous, rows)
    choices: list[Tensor] = []
    caller = torch.zeros_like(rows)
    for level in range(len(now.selection), 0, -1):
        log_probs = Vindex(now.selection[level - 1])[rows, caller]
        if previous is not None:
            kept = torch.where(one_hot(previous[level - 1], log_probs.shape[-1]).bool(), 0.0, NEVER)
            log_probs = torch.where((terminated[level - 1] == 1).unsqueeze(-1), log_probs, kept)
        caller = pyro.sample(f"h_{level}_{t}", Tabulated(log_probs), infer={"enumerate": "parallel"})
        choices.append(caller)
    return tuple(reversed(choices))


def _terminate(t: int, now: Chain, previous: tuple[Tensor, ...], rows: Tensor) -> list[Tensor]:
    """(b^1_t, ..., b^D_t): b^d can be 1 only where b^{d-1} is."""
    keep = torch.tensor([0.0, NEVER], dtype=torch.float64)
    below = torch.ones_like(rows)
    terminated: list[Tensor] = []
    for level, table in enumerate(now.termination, start=1):
        log_probs = Vindex(table)[rows, previous[level - 1]]
        log_probs = torch.where((below == 1).unsqueeze(-1), log_probs, keep)
        below = pyro.sample(f"b_{level}_{t}", Tabulated(log_probs), infer={"enumerate": "parallel"})
        terminated.append(below)
    return terminated


def ahmm(chain: Chain, emissions: Sequence[Steps | None], actions: Tensor | None = None) -> None:
    """The joint probability p(ζ, ξ) of latents and controls of §4.1, without the dynamics p(s' | s, a).

    The log-density of controls counts β times, the chain's ``power``: a coarsened posterior (Miller and
    Dunson 2019).

    Sample sites ``b_{d}_{t}``, ``h_{d}_{t}`` [N] and ``a_{t}`` [N, A], the control in scaled units.

    :param chain: the log-probabilities of selections and terminations; the controls' are not used.
    :param emissions: how the callers of each level emit the control, [N, T, K, A], lowest first, the
        meta-policy's last; None for a level whose callers emit none.
    :param actions: the controls that were applied, [N, T, A]; without them controls are drawn.
    """
    with pyro.plate("demonstrations", len(chain.alive), dim=-1):
        run(chain, emissions, actions)


def run(chain: Chain, emissions: Sequence[Steps | None], actions: Tensor | None = None) -> None:
    """The program of :func:`ahmm` outside its plate over demonstrations."""
    steps = chain.steps()
    nothing: list[None] = [None] * len(steps)
    emitting = list(
        zip(*(nothing if emission is None else emission.steps() for emission in emissions), strict=True)
    )
    applied = nothing if actions is None else actions.unbind(1)
    choices: tuple[Tensor, ...] | None = None
    for t in pyro.markov(range(len(steps))):
        choices = choose(t, steps[t], choices)
        with pyro.poutine.scale(scale=chain.power):
            pyro.sample(f"a_{t}", Acting(emitting[t], choices).mask(steps[t].alive), obs=applied[t])
        if (evidence := steps[t].evidence) is not None:
            rows = torch.arange(len(evidence))
            pyro.factor(f"evidence_{t}", Vindex(evidence)[(rows, *reversed(choices))])
