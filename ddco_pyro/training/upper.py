"""Initialisation of the levels above the lowest, from which options of the lowest level follow each other.

An option above the lowest level shows in its sequence of selections, not in a single step. An AHMM is
therefore fitted whose selections, and terminations above the lowest level, do not depend on the state: a
hierarchical hidden Markov model (Fine, Singer, Tishby 1998) above the trained lowest level. EM (Baum et al.
1970) is exact in this model: the E-step is the elimination, the M-step divides expected counts. The result
depends on the start, so the likeliest of many random starts is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ddco_pyro.inference import fused
from ddco_pyro.model.tables import NEVER, Tables, always_ends

STARTS = 16
"""Random starts, halved again and again by likelihood. On planted levels about a third reaches the best."""

FIRST = 10
"""Iterations before the first halving; each further halving comes after twice as many."""

MOST = 200
"""The most iterations of the last start."""

CONVERGED = 1e-6
"""EM stops where an iteration gains fewer nats per step."""

PSEUDO = 0.1
"""Added to every count: no probability becomes 0."""

Piece = tuple[Tables, Tensor]
"""Tables of some demonstrations, and their lengths."""


@dataclass(frozen=True)
class Constants:
    """Probabilities that do not depend on the state, float64.

    :param selection: of the options of each level, lowest first, given the caller, [K_d, k_d].
    :param termination: ψ of the options of each level above the lowest, [k_d].
    """

    selection: tuple[Tensor, ...]
    termination: tuple[Tensor, ...]

    @classmethod
    def drawn(cls, tables: Tables, random: np.random.Generator) -> Constants:
        """Random constants for a hierarchy with such tables."""
        sizes = [table.shape[2:] for table in tables.selection]
        selection = (random.dirichlet(np.ones(choices - 1), size=callers) for callers, choices in sizes)
        termination = (
            np.ones(table.shape[2]) if always_ends(table) else random.uniform(0.05, 0.5, table.shape[2])
            for table in tables.termination[1:]
        )
        return cls(tuple(map(torch.as_tensor, selection)), tuple(map(torch.as_tensor, termination)))

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> Constants | None:
        """The constants of a :meth:`state`; None where it is empty."""
        selection, termination = (
            tuple(state[name] for name in sorted(state) if name.startswith(kind))
            for kind in ("selection", "termination")
        )
        return cls(selection, termination) if state else None

    def state(self) -> dict[str, Tensor]:
        """The constants as tensors by name."""
        parts = {"selection": self.selection, "termination": self.termination}
        numbered = ((kind, *item) for kind, tables in parts.items() for item in enumerate(tables))
        return {f"{kind}.{number:03}": table for kind, number, table in numbered}

    def within(self, tables: Tables) -> Tables:
        """The tables with these probabilities in place of the networks'; no caller emits the control."""
        selection, termination = list(tables.selection), list(tables.termination)
        for level, chosen in enumerate(self.selection):
            selection[level] = pad(chosen.log(), (1, 0), value=NEVER).expand(tables.selection[level].shape)
        for level, ended in enumerate(self.termination, start=1):
            ending = torch.stack([1 - ended, ended], -1).log()
            termination[level] = ending.expand(tables.termination[level].shape)
        return replace(tables, selection=tuple(selection), termination=tuple(termination))


def fitted(pieces: Sequence[Piece], seed: int) -> Constants:
    """The likeliest constants that EM finds from :data:`STARTS` random ones.

    :param pieces: tables of all demonstrations; only the shapes of their selections, and of their
        terminations above the lowest level, are used.
    """
    random = np.random.default_rng(seed)
    left, iterations = [Constants.drawn(pieces[0][0], random) for _ in range(STARTS)], FIRST
    while len(left) > 1:
        ends = sorted((_run(pieces, start, iterations, 0.0) for start in left), key=lambda end: -end[0])
        left, iterations = [constants for _, constants in ends[: len(ends) // 2]], 2 * iterations
    steps = sum(int(lengths.sum()) for _, lengths in pieces)
    return _run(pieces, left[0], MOST, CONVERGED * steps)[1]


def _run(pieces: Sequence[Piece], constants: Constants, most: int, least: float) -> tuple[float, Constants]:
    """Iterate EM while an iteration gains ``least`` nats; the last log-likelihood, and the constants."""
    value = -np.inf
    for _ in range(most):
        before, (value, constants) = value, improved(pieces, constants)
        if value - before < least:
            break
    return value, constants


def improved(pieces: Sequence[Piece], constants: Constants) -> tuple[float, Constants]:
    """An iteration of EM: the log-likelihood of the constants, and the next constants."""
    value = 0.0
    selected = [torch.full_like(table, PSEUDO) for table in constants.selection]
    ends = constants.termination
    ended = [torch.stack([PSEUDO * (psi < 1), torch.full_like(psi, PSEUDO)], -1) for psi in ends]
    for tables, lengths in pieces:
        posterior = fused.posteriors(constants.within(tables), lengths)
        value += float(posterior.value.sum())
        for total, counts in zip(selected, posterior.tables.selection, strict=True):
            total += counts.sum((0, 1))[:, 1:]
        for total, counts in zip(ended, posterior.tables.termination[1:], strict=True):
            total += counts.sum((0, 1))
    selection = tuple(total / total.sum(-1, keepdim=True) for total in selected)
    return value, Constants(selection, tuple(total[:, 1] / total.sum(-1) for total in ended))


def expected(tables: Tables, lengths: Tensor, constants: Constants) -> Tensor:
    """The expected log-probability E[log p(ζ_n)] of each trajectory, nats, [N] in float64.

    An M-step of the networks maximises their sum. The log-probability is that of selections, and of
    terminations above the lowest level. The expectation is over the posterior of ζ_n given the constants.
    """
    counts, tables = fused.posteriors(constants.within(tables), lengths).tables, tables.normalised()
    pairs = [
        *zip(tables.selection, counts.selection, strict=True),
        *zip(tables.termination[1:], counts.termination[1:], strict=True),
    ]
    total = lengths.new_zeros(len(lengths), dtype=torch.float64)
    for table, count in pairs:
        total = total + torch.where(count > 0, table.double() * count, 0.0).flatten(1).sum(1)
    return total
