"""The fused engine: one compiled pass from networks' outputs to the log-likelihood and the gradient of every output.

The gradient is the posterior (§4.1), taken through the links of the outputs (:mod:`ddco_pyro.model.links`). Tables that
are given are links of themselves. A policy without options has a level without options, on which only control can be
chosen.

The pass works in scaled probability space. Underflow there matters only where a trajectory's past makes next to
impossible what its future demands. The product of past and future, Σ_h α_t(h) β_t(h), is then not 1. The pass
measures this product at every step, and a trajectory whose product is off is done again in log space.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import accumulate, chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference import kernel, logspace
from ddco_pyro.inference.kernel import Lots, Shape, Sizes, Structure, Tasks
from ddco_pyro.model.elementary import Array
from ddco_pyro.model.links import Link, LinkedTables, links_of
from ddco_pyro.model.passes import NORMAL, Pass, view_of
from ddco_pyro.model.tables import Tables, complete

NOTHING = np.empty(0)


class Part(NamedTuple):
    """A link, and its place in the rows of its group: the ``group``-th field of rows, from column ``first`` on."""

    link: Link
    group: int
    first: int


def _parts(tables: Tables) -> list[Part]:
    *levels, meta_policy = links_of(tables, "control")
    found = []
    groups = links_of(tables, "selection"), links_of(tables, "termination"), (meta_policy, *levels)
    for group, links in enumerate(groups):
        firsts = accumulate((link.columns for link in links), initial=0)
        found += [Part(link, group, first) for link, first in zip(links, firsts, strict=False)]
    return found


def _with_a_level(tables: Tables) -> Tables:
    """The tables; with a level where there is none."""
    if tables.depth:
        return tables
    (acts,) = links_of(tables, "control")
    steps, nothing = acts.shape[:2], torch.zeros((), dtype=torch.float64)
    control, ends, options = nothing.expand(*steps, 1, 1), nothing.expand(*steps, 0, 2), nothing.expand(*steps, 0)
    return LinkedTables((control,), (ends,), (options, acts))


class Elimination(NamedTuple):
    """Result of one pass over N trajectories, padded to T steps. What is past a trajectory is 0.

    :param value: log p(ξ), [N] float64.
    :param gradients: of each trajectory's value by the inputs of the parts, None where they are not wanted. Those of
        inputs that steps share are [N, ...].
    :param posteriors: of the parts' entries, float64 in the tables' shapes; None where they are not wanted.
    :param marginals: posterior marginals of the choices of each level, float64 [N, T, C_d]; empty where not wanted.
    """

    value: Tensor
    gradients: list[Tensor | None]
    posteriors: list[Tensor | None]
    marginals: tuple[Tensor, ...]

    @property
    def tables(self) -> Tables:
        """The posteriors as tables."""
        depth = len(self.posteriors) // 3
        selection, termination = self.posteriors[:depth], self.posteriors[depth : 2 * depth]
        meta_policy, *levels = self.posteriors[2 * depth :]
        return Tables.of(depth, (*selection, *termination, *levels, meta_policy))


class Eliminate(torch.autograd.Function):
    """Log-likelihoods of tables; the gradient with respect to a log-table is the posterior of its entries.

    The inputs are those of the links, then their probes, then the evidence of each level.
    """

    @staticmethod
    def forward(ctx: Any, tables: Tables, lengths: Tensor, parts: list[Part], *inputs: Tensor | None) -> Tensor:
        """log p(ξ), [N]."""
        needed, probed, evidence = ctx.needs_input_grad[3:], len(parts), len(tables.evidence)
        own = len(inputs) - probed - evidence
        marginals = any(needed[own + probed :])
        ctx.again = partial(eliminate, tables, lengths, parts, needed[:own], needed[own : own + probed], marginals)
        found = ctx.found = ctx.again()
        ctx.save_for_backward(*inputs)
        return found.value  # type: ignore[no-any-return]

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        """The gradients of each trajectory, weighted with ``upstream`` [N] in place.

        torch's ``once_differentiable`` refuses a second derivative only where ``upstream`` requires a gradient.
        With respect to the inputs it would silently be 0, so each gradient passes through :class:`_Refuse`.
        """
        found, ctx.found = ctx.found or ctx.again(), None
        inputs, needed = ctx.saved_tensors, ctx.needs_input_grad[3:]
        each = [*found.gradients, *found.posteriors, *(found.marginals or (None,) * len(inputs))]
        with torch.no_grad():
            gradients = [
                None if own is None or not wanted else _weighted(own, upstream, of)
                for own, of, wanted in zip(each, inputs, needed, strict=False)
            ]
        if torch.is_grad_enabled():
            leaves = [part for part in (upstream, *inputs) if part is not None and part.requires_grad]
            gradients = [None if one is None else _Refuse.apply(one, *leaves) for one in gradients]
        return None, None, None, *gradients


def _weighted(each: Tensor, upstream: Tensor, of: Tensor) -> Tensor:
    """The gradient of a tensor from those of the trajectories [N, ...]."""
    if each.dim() > of.dim():
        return torch.tensordot(upstream.to(each.dtype), each, 1).to(of.dtype)
    return each.mul_(upstream.to(each.dtype).reshape(-1, *(1,) * (each.dim() - 1))).to(of.dtype)


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
    """log p(ξ), [N] float64, of tables on the CPU."""
    tables = _with_a_level(tables)
    parts = _parts(tables)
    inputs = chain.from_iterable(part.link.inputs for part in parts)
    probes = (part.link.probe for part in parts)
    value: Tensor = Eliminate.apply(tables, lengths, parts, *inputs, *probes, *tables.evidence)
    return value


def posteriors(tables: Tables, lengths: Tensor, marginals: bool = False) -> Elimination:
    """Log-likelihoods and the posteriors of tables on the CPU, without a gradient.

    :param marginals: whether those of the choices are wanted, too.
    """
    tables = _with_a_level(tables)
    parts = _parts(tables)
    return eliminate(tables, lengths, parts, (), (True,) * len(parts), marginals)


def eliminate(
    tables: Tables, lengths: Tensor, parts: list[Part], needed: Sequence[bool], wanted: Sequence[bool], marginals: bool
) -> Elimination:
    """Log-likelihoods and what else is asked for.

    :param needed: the inputs of the parts that need a gradient; empty for none.
    :param wanted: the parts whose posteriors are wanted.
    :param marginals: whether those of the choices are.
    """
    run, depth, taken = _Run(lengths, tables.steps), tables.depth, 0
    for part, asked in zip(parts, wanted, strict=True):
        run.add(part, needed[taken : taken + len(part.link.inputs)], asked)
        taken += len(part.link.inputs)
    joint, structure = tables.joint_evidence(), Structure.of(tables.sizes)
    joint = None if joint is None else joint.detach().flatten(2)
    states = 0 if joint is None else joint.shape[2]
    choices = run.room(sum(tables.sizes)) if marginals else None
    selection, termination, control = run.widths
    sizes = Sizes(
        selection, termination, control, 0 if depth == 1 else states, run.kept, run.shared, max(run.widest, states),
        run.controls, structure.starts[-1].item(), 0 if choices is None else choices.shape[2],
    )  # fmt: skip
    trajectories, each = kernel.lots_of(run.lengths)
    found = np.empty((run.number, run.shared + 2))
    tasks, constants = np.array(run.tasks, dtype=np.int64), np.concatenate([NOTHING, *run.constants])
    reading = [
        *Lots(trajectories.ctypes.data, each.ctypes.data),
        *Tasks(len(tasks), tasks.ctypes.data, constants.ctypes.data),
        *view_of(joint),
        *view_of(choices),
        found.ctypes.data,
        *Shape.of(tables.sizes),
    ]

    def some(first: int, last: int) -> None:
        _room, planes = kernel.placed(sizes.planes(int(each[first:last, -1].max())))
        numbers = np.append(reading, planes)  # a :class:`kernel.Run`
        kernel.eliminate(first, last, numbers.ctypes.data)

    kernel.on_threads(some, each.sum(1))
    run.take_shared(found)
    value, exact = torch.from_numpy(found[:, -2].copy()), found[:, -1] == 1.0
    split = () if choices is None else choices.split(tables.sizes, dim=-1)
    elimination = Elimination(value, run.gradients, run.posteriors, split)
    for n in np.flatnonzero(~exact).tolist():
        _repeat_in_log_space(tables, n, int(lengths[n]), parts, elimination)
    return elimination


class _Run:
    """The passes of a run as compiled code reads them, and room for what they give."""

    def __init__(self, lengths: Tensor, steps: int) -> None:
        self.lengths, self.number, self.steps = lengths.numpy(), len(lengths), steps
        self.padded = bool(self.lengths.min() < steps)
        self.tasks: list[list[int]] = []
        self.constants: list[Array] = []
        self.kept, self.shared, self.widest, self.controls, self.fixed = 0, 0, 0, 0, 0
        self.gradients: list[Tensor | None] = []
        self.posteriors: list[Tensor | None] = []
        self._read: list[Tensor | None] = []
        self._shared: list[tuple[int, int, Pass, Tensor]] = []
        self.widths = [0, 0, 0]

    def room(self, columns: int) -> Tensor:
        """Room for float64 posteriors [N, T, columns]."""
        return (torch.zeros if self.padded else torch.empty)(self.number, self.steps, columns, dtype=torch.float64)

    def add(self, part: Part, needed: Sequence[bool], wanted: bool) -> None:
        """Add the passes of a link."""
        posterior = self.room(part.link.columns) if wanted else None
        self.posteriors.append(None if posterior is None else posterior.unflatten(2, part.link.shape[2:]))
        self.widths[part.group] += part.link.columns
        for own in part.link.passes():
            self._add(own, part, any(needed[: len(own.tensors)]), posterior)
            needed = needed[len(own.tensors) :]
            posterior = None  # passes of a link have the same columns
        self.widest = max(self.widest, part.link.columns)

    def _add(self, own: Pass, part: Part, asked: bool, posterior: Tensor | None) -> None:
        raw = _readable(own.tensors[0])
        std = _readable(own.tensors[1]) if own.by_step > 1 else None
        controls = None if own.controls is None else _readable(own.controls)
        given = [self._like(tensor) if asked and tensor is not None else None for tensor in (raw, std)[: own.by_step]]
        read = raw, controls, std, given[0], given[-1] if std is not None else None, posterior
        self._read += read  # their memory stays theirs
        numbers = [
            own.kind,
            part.group,
            part.first,
            own.callers,
            own.size,
            own.option,
            self.fixed,
            self.kept,
            self.shared,
        ]
        for tensor in read:
            numbers += view_of(tensor)
        self.tasks.append(numbers)
        self.gradients += given
        many = own.callers * own.size
        for place in range(own.by_step, len(own.tensors)):
            if asked and own.tensors[place].requires_grad:
                self._shared.append((len(self.gradients), self.shared + (place - 1) * many, own, own.tensors[place]))
            self.gradients.append(None)
        if own.kind == NORMAL:
            self.constants.append(own.constants)
            self.fixed += len(own.constants)
        self.kept, self.shared, self.widest = self.kept + own.kept, self.shared + own.shared, max(self.widest, many)
        if controls is not None:
            self.controls = max(self.controls, controls.shape[2])

    def _like(self, tensor: Tensor) -> Tensor:
        """Room for the gradient of a tensor."""
        return torch.zeros_like(tensor) if self.padded else torch.empty_like(tensor)

    def take_shared(self, found: Array) -> None:
        """Take over the gradients of what steps share, [N, n]."""
        for place, first, own, tensor in self._shared:
            each = torch.from_numpy(found[:, first : first + own.callers * own.size])
            each = each.unflatten(1, (own.callers, own.size))
            fitting = each.sum_to_size(len(found), *(1,) * (2 - tensor.dim()), *tensor.shape)
            self.gradients[place] = fitting.reshape(len(found), *tensor.shape)


def _readable(tensor: Tensor) -> Tensor:
    """The tensor without a gradient, float32 or float64."""
    plain = tensor.detach()
    return plain if plain.dtype in (torch.float32, torch.float64) else plain.double()


def _repeat_in_log_space(tables: Tables, n: int, length: int, parts: list[Part], elimination: Elimination) -> None:
    """Eliminate a trajectory in log space and write the results into ``elimination``."""

    def alone(tensor: Tensor) -> Tensor:
        own = tensor[n : n + 1, :length] if tensor.dim() > 2 else tensor
        return own.detach().double().clone().requires_grad_()

    with torch.enable_grad():
        links = [part.link.map(alone) for part in parts]
        found = [link.formula() for link in links]
        depth = tables.depth
        meta_policy, *levels = found[2 * depth :]
        evidence = tuple(None if e is None else e[n : n + 1, :length].detach() for e in tables.evidence)
        alone_tables = Tables((*found[:depth],), (*found[depth : 2 * depth],), (*levels, meta_policy), evidence)
        whole = complete(alone_tables, torch.tensor([length]))
        value = logspace.log_likelihood(whole)
        assert whole.emission is not None  # log_likelihood has scored it
        leaves = [leaf for link in links for leaf in link.inputs]
        *each, joint = torch.autograd.grad(value.sum(), [*leaves, *found, whole.emission], materialize_grads=True)
    elimination.value[n] = value.detach()[0]
    for into, leaf, gradient in zip(elimination.gradients, leaves, each, strict=False):
        if into is not None:
            into[(n, slice(length)) if leaf.dim() > 2 else n] = (gradient[0] if leaf.dim() > 2 else gradient).to(
                into.dtype
            )
    for into, posterior in zip(elimination.posteriors, each[len(leaves) :], strict=True):
        if into is not None:
            into[n, :length] = posterior[0]
    for level, marginal in enumerate(elimination.marginals, 1):
        marginal[n, :length] = logspace.marginal(joint, level)[0]
