"""The abstract hidden Markov model of DDCO (paper §4.1, §4.2), for any number of option levels, as a Pyro program.

Level 1 is the lowest, level D the highest option level; the meta-policy calls level D. At each step every level d
has a choice h^d in {0, 1, ..., k_d}: options are 1 to k_d, and choice 0 is *control*: the caller emits the physical
control itself, for this step. Below a choice 0 there is nothing left to choose, so every lower choice is 0 too.

Everything the networks say about a batch is in :class:`Tables`. :class:`Chain` adds what the model fixes (choice 0,
padding), and :func:`ahmm` is the model itself. The engines in :mod:`ddco_pyro.inference` eliminate its latents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import pyro
import torch
from pyro.distributions import TorchDistribution
from pyro.ops.indexing import Vindex
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import one_hot

NEVER = -torch.inf
"""Log-probability of what cannot happen: a true zero, never a small number."""


@dataclass(frozen=True)
class Tables:
    """Every log-probability the networks give for N trajectories of at most T steps.

    Tuples run over the levels, lowest first. K_d is the number of callers of level d: the k_{d+1} options of the
    level above, or 1 (the meta-policy) for the highest level.

    :param selection: log η^{d+1}(h^d | s_t, h^{d+1}), shapes [N, T, K_d, 1 + k_d]; the first choice is control.
    :param termination: (log(1 - ψ^d(s_t)), log ψ^d(s_t)), shapes [N, T, k_d, 2]; unused at t = 0.
    :param control: log π(a_t | s_t) of each level's options and, last, of the meta-policy, shapes [N, T, k_d] and
        [N, T, 1]; -inf where that caller does not emit control.
    :param evidence: what else is known of the choices, added to the log-likelihood of each choice, shapes
        [N, T, 1 + k_d]; None where nothing is. Hard labels are 0 and -inf.
    """

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]
    control: tuple[Tensor, ...]
    evidence: tuple[Tensor | None, ...] = field(default=())

    @property
    def depth(self) -> int:
        """The number D of option levels; 0 is a flat policy."""
        return len(self.selection)

    @classmethod
    def of(cls, depth: int, leaves: Sequence[Tensor | None]) -> Tables:
        """The tables of a hierarchy of so many levels from their :meth:`leaves`."""
        selection, termination = leaves[:depth], leaves[depth : 2 * depth]
        control, evidence = leaves[2 * depth : 3 * depth + 1], leaves[3 * depth + 1 :]
        return cls(_present(selection), _present(termination), _present(control), tuple(evidence))

    def leaves(self) -> tuple[Tensor | None, ...]:
        """Every table: selections, terminations, controls and, where there is any, the evidence."""
        return (*self.selection, *self.termination, *self.control, *self.evidence)

    def joint_evidence(self) -> Tensor | None:
        """The evidence of every joint choice, float64 [N, T, C_D, ..., C_1]; None where there is none."""
        total: Tensor | None = None
        sizes = [table.shape[-1] for table in self.selection]
        for level, evidence in enumerate(self.evidence, start=1):
            if evidence is not None:
                shape = evidence.shape[:2] + (1,) * (self.depth - level) + evidence.shape[2:] + (1,) * (level - 1)
                own = evidence.double().reshape(shape)
                total = own if total is None else total + own
        return None if total is None else total.expand(*total.shape[:2], *reversed(sizes))

    def clamp(self, level: int, choices: Tensor) -> Tables:
        """These tables where the choices of one level (1 is the lowest) are known to be ``choices``, [N, T]."""
        evidence = list(self.evidence or (None,) * self.depth)
        size = self.selection[level - 1].shape[-1]
        evidence[level - 1] = torch.where(one_hot(choices, size).bool(), 0.0, NEVER)
        return replace(self, evidence=tuple(evidence))

    def trajectory(self, n: int, length: int) -> Tables:
        """The first ``length`` steps of trajectory ``n`` alone, as tables with N = 1."""

        def cut(tables: Sequence[Tensor | None]) -> Any:
            return tuple(None if table is None else table[n : n + 1, :length] for table in tables)

        return Tables(cut(self.selection), cut(self.termination), cut(self.control), cut(self.evidence))


@dataclass(frozen=True)
class Chain:
    """The Markov chain over joint choices that :class:`Tables` describe, complete: what an engine eliminates.

    C_d = 1 + k_d counts the choices of level d, control among them.

    :param selection: log-probability of choosing h^d given the caller h^{d+1}, shapes [N, T, C_{d+1}, C_d];
        the highest level's has one caller.
    :param termination: log-probabilities of b^d = 0 and 1 given h^d, shapes [N, T, C_d, 2].
    :param emission: log-probability of the control given the joint choice, [N, T, C_D, ..., C_1].
    """

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]
    emission: Tensor

    @property
    def depth(self) -> int:
        """The number D of option levels."""
        return len(self.selection)

    def steps(self) -> list[Step]:
        """The chain's T steps, unbound once: slicing inside a loop over time would make its gradient O(T²)."""
        selection = [table.unbind(1) for table in self.selection]
        termination = [table.unbind(1) for table in self.termination]
        return [
            Step(tuple(s[t] for s in selection), tuple(b[t] for b in termination), emission)
            for t, emission in enumerate(self.emission.unbind(1))
        ]


class Step(NamedTuple):
    """One step of a :class:`Chain`: its tables without the time dimension."""

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]
    emission: Tensor


def complete(tables: Tables, lengths: Tensor) -> Chain:
    """The chain of these tables, in float64: choice 0 filled in, steps past ``lengths`` [N] made inert.

    An inert step keeps every choice and emits nothing, so it changes no probability.
    """
    steps = tables.control[-1].shape[1]
    alive = torch.arange(steps, device=lengths.device) < lengths[:, None]
    selection = tuple(
        _control_selects_control(table.double()) if level < tables.depth else table.double()
        for level, table in enumerate(tables.selection, start=1)
    )
    termination = tuple(_keep_past_the_end(_control_lasts_one_step(t.double()), alive) for t in tables.termination)
    emission = _emission(tables)
    return Chain(selection, termination, torch.where(_like(alive, emission), emission, 0.0))


def _control_selects_control(selection: Tensor) -> Tensor:
    """[N, T, K, C] to [N, T, 1 + K, C]: below a choice 0 only choice 0 is left."""
    row = torch.full_like(selection[:, :, :1], NEVER)
    row[..., 0] = 0.0
    return torch.cat([row, selection], dim=2)


def _control_lasts_one_step(termination: Tensor) -> Tensor:
    """[N, T, k, 2] to [N, T, 1 + k, 2]: choice 0 terminates with probability 1."""
    row = torch.full_like(termination[:, :, :1], NEVER)
    row[..., 1] = 0.0
    return torch.cat([row, termination], dim=2)


def _keep_past_the_end(termination: Tensor, alive: Tensor) -> Tensor:
    keep = torch.tensor([0.0, NEVER], dtype=termination.dtype, device=termination.device)
    return torch.where(_like(alive, termination), termination, keep)


def _emission(tables: Tables) -> Tensor:
    """log p(a_t | h^D_t, ..., h^1_t), evidence included: the lowest level whose choice is not 0 acts."""
    emission = tables.control[-1].double().squeeze(-1)
    for level in range(tables.depth, 0, -1):
        own = tables.control[level - 1].double()
        own = own.reshape(own.shape[:2] + (1,) * (emission.dim() - 2) + own.shape[-1:])
        own = own.expand(*emission.shape, -1)
        if level < tables.depth:  # below a choice 0 nothing but choice 0 is possible
            own = torch.cat([torch.full_like(own[..., :1, :], NEVER), own[..., 1:, :]], dim=-2)
        emission = torch.cat([emission.unsqueeze(-1), own], dim=-1)
    evidence = tables.joint_evidence()
    return emission if evidence is None else emission + evidence


def _present(tables: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """Tables of which none is missing."""
    return tuple(table for table in tables if table is not None)


def _like(mask: Tensor, table: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (table.dim() - mask.dim()))


class Tabulated(TorchDistribution):
    """A choice among C whose log-probabilities [..., C] are used as they stand.

    Unlike ``Categorical`` it neither renormalises nor replaces -inf, so the gradient of a marginal likelihood with
    respect to a table is the posterior probability of its entries.
    """

    arg_constraints: ClassVar = {"logits": constraints.real_vector}
    has_enumerate_support = True

    def __init__(self, logits: Tensor, validate_args: bool | None = None) -> None:
        self.logits = logits
        super().__init__(logits.shape[:-1], validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """The choices 0 to C - 1."""
        return constraints.integer_interval(0, self.logits.shape[-1] - 1)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Tabulated:
        """The same choice for a larger batch."""
        return Tabulated(self.logits.expand(*batch_shape, -1), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """The table's entries at ``value``."""
        return Vindex(self.logits)[..., value.long()]

    def enumerate_support(self, expand: bool = True) -> Tensor:
        """Every choice, along a new first dimension."""
        values = torch.arange(self.logits.shape[-1], device=self.logits.device)
        values = values.reshape((-1,) + (1,) * len(self.batch_shape))
        return values.expand((-1, *self.batch_shape)) if expand else values

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A draw from the choices."""
        return torch.distributions.Categorical(logits=self.logits, validate_args=False).sample(torch.Size(sample_shape))


def choose(t: int, now: Step, previous: tuple[Tensor, ...] | None) -> tuple[Tensor, ...]:
    """Sample sites ``b_{d}_{t}`` and ``h_{d}_{t}``: the choices (h^1, ..., h^D) at t, given those at t - 1.

    Terminations go bottom-up and selections top-down; without ``previous`` (t = 0) everything is selected.
    P(b_t, h_t | h_{t-1}, s_t) of §4.1, applied at every level.
    """
    rows = torch.arange(now.emission.shape[0])
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


def _terminate(t: int, now: Step, previous: tuple[Tensor, ...], rows: Tensor) -> list[Tensor]:
    """(b^1_t, ..., b^D_t): b^d can be 1 only where b^{d-1} is."""
    keep = torch.tensor([0.0, NEVER], dtype=now.emission.dtype)
    below = torch.ones_like(rows)
    terminated: list[Tensor] = []
    for level, table in enumerate(now.termination, start=1):
        log_probs = Vindex(table)[rows, previous[level - 1]]
        log_probs = torch.where((below == 1).unsqueeze(-1), log_probs, keep)
        below = pyro.sample(f"b_{level}_{t}", Tabulated(log_probs), infer={"enumerate": "parallel"})
        terminated.append(below)
    return terminated


def ahmm(chain: Chain) -> None:
    """The joint probability p(ζ, ξ) of latents and controls of §4.1, without the dynamics p(s' | s, a).

    Latents: ``b_{d}_{t}`` and ``h_{d}_{t}``. Factors: ``a_{t}``, the log-density of the control that was applied.
    """
    steps = chain.steps()
    rows = torch.arange(len(chain.emission))
    with pyro.plate("demonstrations", len(chain.emission), dim=-1):
        choices: tuple[Tensor, ...] | None = None
        for t in pyro.markov(range(len(steps))):
            choices = choose(t, steps[t], choices)
            pyro.factor(f"a_{t}", Vindex(steps[t].emission)[(rows, *reversed(choices))])


def draw(chain: Chain) -> tuple[Tensor, ...]:
    """Choices of every level drawn from the chain run forward, whatever its emissions, each [N, T], lowest first."""
    found: list[tuple[Tensor, ...]] = []
    with pyro.poutine.block():
        for t, now in enumerate(chain.steps()):
            found.append(choose(t, now, found[-1] if found else None))
    return tuple(torch.stack(level, dim=1) for level in zip(*found, strict=True))
