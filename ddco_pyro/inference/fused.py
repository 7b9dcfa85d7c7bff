"""The fused engine: log-likelihood and posterior in one compiled pass. Its gradient is the posterior (§4.1).

The pass works in scaled probability space. Underflow there matters only where a trajectory's past makes next to
impossible what its future demands. The product of past and future, Σ_h α_t(h) β_t(h), is then not 1. The pass
measures this product at every step, and a trajectory whose product is off is done again in log space.

Probabilities come from the links of the networks' outputs, which also turn the posteriors into gradients
(:mod:`ddco_pyro.model.links`). Tables that are given are links of themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference import kernel, logspace
from ddco_pyro.inference.kernel import Array, Rows, Structure
from ddco_pyro.model.links import Alive, Link, Posterior, links_of
from ddco_pyro.model.tables import Tables, complete


class Part(NamedTuple):
    """A link, and its place in the rows of its group: the ``group``-th field of :class:`Rows`, from ``first`` on."""

    link: Link
    group: int
    first: int

    @property
    def columns(self) -> slice:
        """The columns of the link's entries."""
        return slice(self.first, self.first + self.link.columns)


def _parts(tables: Tables) -> list[Part]:
    *levels, meta_policy = links_of(tables, "control")
    found = []
    for group, links in enumerate((links_of(tables, "selection"), links_of(tables, "termination"))):
        found += _side_by_side(links, group)
    return found + _side_by_side((meta_policy, *levels), 2)


def _side_by_side(links: Sequence[Link], group: int) -> list[Part]:
    firsts = accumulate((link.columns for link in links), initial=0)
    return [Part(link, group, first) for link, first in zip(links, firsts, strict=False)]


class Elimination(NamedTuple):
    """Result of one pass; rows hold the M steps of all trajectories.

    :param value: log p(ξ), [N] float64.
    :param rows: the probabilities that the links gave.
    :param posteriors: posterior probabilities of the same entries.
    :param kept: what each link keeps for its gradient.
    :param alive: the steps that the rows hold.
    :param parts: the links, and their places in the rows.
    """

    value: Tensor
    rows: Rows
    posteriors: Rows
    kept: list[Any]
    alive: Alive
    parts: list[Part]

    @property
    def tables(self) -> Tables:
        """The posteriors as tables, float64; 0 past the trajectories."""
        selection, termination, (meta_policy, *levels) = (
            tuple(self._table(part) for part in self.parts if part.group == group) for group in range(3)
        )
        return Tables(selection, termination, (*levels, meta_policy))

    def _table(self, part: Part) -> Tensor:
        return self.alive.put(self.posteriors[part.group][:, part.columns], part.link.shape)


class Eliminate(torch.autograd.Function):
    """Log-likelihoods of tables; the gradient with respect to a log-table is the posterior of its entries.

    The inputs are those of the links, then their probes, then the evidence of each level.
    """

    @staticmethod
    def forward(ctx: Any, tables: Tables, lengths: Tensor, parts: list[Part], *inputs: Tensor | None) -> Tensor:
        """log p(ξ), [N]."""
        ctx.evidence = len(tables.evidence)
        wanted = ctx.evidence > 0 and any(ctx.needs_input_grad[-ctx.evidence :])
        ctx.found, ctx.lengths, ctx.tables = eliminate(tables, lengths, wanted, parts), lengths, tables
        ctx.save_for_backward(*inputs)
        value: Tensor = ctx.found.value
        return value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        """The posteriors, weighted with ``upstream`` [N], through the links.

        torch's ``once_differentiable`` refuses a second derivative only where ``upstream`` requires a gradient.
        With respect to the inputs it would silently be 0, so each gradient passes through :class:`_Refuse`.
        """
        found: Elimination = ctx.found
        inputs, needed = ctx.saved_tensors, ctx.needs_input_grad[3:]
        with torch.no_grad():
            weight = np.repeat(upstream.detach().numpy(), ctx.lengths.numpy())
            gradients = _gradients(found, weight, needed)
            if ctx.evidence:
                gradients += _evidence_gradients(ctx.tables, found, weight)
        if torch.is_grad_enabled():
            leaves = [part for part in (upstream, *inputs) if part is not None and part.requires_grad]
            gradients = [None if one is None else _Refuse.apply(one, *leaves) for one in gradients]
        return None, None, None, *(one if wanted else None for one, wanted in zip(gradients, needed, strict=True))


def _gradients(found: Elimination, weight: Array, needed: Sequence[bool]) -> list[Tensor | None]:
    """The gradients of the links' inputs, where a link has one that is ``needed``, then those of the probes."""
    gradients: list[Tensor | None] = []
    for part, kept in zip(found.parts, found.kept, strict=True):
        wanted = any(needed[len(gradients) : len(gradients) + len(part.link.inputs)])
        posterior = Posterior(found.rows[part.group], found.posteriors[part.group], weight)
        none = (None,) * len(part.link.inputs)
        gradients += part.link.gradients(found.alive, posterior, part.first, kept) if wanted else none
    for part in found.parts:
        if part.link.probe is None:
            gradients.append(None)
        else:
            weighted = found.posteriors[part.group][:, part.columns] * weight[:, None]
            gradients.append(found.alive.put(weighted, part.link.shape))
    return gradients


def _evidence_gradients(tables: Tables, found: Elimination, weight: Array) -> list[Tensor | None]:
    """The marginals of the levels with evidence; None where they were not asked for."""
    if not found.posteriors.choice.shape[1]:
        return [None] * tables.depth
    weighted = np.split(found.posteriors.choice * weight[:, None], np.cumsum(tables.sizes)[:-1], axis=1)
    return [
        None if own is None else found.alive.gradient(part, own)
        for part, own in zip(weighted, tables.evidence, strict=True)
    ]


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


def log_likelihood(tables: Tables, lengths: Tensor) -> Tensor:
    """log p(ξ), [N] float64, of tables on the CPU with at least one option level."""
    parts = _parts(tables)
    inputs = chain.from_iterable(part.link.inputs for part in parts)
    probes = (part.link.probe for part in parts)
    value: Tensor = Eliminate.apply(tables, lengths, parts, *inputs, *probes, *tables.evidence)
    return value


def eliminate(tables: Tables, lengths: Tensor, marginals: bool = False, parts: list[Part] | None = None) -> Elimination:
    """Log-likelihoods and posteriors of tables on the CPU with at least one option level.

    :param marginals: whether the posteriors have those of the choices.
    :param parts: of the tables, if they are known.
    """
    parts = _parts(tables) if parts is None else parts
    alive, structure = Alive.of(lengths, tables.steps), Structure.of(tables.sizes)
    steps = len(alive.rows)
    widths = [max(part.columns.stop for part in parts if part.group == group) for group in range(3)]
    rows = [np.empty((steps, width)) for width in widths]
    kept = [part.link.fill(alive, rows[part.group], part.first) for part in parts]
    choice, one_level = choice_factors(tables, alive), tables.depth == 1
    if one_level and choice.shape[1]:
        rows[2] += choice  # a choice has a column there
        choice = choice[:, :0].copy()
    starts = (lengths.cumsum(0) - lengths).numpy()
    value, shift = torch.empty(2, len(lengths), dtype=torch.float64)
    exact = np.empty(len(lengths), dtype=np.bool_)
    kernel.scale_densities(rows[2], starts, lengths.numpy(), shift.numpy())
    found = [np.empty_like(own) for own in rows]
    choices = np.empty((steps, sum(tables.sizes) if marginals and not one_level else 0))
    given = Rows(rows[0], rows[1], rows[2], np.exp(choice))
    posteriors = Rows(found[0], found[1], found[2], choices)
    run = kernel.one_level if one_level else kernel.any_levels
    others = given, starts, lengths.numpy(), value.numpy(), exact, posteriors, structure
    kernel.on_threads(lambda first, last: run(first, last, *others), lengths.numpy())
    if one_level and marginals:
        posteriors = posteriors._replace(choice=posteriors.control)
    elimination = Elimination(value.add_(shift), given, posteriors, kept, alive, parts)
    if not exact.all():
        _repeat_in_log_space(tables, lengths, starts, np.flatnonzero(~exact).tolist(), elimination)
    return elimination


def choice_factors(tables: Tables, alive: Alive) -> Array:
    """The evidence of every joint choice, [M, S]; [M, 0] without evidence."""
    joint = tables.joint_evidence()
    return np.empty((len(alive.rows), 0)) if joint is None else alive.take(joint.flatten(2))


def _repeat_in_log_space(
    tables: Tables, lengths: Tensor, starts: Array, inexact: list[int], elimination: Elimination
) -> None:
    """Eliminate the ``inexact`` trajectories in log space and write the results into ``elimination``."""
    parts = elimination.parts
    logs: dict[int, Tensor] = {number: part.link.formula().detach().double() for number, part in enumerate(parts)}
    for n in inexact:
        length, own = int(lengths[n]), slice(starts[n], starts[n] + int(lengths[n]))
        leaves = [log[n : n + 1, :length].clone().requires_grad_() for log in logs.values()]
        by_group = [[leaf for leaf, part in zip(leaves, parts, strict=True) if part.group == g] for g in range(3)]
        meta_policy, *levels = by_group[2]
        evidence = tuple(None if e is None else e[n : n + 1, :length].detach() for e in tables.evidence)
        alone = Tables((*by_group[0],), (*by_group[1],), (*levels, meta_policy), evidence)
        with torch.enable_grad():
            whole = complete(alone, lengths[n : n + 1])
            value = logspace.log_likelihood(whole)
            assert whole.emission is not None  # log_likelihood has scored it
            *gradients, joint = torch.autograd.grad(value.sum(), [*leaves, whole.emission], materialize_grads=True)
        elimination.value[n] = value.detach()[0]
        for part, gradient in zip(parts, gradients, strict=True):
            elimination.posteriors[part.group][own, part.columns] = gradient[0].flatten(1)
        if tables.depth > 1 and elimination.posteriors.choice.shape[1]:
            marginals = [logspace.marginal(joint, level)[0] for level in range(1, tables.depth + 1)]
            elimination.posteriors.choice[own] = torch.cat(marginals, -1)
