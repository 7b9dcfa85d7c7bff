"""The fused engine: the log-likelihood of tables by one compiled pass, whose gradient is the posterior
(§4.1).

The pass works in scaled probability space and measures its own error. A trajectory that underflows there is
done again in log space. torch computes the tables from the networks' outputs, and takes the posterior back to
them.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddco_pyro.inference import kernel, logspace
from ddco_pyro.inference.kernel import Structure
from ddco_pyro.model.tables import Tables, by_step, by_trajectory, complete


class Elimination(NamedTuple):
    """Result of one pass over N trajectories of at most T steps. Posteriors are float64, and 0 past a
    trajectory's end.

    :param value: log p(ξ), [N].
    :param tables: the posterior of each table's entries, in the tables' shapes; without evidence.
    :param marginals: of the choices of each level, [N, T, C_d]; empty where they are not wanted.
    :param rows: tables and marginals one after the other, [columns, T, N].
    """

    value: Tensor
    tables: Tables
    marginals: tuple[Tensor, ...]
    rows: Tensor


class Eliminate(torch.autograd.Function):
    """Log-likelihoods of tables; the gradient with respect to a log-table is the posterior of its entries."""

    @staticmethod
    def forward(
        ctx: Any, depth: int, power: float, logits: bool, lengths: Tensor, *leaves: Tensor | None
    ) -> Tensor:
        """log p(ξ), [N]."""
        tables = Tables.of(depth, leaves, power, logits)
        found = posteriors(tables, lengths, any(ctx.needs_input_grad[3 * depth + 5 :]), gradient=True)
        ctx.rows, ctx.depth = found.rows, depth
        ctx.save_for_backward(*leaves)
        return found.value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        """The posteriors, weighted with ``upstream`` [N].

        :raises RuntimeError: a graph of the gradient is asked for, to differentiate again: it would silently
            be 0.
        """
        if torch.is_grad_enabled():
            raise RuntimeError(
                "the fused engine's gradient is the posterior, which it cannot differentiate again: "
                "use engine='enumerate' where second derivatives are needed"
            )
        leaves, needed = ctx.saved_tensors, ctx.needs_input_grad[4:]
        tables = Tables.of(ctx.depth, leaves)
        widest = reduce(torch.promote_types, (leaf.dtype for leaf in leaves if leaf is not None))
        rows = ctx.rows.to(widest) * upstream.to(widest)
        parts, marginals = _split(tables, rows, any(needed[3 * ctx.depth + 1 :]))
        each = *parts.leaves(), *(marginals or tables.evidence)
        gradients = (
            part.to(leaf.dtype) if want and part is not None else None
            for part, leaf, want in zip(each, leaves, needed, strict=True)
        )
        return None, None, None, None, *gradients


def posteriors(
    tables: Tables, lengths: Tensor, marginals: bool = False, gradient: bool = False
) -> Elimination:
    """Log-likelihoods and the posteriors of tables on the CPU.

    :param marginals: whether those of the choices are wanted, too.
    :param gradient: whether derivatives of log p(ξ) by the tables' entries take the posteriors' place.
    """
    with torch.no_grad():
        structure, lanes, order = Structure.of(tables.sizes), kernel.LANES, lengths.argsort(stable=True)
        gains = structure.columns + (sum(tables.sizes) if marginals else 0)
        blocks, steps = -(-len(order) // lanes), tables.steps
        written = torch.empty(gains, steps, blocks * lanes, dtype=torch.float64)
        values, sure = written.new_empty(blocks * lanes), written.new_empty(blocks * lanes, dtype=torch.bool)

        def some(first: int, last: int) -> None:
            its = slice(first * lanes, last * lanes)
            chosen, width = order[its], its.stop - its.start
            rows = rows_of(tables.part(chosen, steps), width)
            kernel.eliminate(
                pad(lengths[chosen], (0, width - len(chosen))).numpy(), rows.flatten().numpy(),
                written.flatten()[its.start :].numpy(), blocks * lanes, values[its].numpy(),
                sure[its].numpy(), kernel.room_for(steps, len(rows), structure.entries),
                tables.power, tables.logits, gradient, len(rows), gains, structure.columns,
                *structure.tables, structure.groups, structure.inert,
            )  # fmt: skip

        kernel.on_threads(some, blocks, int(lengths.sum()))
        place = slice(len(order)) if bool((order.diff() == 1).all()) else order.argsort()
        found, value, exact = (each[..., place] for each in (written, values, sure))
        elimination = Elimination(value, *_split(tables, found, marginals), found)
    for n in (~exact).nonzero().flatten().tolist():
        _repeat_in_log_space(tables, n, int(lengths[n]), elimination, gradient)
    return elimination


def rows_of(tables: Tables, width: int, alone: bool = False) -> Tensor:
    """The tables of all levels and the joint evidence as they are, float64 [columns, T, width]; in memory
    that the next call in this thread has.

    :param width: at least N; there are zeros behind.
    :param alone: whether the numbers of each step stand side by side in memory, instead of trajectories.
    """
    evidence = tables.joint_evidence()
    each = [*_in_order(tables), *([] if evidence is None else [evidence])]
    each = [by_step(table.detach()).flatten(0, -3) for table in each]
    columns, (_, steps, number) = sum(map(len, each)), each[0].shape
    shape = (width, steps, columns) if alone else (columns, steps, width)
    rows = torch.from_numpy(kernel.memory("rows", columns * steps * width)).view(shape)
    rows = by_step(rows) if alone else rows
    rows[..., number:] = 0
    for into, table in zip(rows.split([*map(len, each)]), each, strict=True):
        into[..., :number] = table
    return rows


def _in_order(tables: Tables) -> list[Tensor]:
    *levels, meta_policy = tables.control
    return [*tables.selection, *tables.termination, meta_policy, *levels]


def _split(tables: Tables, rows: Tensor, marginals: bool) -> tuple[Tables, tuple[Tensor, ...]]:
    """Rows of posteriors as tables in the shapes of these ones, and the marginals of each level."""
    each = _in_order(tables)
    sizes = [*(table.shape[2:].numel() for table in each), *(tables.sizes if marginals else ())]
    parts = [by_trajectory(part) for part in rows.split(sizes)]
    shaped = [part.unflatten(2, table.shape[2:]) for part, table in zip(parts, each, strict=False)]
    depth = tables.depth
    return (
        Tables(
            (*shaped[:depth],), (*shaped[depth : 2 * depth],), (*shaped[2 * depth + 1 :], shaped[2 * depth])
        ),
        tuple(parts[len(each) :]),
    )


def _repeat_in_log_space(
    tables: Tables, n: int, length: int, elimination: Elimination, gradient: bool
) -> None:
    """Eliminate a trajectory in log space and write the results into ``elimination``."""
    alone = tables.part(torch.tensor([n]), length)
    alone = alone if gradient else alone.normalised()
    leaves = [None if leaf is None else leaf.detach().double().requires_grad_() for leaf in alone.leaves()]
    with torch.enable_grad():
        chain = complete(Tables.of(tables.depth, leaves, tables.power, alone.logits), torch.tensor([length]))
        value = logspace.log_likelihood(chain)
        assert chain.emission is not None  # log_likelihood has scored it
        needed = [leaf for leaf in leaves[: 3 * tables.depth + 1] if leaf is not None]
        *each, joint = torch.autograd.grad(value.sum(), [*needed, chain.emission], materialize_grads=True)
    if not gradient:
        each = [*each[: 2 * tables.depth], *(part / tables.power for part in each[2 * tables.depth :])]
    elimination.value[n] = value.detach()[0]
    for into, posterior in zip(elimination.tables.leaves(), each, strict=True):
        assert into is not None
        into[n, :length] = posterior[0]
    for level, marginal in enumerate(elimination.marginals, 1):
        marginal[n, :length] = logspace.marginal(joint, level)[0]
