"""The fused engine: log-likelihood and posterior in one compiled pass; the posterior *is* the gradient (§4.1).

It works in scaled probability space. What underflows there matters only where the past of a trajectory makes next to
impossible what its future demands; then the product of past and future, Σ_h α_t(h) β_t(h), is no longer 1. It is
measured at every step, and a trajectory where it is off is done again in log space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddco_pyro.inference import kernel, logspace, one_level
from ddco_pyro.inference.kernel import subtract_largest
from ddco_pyro.inference.once import once
from ddco_pyro.inference.structure import Structure, structure_of
from ddco_pyro.inference.threads import as_many_threads_as_torch
from ddco_pyro.model.tables import Tables, complete


@dataclass(frozen=True)
class Elimination:
    """What one pass finds; every table of posteriors has the shape of the table it belongs to.

    :param value: log p(ξ), [N] float64.
    :param tables: posterior probabilities of the tables' entries (evidence left out).
    :param marginals: p(h^d_t = h | ξ) of each level, [N, T, C_d]; empty where they were not asked for.
    """

    value: Tensor
    tables: Tables
    marginals: tuple[Tensor, ...]


def log_likelihood(tables: Tables, lengths: Tensor) -> Tensor:
    """log p(ξ) of each trajectory, [N], differentiable once in the tables."""
    if not tables.depth:
        emission = complete(tables, lengths).emission
        assert emission is not None  # nothing else can be scored
        return emission.sum(1)
    if tables.control[-1].device.type != "cpu":
        return logspace.log_likelihood(complete(tables, lengths))
    value: Tensor = _Eliminate.apply(lengths, tables.depth, *tables.leaves())
    return value


class _Eliminate(torch.autograd.Function):
    """Log-likelihoods of tables; the gradient with respect to a log-table is the posterior of its entries."""

    @staticmethod
    def forward(ctx: Any, lengths: Tensor, depth: int, *leaves: Tensor | None) -> Tensor:
        tables = Tables.of(depth, leaves)
        ctx.evidence = ctx.needs_input_grad[3 + 3 * depth :]
        elimination = eliminate(tables, lengths, any(ctx.evidence), tables.control[0].dtype)
        posteriors = *elimination.tables.leaves(), *elimination.marginals
        ctx.posteriors = len(posteriors)
        ctx.save_for_backward(*posteriors, *leaves)
        return elimination.value

    @staticmethod
    @once
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        posteriors = ctx.saved_tensors[: ctx.posteriors]
        weight = upstream.to(posteriors[0].dtype)
        gradients = [weight.reshape(-1, *(1,) * (table.dim() - 1)) * table for table in posteriors]
        networks = len(ctx.needs_input_grad) - 2 - len(ctx.evidence)
        marginals = gradients[networks:] or [None] * len(ctx.evidence)
        evidence = (own if needed else None for own, needed in zip(marginals, ctx.evidence, strict=True))
        return None, None, *gradients[:networks], *evidence


def eliminate(
    tables: Tables, lengths: Tensor, marginals: bool = False, dtype: torch.dtype = torch.float64
) -> Elimination:
    """Log-likelihoods and posteriors, of this ``dtype``, of tables on the CPU with at least one option level."""
    densities = _rows(tables.control)
    shift = densities.new_empty(len(lengths))
    subtract_largest(densities.numpy(), lengths.numpy(), shift.numpy())
    rows = _rows(tables.selection).exp_(), _rows(tables.termination).exp_(), densities.exp_()
    value, exact, results, choices = run(structure_of(tables), rows, _weight(tables), lengths, marginals, dtype)
    groups = zip(results, (tables.selection, tables.termination, tables.control), strict=True)
    elimination = Elimination(
        value.add_(shift),
        Tables(*(_unrows(*group) for group in groups)),
        choices.split([table.shape[-1] for table in tables.selection], dim=-1) if marginals else (),
    )
    for n in torch.nonzero(~exact).flatten():
        _again(tables, int(n), int(lengths[n]), elimination)
    return elimination


Rows = tuple[Tensor, Tensor, Tensor]
"""Probabilities of selections and terminations and scaled densities of the controls, float64 [N, T, ...]: the levels'
tables side by side, as :class:`ddco_pyro.inference.structure.Structure` orders them.
"""


def run(
    structure: Structure,
    rows: Rows,
    weight: Tensor,
    lengths: Tensor,
    marginals: bool = False,
    dtype: torch.dtype = torch.float64,
) -> tuple[Tensor, Tensor, Rows, Tensor]:
    """The compiled pass: log-likelihoods [N], whether they are exact [N], posteriors of the rows, choices' marginals.

    :param weight: factors of the joint choices, float64 [N, T, S], or [N, T, 0] where there are none.
    """
    select, end, emission = (torch.empty_like(table, dtype=dtype) for table in rows)
    number, steps = emission.shape[:2]
    choices = torch.empty(number, steps, sum(structure.sizes) if marginals else 0, dtype=dtype)
    value, exact = torch.empty(number, dtype=torch.float64), torch.empty(number, dtype=torch.bool)
    arrays = [table.numpy() for table in (*rows, weight, lengths, value, exact, select, end, emission, choices)]
    with as_many_threads_as_torch():
        if len(structure.sizes) == 1:
            one_level.forward_backward(*arrays)  # type: ignore[call-arg]
        else:
            kernel.forward_backward(  # type: ignore[call-arg]
                *arrays,  # type: ignore[arg-type]
                structure.sizes, structure.starts, structure.selects, structure.ends, structure.actors,
                structure.choices,
            )  # fmt: skip
    return value, exact, (select, end, emission), choices


def _rows(tables: Sequence[Tensor]) -> Tensor:
    """Each level's table, flattened and side by side, a float64 copy [N, T, ...]."""
    flat = [table.detach().flatten(2) for table in tables]
    rows = flat[0] if len(flat) == 1 else torch.cat(flat, dim=-1)
    return rows.to(torch.float64, copy=True, memory_format=torch.contiguous_format)


def _unrows(rows: Tensor, tables: Sequence[Tensor]) -> tuple[Tensor, ...]:
    parts = rows.split([table[0, 0].numel() for table in tables], dim=-1)
    return tuple(part.reshape(table.shape) for part, table in zip(parts, tables, strict=True))


def _weight(tables: Tables) -> Tensor:
    """exp of the evidence of every joint choice, [N, T, S]; [N, T, 0] without evidence."""
    joint = tables.joint_evidence()
    if joint is None:
        return torch.empty(*tables.control[-1].shape[:2], 0, dtype=torch.float64)
    return joint.detach().exp().flatten(2)


def _again(tables: Tables, n: int, length: int, elimination: Elimination) -> None:
    """Do trajectory ``n`` in log space, and write what it gives into ``elimination``."""
    alone = tables.trajectory(n, length)
    leaves = [None if leaf is None else leaf.detach().double().requires_grad_() for leaf in alone.leaves()]
    ends = torch.tensor([length])
    with torch.enable_grad():
        chain = complete(Tables.of(tables.depth, leaves), ends)
        value = logspace.log_likelihood(chain)
        present = [leaf for leaf in leaves if leaf is not None]
        assert chain.emission is not None  # it has just been scored
        gradients = torch.autograd.grad(value.sum(), [*present, chain.emission], allow_unused=True)
    *own, joint = gradients
    elimination.value[n] = value.detach()[0]
    for table, gradient in zip(elimination.tables.leaves(), own, strict=False):
        assert table is not None
        table[n, :length] = 0.0 if gradient is None else gradient[0]
    for level, marginal in enumerate(elimination.marginals, start=1):
        assert joint is not None
        marginal[n, :length] = logspace.marginal(joint, level)[0]
