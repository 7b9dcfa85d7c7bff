"""The fused engine: the log-likelihood of tables by one compiled pass, whose gradient is the posterior
(§4.1).

The pass works in scaled probability space and measures its own error. A trajectory that underflows there is
done again in log space. torch computes the tables from the networks' outputs, and takes the posterior back to
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference import kernel, logspace
from ddco_pyro.inference.kernel import Array, Structure
from ddco_pyro.model.tables import Tables, by_trajectory, complete


class Elimination(NamedTuple):
    """Result of one pass over N trajectories of at most T steps. Posteriors are float64, and 0 past a
    trajectory's end.

    :param value: log p(ξ), [N].
    :param rows: posteriors of tables, and marginals, one after the other, [columns, T, N].
    :param of: the tables.
    """

    value: Tensor
    rows: Tensor
    of: Tables

    @property
    def tables(self) -> Tables:
        """The posterior of each table's entries, in the tables' shapes; without evidence."""
        each, depth = [*_parts(self.rows, _shapes(self.of))], self.of.depth
        control = *each[2 * depth + 1 :], each[2 * depth]
        return Tables((*each[:depth],), (*each[depth : 2 * depth],), control)

    @property
    def marginals(self) -> tuple[Tensor, ...]:
        """Of the choices of each level, [N, T, C_d]; none where they were not wanted."""
        shapes = _shapes(self.of)
        rows = self.rows[sum(map(torch.Size.numel, shapes)) :]
        return (*_parts(rows, [torch.Size([size]) for size in self.of.sizes]),) if len(rows) else ()


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
        found = Elimination(upstream, rows, tables)
        each = *found.tables.leaves(), *(found.marginals or tables.evidence)
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
    structure, lanes, order = Structure.of(tables.sizes), kernel.LANES, lengths.numpy().argsort(kind="stable")
    gains = structure.columns + (sum(tables.sizes) if marginals else 0)
    blocks, steps = -(-len(order) // lanes), tables.steps
    written = torch.from_numpy(kernel.new(gains, steps, blocks * lanes))
    values, sure = torch.empty(blocks * lanes, dtype=torch.float64), np.empty(blocks * lanes, bool)
    consecutive = bool((order[1:] > order[:-1]).all())
    columns = sum(map(len, each := numbers_of(tables)))

    def some(first: int, last: int) -> None:
        its = slice(first * lanes, last * lanes)
        chosen, width, number = its if consecutive else order[its], its.stop - its.start, len(order[its])
        own, rows = np.zeros(width, np.int64), kernel.memory("rows", columns, steps, width)
        own[:number], rows[..., number:] = lengths.numpy()[chosen], 0
        np.concatenate([table[..., chosen] for table in each], out=rows[..., :number])
        kernel.eliminate(
            own, rows.ravel(), written.numpy().ravel()[its.start :], blocks * lanes, values.numpy()[its],
            sure[its], kernel.room_for(steps, columns, structure.entries), tables.power, tables.logits,
            gradient, columns, gains, structure.columns, *structure.tables, structure.groups, structure.inert,
        )  # fmt: skip

    kernel.on_threads(some, blocks, int(lengths.sum()))
    place = slice(len(order)) if consecutive else order.argsort()
    elimination = Elimination(values[place], written[..., place], tables)
    for n in (~sure[place]).nonzero()[0].tolist():
        _repeat_in_log_space(tables, n, int(lengths[n]), elimination, gradient)
    return elimination


def numbers_of(tables: Tables) -> list[Array]:
    """The tables of all levels and, where there is any, the joint evidence, as they are: [columns, T, N]."""
    evidence = tables.joint_evidence()
    each = [*_in_order(tables), *([] if evidence is None else [evidence])]
    numbers = (table.detach().numpy() for table in each)
    return [own.transpose(*range(2, own.ndim), 1, 0).reshape(-1, *own.shape[1::-1]) for own in numbers]


def _in_order(tables: Tables) -> list[Tensor]:
    *levels, meta_policy = tables.control
    return [*tables.selection, *tables.termination, meta_policy, *levels]


def _shapes(tables: Tables) -> list[torch.Size]:
    """What a step has of each table."""
    return [table.shape[2:] for table in _in_order(tables)]


def _parts(rows: Tensor, shapes: Iterable[torch.Size]) -> Iterator[Tensor]:
    """The first rows of [columns, T, N] in these shapes, [N, T, *shape] each."""
    first, numbers = 0, rows.numpy()  # whose views take a tenth of torch's time
    for shape in shapes:
        part = numbers[first : first + shape.numel()]
        yield by_trajectory(torch.from_numpy(part.reshape(*shape, *part.shape[1:])))
        first += shape.numel()


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
