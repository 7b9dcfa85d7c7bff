"""The fused engine: log-likelihood and posterior in one compiled pass. Its gradient is the posterior (§4.1).

The pass works in scaled probability space. Underflow there matters only where a trajectory's past makes next to
impossible what its future demands. The product of past and future, Σ_h α_t(h) β_t(h), is then not 1. The pass
measures this product at every step, and a trajectory whose product is off is done again in log space.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import kernel, logspace
from ddco_pyro.inference.kernel import Rows, Structure
from ddco_pyro.model.tables import Tables, complete


class Elimination(NamedTuple):
    """Result of one pass; every table of posteriors has the shape of the table that it belongs to.

    :param value: log p(ξ), [N] float64.
    :param tables: posterior probabilities of the tables' entries (evidence left out).
    :param marginals: p(h^d_t = h | ξ) of each level, [N, T, C_d]; empty where they were not asked for.
    """

    value: Tensor
    tables: Tables
    marginals: tuple[Tensor, ...]


class Eliminate(torch.autograd.Function):
    """Log-likelihoods of tables; the gradient with respect to a log-table is the posterior of its entries."""

    @staticmethod
    def forward(ctx: Any, lengths: Tensor, depth: int, *leaves: Tensor | None) -> Tensor:
        """log p(ξ), [N], of tables with these :meth:`~ddco_pyro.model.tables.Tables.leaves`."""
        tables = Tables.of(depth, leaves)
        ctx.evidence = ctx.needs_input_grad[3 + 3 * depth :]
        elimination = eliminate(tables, lengths, any(ctx.evidence), tables.control[0].dtype)
        posteriors = *elimination.tables.leaves(), *elimination.marginals
        ctx.posteriors = len(posteriors)
        ctx.save_for_backward(*posteriors, *leaves)
        return elimination.value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        """The posteriors, weighted with ``upstream`` [N].

        torch's ``once_differentiable`` refuses a second derivative only where ``upstream`` requires a gradient.
        With respect to the tables it would silently be 0, so each gradient passes through :class:`_Refuse`.
        """
        with torch.no_grad():
            posteriors = ctx.saved_tensors[: ctx.posteriors]
            weight = upstream.to(posteriors[0].dtype)
            gradients = [weight.reshape(-1, *(1,) * (table.dim() - 1)) * table for table in posteriors]
        if torch.is_grad_enabled():
            inputs = [part for part in (upstream, *ctx.saved_tensors) if part is not None and part.requires_grad]
            gradients = [_Refuse.apply(gradient, *inputs) for gradient in gradients]
        networks = len(ctx.needs_input_grad) - 2 - len(ctx.evidence)
        marginals = gradients[networks:] or [None] * len(ctx.evidence)
        evidence = (own if needed else None for own, needed in zip(marginals, ctx.evidence, strict=True))
        return None, None, *gradients[:networks], *evidence


class _Refuse(torch.autograd.Function):
    """The identity, without a derivative with respect to ``inputs``."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, *inputs: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Any:
        raise RuntimeError(
            "the fused engine's gradient is the posterior, which it cannot differentiate again: "
            "use engine='enumerate' where second derivatives are needed"
        )


def eliminate(
    tables: Tables, lengths: Tensor, marginals: bool = False, dtype: torch.dtype = torch.float64
) -> Elimination:
    """Log-likelihoods and posteriors, of this ``dtype``, of tables on the CPU with at least one option level."""
    number, steps = len(lengths), tables.steps
    structure = Structure.of(tuple(table.shape[-1] for table in tables.selection))
    densities = side_by_side(tables.control)
    value, shift = torch.empty(2, number, dtype=torch.float64)
    exact = torch.empty(number, dtype=torch.bool)
    kernel.subtract_largest(densities.numpy(), lengths.numpy(), shift.numpy())
    given = side_by_side(tables.selection).exp_(), side_by_side(tables.termination).exp_(), densities.exp_()
    found = [torch.empty_like(table, dtype=dtype) for table in given]
    choices = torch.empty(number, steps, sum(structure.sizes) if marginals else 0, dtype=dtype)
    kernel.match_torch_threads()
    (kernel.one_level if tables.depth == 1 else kernel.any_levels)(
        Rows(*(table.numpy() for table in (*given, joint_evidence(tables).exp_()))),
        lengths.numpy(),
        value.numpy(),
        exact.numpy(),
        Rows(*(table.numpy() for table in (*found, choices))),
        structure,
    )
    groups = zip(found, (tables.selection, tables.termination, tables.control), strict=True)
    elimination = Elimination(
        value.add_(shift),
        Tables(*(_by_level(*group) for group in groups)),
        choices.split(structure.sizes, dim=-1) if marginals else (),
    )
    for n in torch.nonzero(~exact).flatten().tolist():
        _repeat_in_log_space(tables, n, int(lengths[n]), elimination)
    return elimination


def side_by_side(tables: Sequence[Tensor]) -> Tensor:
    """Each level's table, flattened and side by side, a float64 copy [N, T, ...] as in :class:`Rows`."""
    flat = [table.detach().flatten(2) for table in tables]
    rows = flat[0] if len(flat) == 1 else torch.cat(flat, dim=-1)
    return rows.to(torch.float64, copy=True, memory_format=torch.contiguous_format)


def joint_evidence(tables: Tables) -> Tensor:
    """The evidence of every joint choice, a float64 copy [N, T, S]; [N, T, 0] without evidence."""
    joint = tables.joint_evidence()
    if joint is None:
        return torch.empty(*tables.control[-1].shape[:2], 0, dtype=torch.float64)
    return joint.detach().flatten(2).clone(memory_format=torch.contiguous_format)


def _by_level(rows: Tensor, tables: Sequence[Tensor]) -> tuple[Tensor, ...]:
    parts = rows.split([table[0, 0].numel() for table in tables], dim=-1)
    return tuple(part.reshape(table.shape) for part, table in zip(parts, tables, strict=True))


def _repeat_in_log_space(tables: Tables, n: int, length: int, elimination: Elimination) -> None:
    """Eliminate trajectory ``n`` in log space and write the results into ``elimination``."""
    alone = tables.trajectory(n, length)
    leaves = [None if leaf is None else leaf.detach().double().requires_grad_() for leaf in alone.leaves()]
    with torch.enable_grad():
        chain = complete(Tables.of(tables.depth, leaves), torch.tensor([length]))
        value = logspace.log_likelihood(chain)
        present = [leaf for leaf in leaves if leaf is not None]
        assert chain.emission is not None  # log_likelihood has scored it
        *gradients, joint = torch.autograd.grad(value.sum(), [*present, chain.emission], allow_unused=True)
    elimination.value[n] = value.detach()[0]
    for table, gradient in zip(elimination.tables.leaves(), gradients, strict=False):
        assert table is not None
        table[n, :length] = 0.0 if gradient is None else gradient[0]
    for level, marginal in enumerate(elimination.marginals, start=1):
        assert joint is not None
        marginal[n, :length] = logspace.marginal(joint, level)[0]
