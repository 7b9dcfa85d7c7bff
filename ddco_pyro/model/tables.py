"""The log-probabilities of an AHMM as arrays, from which the engines in :mod:`ddco_pyro.inference` eliminate
latents.

Level 1 is the lowest, level D the highest option level; the meta-policy calls level D. At each step every
level d has a choice h^d in {0, 1, ..., k_d}: options are 1 to k_d, and choice 0 is *control*: the caller
emits the physical control itself, for this step. Below a choice 0 every lower choice is 0 too.

:class:`Tables` holds what the networks give; :class:`Chain` adds what the model fixes: choice 0 and padding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

NEVER = -torch.inf
"""Log-probability of an impossible event: a true zero, not a small number."""


@dataclass(frozen=True)
class Tables:
    """Every log-probability the networks give for N trajectories of at most T steps.

    Tuples run over the levels, lowest first. K_d is the number of callers of level d: the k_{d+1} options of
    the level above, or 1 (the meta-policy) for the highest level.

    :param selection: log η^{d+1}(h^d | s_t, h^{d+1}), shapes [N, T, K_d, 1 + k_d]; the first choice is
        control.
    :param termination: (log(1 - ψ^d(s_t)), log ψ^d(s_t)), shapes [N, T, k_d, 2]; unused at t = 0.
    :param control: log π(a_t | s_t) of each level's options and, last, of the meta-policy, shapes [N, T, k_d]
        and [N, T, 1]; -inf for callers that emit no control; empty where no control is known.
    :param evidence: log-likelihood of each choice by other evidence, shapes [N, T, 1 + k_d]; None for a level
        without. Hard labels are 0 and -inf.
    :param power: β, how many times the log-density of each control counts in posteriors.
    :param logits: whether selections and terminations are logits, whose softmax over the last dimension is
        meant.
    """

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]
    control: tuple[Tensor, ...] = ()
    evidence: tuple[Tensor | None, ...] = field(default=())
    power: float = 1.0
    logits: bool = False

    @property
    def depth(self) -> int:
        """The number D of option levels; 0 is a flat policy."""
        return len(self.selection)

    @property
    def sizes(self) -> tuple[int, ...]:
        """C_d = 1 + k_d of each level, lowest first."""
        return tuple(table.shape[-1] for table in self.selection)

    @property
    def steps(self) -> int:
        """T, padding included."""
        return int((self.selection or self.control)[-1].shape[1])

    @classmethod
    def of(
        cls, depth: int, leaves: Sequence[Tensor | None], power: float = 1.0, logits: bool = False
    ) -> Tables:
        """The tables of a hierarchy of ``depth`` levels from their :meth:`leaves`."""
        selection, termination = leaves[:depth], leaves[depth : 2 * depth]
        control, evidence = leaves[2 * depth : 3 * depth + 1], leaves[3 * depth + 1 :]
        return cls(
            _present(selection), _present(termination), _present(control), tuple(evidence), power, logits
        )

    def normalised(self) -> Tables:
        """These tables with log-probabilities in place of logits."""
        if not self.logits:
            return self
        selection, termination = (tuple(map(normalised, each)) for each in (self.selection, self.termination))
        return replace(self, selection=selection, termination=termination, logits=False)

    def leaves(self) -> tuple[Tensor | None, ...]:
        """Every table: selections, terminations, controls and, where there is any, the evidence."""
        return (*self.selection, *self.termination, *self.control, *self.evidence)

    def joint_evidence(self) -> Tensor | None:
        """The evidence of every joint choice, float64 [N, T, C_D, ..., C_1]; None where there is none."""
        total: Tensor | None = None
        for level, evidence in enumerate(self.evidence, start=1):
            if evidence is not None:
                above, below = (1,) * (len(self.evidence) - level), (1,) * (level - 1)
                own = evidence.double().reshape(*evidence.shape[:2], *above, -1, *below)
                total = own if total is None else total + own
        return None if total is None else total.expand(*total.shape[:2], *reversed(self.sizes))

    def clamp(self, level: int, choices: Tensor) -> Tables:
        """These tables with the choices of one level clamped to ``choices`` [N, T]; -1 leaves a step free.

        :param level: 1 is the lowest.
        """
        each, choices = torch.arange(self.sizes[level - 1]), choices.unsqueeze(-1)
        return self.with_evidence(level, torch.where((choices == each) | (choices < 0), 0.0, NEVER))

    def with_evidence(self, level: int, own: Tensor) -> Tables:
        """These tables with further evidence of a level's choices, [N, T, 1 + k_d].

        :param level: 1 is the lowest.
        """
        evidence = list(self.evidence or (None,) * self.depth)
        before = evidence[level - 1]
        evidence[level - 1] = own if before is None else before + own
        return replace(self, evidence=tuple(evidence))

    def memoryless(self) -> Tables:
        """These tables with ψ = 1 at every level: every option ends after every step."""
        return replace(self, termination=tuple(always_ending(table.shape[:-1]) for table in self.termination))

    def apart(self) -> tuple[Tables, Tables]:
        """These tables with a uniform meta-policy, and with a gradient for the meta-policy alone."""
        *lower, top = self.selection
        uniform = torch.full_like(top, -math.log(top.shape[-1] - 1))
        uniform[..., 0] = NEVER
        fixed = self.map(Tensor.detach)
        levels = replace(self, selection=(*lower, uniform))
        return levels, replace(fixed, selection=(*fixed.selection[:-1], top))

    def part(self, rows: Tensor, steps: int) -> Tables:
        """The first steps of the trajectories ``rows`` [M]; no copy where these are consecutive."""
        chosen = consecutive(rows)
        return self.map(lambda table: table[chosen, :steps])

    def map(self, change: Callable[[Tensor], Tensor]) -> Tables:
        """These tables, each changed."""
        return replace(
            self,
            selection=tuple(map(change, self.selection)),
            termination=tuple(map(change, self.termination)),
            control=tuple(map(change, self.control)),
            evidence=tuple(None if own is None else change(own) for own in self.evidence),
        )


def by_step(values: Tensor, before: int = 2) -> Tensor:
    """[N, T, ...] seen as [..., T, N]: so many first dimensions, in reverse order, behind the others.

    What networks give, and what follows from it, has trajectories side by side in memory: torch computes
    several times as fast so as over a last dimension of a few options or controls, and so does the pass.
    """
    return values.permute(*range(before, values.dim()), *reversed(range(before)))


def by_trajectory(values: Tensor, before: int = 2) -> Tensor:
    """[..., T, N] seen as [N, T, ...]."""
    behind = values.dim() - before
    return values.permute(*reversed(range(behind, values.dim())), *range(behind))


def part(values: Tensor, rows: Tensor | slice, steps: slice) -> Tensor:
    """Steps of some trajectories of [N, T, ...], with these trajectories side by side in memory."""
    return by_trajectory(by_step(values)[..., steps, rows].contiguous())


def consecutive(rows: Tensor) -> Tensor | slice:
    """Indices of trajectories [M]; a slice, which copies nothing, where they are consecutive."""
    return slice(int(rows[0]), int(rows[-1]) + 1) if bool((rows.diff() == 1).all()) else rows


def normalised(logits: Tensor) -> Tensor:
    """The log-softmax over the last dimension of [N, T, K, C], in the same order in memory."""
    return by_trajectory(by_step(logits).log_softmax(1))


def always_ending(shape: torch.Size) -> Tensor:
    """The termination table of options that end after every step, [N, T, k, 2], from [N, T, k]."""
    return torch.tensor([NEVER, 0.0]).expand(*shape, 2)


def always_ends(termination: Tensor) -> bool:
    """Whether a level's termination table [N, T, k, 2] is that of options that end after every step.

    A network's ψ is less than 1.
    """
    return bool(termination[0, 0, 0, 0] == NEVER)


@dataclass(frozen=True)
class Chain:
    """The complete Markov chain over joint choices that :class:`Tables` describe.

    C_d = 1 + k_d counts the choices of level d, control among them.

    :param selection: log-probability of choosing h^d given the caller h^{d+1}, shapes [N, T, C_{d+1}, C_d];
        the highest level's has one caller.
    :param termination: log-probabilities of b^d = 0 and 1 given h^d, shapes [N, T, C_d, 2].
    :param evidence: log-likelihood of the joint choice by other evidence, [N, T, C_D, ..., C_1]; None for
        none.
    :param emission: β times the log-density of the control given the joint choice, and the evidence,
        [N, T, C_D, ..., C_1]; None where no control is known.
    :param alive: whether a step is within its trajectory's length, [N, T].
    :param power: β.
    """

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]
    evidence: Tensor | None
    emission: Tensor | None
    alive: Tensor
    power: float = 1.0

    @property
    def depth(self) -> int:
        """The number D of option levels."""
        return len(self.selection)

    def steps(self) -> list[Chain]:
        """The chain's T steps, whose tables have no time dimension.

        They are unbound once: slicing inside a loop over time would make its gradient O(T²).
        """
        selection = [table.unbind(1) for table in self.selection]
        termination = [table.unbind(1) for table in self.termination]
        nothing = (None,) * self.alive.shape[1]
        evidence = nothing if self.evidence is None else self.evidence.unbind(1)
        emission = nothing if self.emission is None else self.emission.unbind(1)
        return [
            Chain(
                tuple(s[t] for s in selection),
                tuple(b[t] for b in termination),
                evidence[t],
                emission[t],
                alive,
            )
            for t, alive in enumerate(self.alive.unbind(1))
        ]


def complete(tables: Tables, lengths: Tensor) -> Chain:
    """The chain of these tables, in float64: choice 0 filled in, steps past ``lengths`` [N] made inert.

    An inert step keeps every choice and emits nothing, so it changes no probability.
    """
    tables = tables.normalised()
    steps = tables.steps if tables.selection or tables.control else int(lengths.max())
    alive = torch.arange(steps, device=lengths.device) < lengths[:, None]
    selection = tuple(
        _control_selects_control(table.double()) if level < tables.depth else table.double()
        for level, table in enumerate(tables.selection, start=1)
    )
    termination = tuple(
        _keep_past_the_end(_control_lasts_one_step(t.double()), alive) for t in tables.termination
    )
    evidence = _only(alive, tables.joint_evidence())
    emission = _only(alive, tables.power * joint_density(tables.control)) if tables.control else None
    if emission is not None and evidence is not None:
        emission = emission + evidence
    return Chain(selection, termination, evidence, emission, alive, tables.power)


def _only(alive: Tensor, table: Tensor | None) -> Tensor | None:
    """The table, 0 past the lengths."""
    return None if table is None else torch.where(_like(alive, table), table, 0.0)


def _control_selects_control(selection: Tensor) -> Tensor:
    """[N, T, K, C] to [N, T, 1 + K, C]: below a choice 0 only choice 0 is left."""
    row = torch.full_like(selection[:, :, :1], NEVER)
    row[..., 0] = 0.0
    return torch.cat([row, selection], dim=2)


def _control_lasts_one_step(termination: Tensor) -> Tensor:
    """[N, T, k, 2] to [N, T, 1 + k, 2]: choice 0 terminates with probability 1."""
    row = termination.new_tensor([NEVER, 0.0]).expand(*termination.shape[:2], 1, 2)
    return torch.cat([row, termination], dim=2)


def _keep_past_the_end(termination: Tensor, alive: Tensor) -> Tensor:
    keep = torch.tensor([0.0, NEVER], dtype=termination.dtype, device=termination.device)
    return torch.where(_like(alive, termination), termination, keep)


def joint_density(control: Sequence[Tensor]) -> Tensor:
    """log π(a_t | h^D_t, ..., h^1_t) float64 [N, T, C_D, ..., C_1]; the lowest level with an option acts."""
    depth = len(control) - 1
    emission = control[-1].double().squeeze(-1)
    for level in range(depth, 0, -1):
        own = control[level - 1].double()
        own = own.reshape(own.shape[:2] + (1,) * (emission.dim() - 2) + own.shape[-1:])
        own = own.expand(*emission.shape, -1)
        if level < depth:  # below a choice 0 nothing but choice 0 is possible
            own = torch.cat([torch.full_like(own[..., :1, :], NEVER), own[..., 1:, :]], dim=-2)
        emission = torch.cat([emission.unsqueeze(-1), own], dim=-1)
    return emission


def _present(tables: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """Tables of which none is missing."""
    return tuple(table for table in tables if table is not None)


def _like(mask: Tensor, table: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (table.dim() - mask.dim()))
