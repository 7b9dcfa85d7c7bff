"""Links from networks' outputs to log-probabilities, each by a formula in torch and in compiled passes.

The formula defines a link: evaluation, the Pyro program and log space use it. The fused engine uses the compiled
passes. They give the probabilities for the elimination, and turn its posteriors into gradients of the outputs, so that
training builds no table of logarithms. Compiled arrays have M rows: the steps within their trajectories, one trajectory
after the other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from ddco_pyro.model.elementary import BLOCK, Array, exponentials, jit
from ddco_pyro.model.tables import NEVER, Group, Tables, always_ending

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6), so no path's probability is ever exactly 0."""

Gradients = tuple[Tensor | None, ...]


def bounded(logits: Tensor) -> Tensor:
    """Termination logits within ±``TERMINATION_BOUND``, by a scaled tanh."""
    return TERMINATION_BOUND * torch.tanh(logits / TERMINATION_BOUND)


def log_selection(logits: Tensor, control: int) -> Tensor:
    """Log-softmax over the last dimension, after ``control`` (0 or 1) impossible choices."""
    return pad(logits.log_softmax(-1), (control, 0), value=NEVER)


def log_termination(logits: Tensor) -> Tensor:
    """(log(1 - ψ), log ψ) [..., 2] of logits, which are bounded first."""
    within = bounded(logits)
    return torch.stack([logsigmoid(-within), logsigmoid(within)], dim=-1)


class Alive(NamedTuple):
    """The M steps of a batch within their trajectories, of N·T.

    :param rows: their indices in a table [N·T, ...], int64 [M].
    :param number: N·T.
    """

    rows: Array
    number: int

    @classmethod
    def of(cls, lengths: Tensor, steps: int) -> Alive:
        """The steps of trajectories with these lengths [N] in a batch padded to ``steps``."""
        alive = np.arange(steps) < lengths.numpy()[:, None]
        return cls(np.flatnonzero(alive), alive.size)

    def only(self, some: Array) -> Alive:
        """These of the M steps, int64 [...]."""
        return Alive(self.rows[some], self.number)

    def take(self, table: Tensor) -> Array:
        """The rows of a table [N, T, ...], contiguous float64 [M, ...], so that a pass is compiled for one type."""
        rows = table.detach().reshape(self.number, *table.shape[2:])
        if len(self.rows) < self.number:
            rows = rows[torch.from_numpy(self.rows)]
        return np.ascontiguousarray(rows.numpy(), dtype=np.float64)

    def empty(self, table: Tensor) -> Array:
        """Room for the rows of a table [N, T, ...], float64 [M, ...]."""
        return np.empty((len(self.rows), *table.shape[2:]))

    def put(self, rows: Array, shape: torch.Size, dtype: torch.dtype = torch.float64) -> Tensor:
        """The table of rows [M, ...]; 0 past the trajectories."""
        own = torch.from_numpy(rows).to(dtype)
        if len(self.rows) == self.number:
            return own.reshape(shape)
        table = own.new_zeros(self.number, *own.shape[1:])
        table[torch.from_numpy(self.rows)] = own
        return table.reshape(shape)

    def gradient(self, rows: Array, of: Tensor) -> Tensor:
        """The gradient of a tensor [N, T, ...] from its rows [M, ...]."""
        return self.put(rows, of.shape, of.dtype)


class Posterior(NamedTuple):
    """The posterior of the rows of a group of tables.

    :param rows: as links filled them, [M, n].
    :param found: the posterior of each entry, [M, n].
    :param weight: the gradient of a step's log-likelihood, [M].
    """

    rows: Array
    found: Array
    weight: Array


class Link(ABC):
    """A log-table [N, T, ...] as a function of outputs.

    :ivar inputs: the outputs.
    :ivar shape: of the table.
    :ivar probe: a tensor of zeros in the table's shape that is added to the table. Its gradient is the table's: the
        posterior of each entry.
    """

    inputs: tuple[Tensor, ...]
    shape: torch.Size
    probe: Tensor | None = None

    @abstractmethod
    def formula(self) -> Tensor:
        """The table."""

    @cached_property
    def table(self) -> Tensor:
        """The table, with the probe."""
        return self.formula() if self.probe is None else self.formula() + self.probe

    @property
    def columns(self) -> int:
        """Entries of the table in a step."""
        return self.shape[2:].numel()

    @abstractmethod
    def fill(self, alive: Alive, rows: Array, first: int) -> Any:
        """Fill :attr:`columns` columns of ``rows`` [M, n] from ``first`` on; what :meth:`gradients` needs of it.

        Links of selections and terminations fill in probabilities, those of controls log-densities.
        """

    @abstractmethod
    def gradients(self, alive: Alive, posterior: Posterior, first: int, kept: Any) -> Gradients:
        """The gradient of each input, given the posterior of the rows that :meth:`fill` filled."""


class LogTable(Link):
    """A table that is given.

    :param log: whether rows are filled with logarithms.
    """

    def __init__(self, table: Tensor, log: bool = False) -> None:
        self.inputs, self.shape, self.log = (table,), table.shape, log

    def formula(self) -> Tensor:
        """The table."""
        return self.inputs[0]

    def fill(self, alive: Alive, rows: Array, first: int) -> None:
        """Copy the table, or its exponentials."""
        own = torch.from_numpy(alive.take(self.inputs[0])).flatten(1)
        torch.from_numpy(rows)[:, first : first + self.columns].copy_(own if self.log else own.exp())

    def gradients(self, alive: Alive, posterior: Posterior, first: int, kept: Any) -> Gradients:
        """The posterior itself."""
        gradient = torch.empty(len(posterior.weight), self.columns, dtype=self.inputs[0].dtype).numpy()
        _weigh(posterior.found, posterior.weight, first, gradient)
        return (alive.gradient(gradient, self.inputs[0]),)


@jit
def _weigh(posterior: Array, weight: Array, first: int, gradient: Array) -> None:
    steps, columns = gradient.shape
    own = posterior[:, first : first + columns]
    for m in range(steps):
        for c in range(columns):
            gradient[m, c] = weight[m] * own[m, c]


class Selection(Link):
    """log η of K callers: :func:`log_selection` of logits [N, T, K, C]."""

    def __init__(self, logits: Tensor, control: int) -> None:
        self.inputs, self.control = (logits,), control
        self.shape = torch.Size([*logits.shape[:-1], control + logits.shape[-1]])

    def formula(self) -> Tensor:
        """[N, T, K, control + C]."""
        return log_selection(self.inputs[0], self.control)

    def fill(self, alive: Alive, rows: Array, first: int) -> None:
        """η."""
        softmax(alive.take(self.inputs[0]), rows, first, self.control)

    def gradients(self, alive: Alive, posterior: Posterior, first: int, kept: Any) -> Gradients:
        """Posterior minus η times the posterior of its caller."""
        logits = self.inputs[0]
        gradient = alive.empty(logits)
        softmax_gradient(*posterior, first, self.control, gradient)
        return (alive.gradient(gradient, logits),)


@jit
def softmax(logits: Array, rows: Array, first: int, control: int) -> None:
    """The softmax of logits [M, K, C] to K groups of columns of ``rows`` from ``first`` on, each after ``control`` 0s.

    Blocks of steps lie side by side in memory, so that all but the copies vectorises.
    """
    steps, callers, choices = logits.shape
    block = max(8, BLOCK // choices)
    shares, top, total = np.empty((choices, block)), np.empty(block), np.empty(block)
    for c in range(callers):
        column = first + c * (control + choices)
        for begin in range(0, steps, block):
            own = logits[begin : begin + block, c]
            out = rows[begin : begin + block, column : column + control + choices]
            for i in range(len(own)):
                for j in range(choices):
                    shares[j, i] = own[i, j]
            for i in range(len(own)):
                top[i] = shares[0, i]
                total[i] = 0.0
            for j in range(1, choices):
                for i in range(len(own)):
                    top[i] = shares[j, i] if shares[j, i] > top[i] else top[i]
            for j in range(choices):
                for i in range(len(own)):
                    shares[j, i] -= top[i]
                exponentials(shares[j, : len(own)])
                for i in range(len(own)):
                    total[i] += shares[j, i]
            for i in range(len(own)):
                total[i] = 1.0 / total[i]
            chosen = out[:, control:]
            for i in range(len(own)):
                for j in range(control):
                    out[i, j] = 0.0
                for j in range(choices):
                    chosen[i, j] = shares[j, i] * total[i]


@jit
def softmax_gradient(rows: Array, posterior: Array, weight: Array, first: int, control: int, gradient: Array) -> None:
    """The gradient of logits [M, K, C] whose :func:`softmax` stands in ``rows``."""
    steps, callers, choices = gradient.shape
    for c in range(callers):
        column = first + c * (control + choices) + control
        p, q = rows[:, column : column + choices], posterior[:, column : column + choices]
        for m in range(steps):
            total = 0.0
            for j in range(choices):
                total += q[m, j]
            for j in range(choices):
                gradient[m, c, j] = weight[m] * (q[m, j] - p[m, j] * total)


class Termination(Link):
    """(log(1 - ψ), log ψ): :func:`log_termination` of logits [N, T, k]."""

    def __init__(self, logits: Tensor) -> None:
        self.inputs, self.shape = (logits,), torch.Size([*logits.shape, 2])

    def formula(self) -> Tensor:
        """[N, T, k, 2]."""
        return log_termination(self.inputs[0])

    def fill(self, alive: Alive, rows: Array, first: int) -> Array:
        """1 - ψ and ψ; kept is tanh of the logits over their bound."""
        logits = alive.take(self.inputs[0])
        tanh = np.empty(logits.shape)
        _terminate(logits.reshape(-1), tanh.reshape(-1), rows, first, logits.shape[1])
        return tanh

    def gradients(self, alive: Alive, posterior: Posterior, first: int, kept: Array) -> Gradients:
        """(q_1 (1 - ψ) - q_0 ψ) times the slope of the bound, for posteriors q."""
        logits = self.inputs[0]
        gradient = alive.empty(logits)
        _terminate_gradient(*posterior, first, kept, gradient)
        return (alive.gradient(gradient, logits),)


@jit
def _terminate(logits: Array, tanh: Array, rows: Array, first: int, options: int) -> None:
    block = max(BLOCK // options, 1) * options
    x, ending = np.empty(block), np.empty(block)
    for begin in range(0, len(logits), block):
        own, bound = logits[begin : begin + block], tanh[begin : begin + block]
        for i in range(len(own)):
            v = own[i] * (2.0 / TERMINATION_BOUND)
            x[i] = 700.0 if v > 700.0 else v  # NaN stays
        exponentials(x[: len(own)])
        for i in range(len(own)):
            bound[i] = 1.0 - 2.0 / (1.0 + x[i])
            x[i] = -TERMINATION_BOUND * bound[i]
        exponentials(x[: len(own)])
        for i in range(len(own)):
            ending[i] = 1.0 / (1.0 + x[i])
            x[i] *= ending[i]
        out = rows[begin // options : (begin + block) // options, first : first + 2 * options]
        i = 0
        for m in range(len(out)):
            for j in range(options):
                out[m, 2 * j], out[m, 2 * j + 1] = x[i], ending[i]
                i += 1


@jit
def _terminate_gradient(rows: Array, posterior: Array, weight: Array, first: int, tanh: Array, gradient: Array) -> None:
    steps, options = gradient.shape
    p, q = rows[:, first : first + 2 * options], posterior[:, first : first + 2 * options]
    for m in range(steps):
        for j in range(options):
            change = q[m, 2 * j + 1] * p[m, 2 * j] - q[m, 2 * j] * p[m, 2 * j + 1]
            gradient[m, j] = weight[m] * change * (1.0 - tanh[m, j] * tanh[m, j])


class LinkedTables(Tables):
    """The tables that links stand for; a table is computed when it is first read.

    :param control: links of each level's options and, last, of the meta-policy; empty where no control is known.
    """

    links: dict[Group, tuple[Link, ...]]

    def __init__(
        self,
        selection: Sequence[Link | Tensor],
        termination: Sequence[Link | Tensor],
        control: Sequence[Link | Tensor] = (),
        evidence: tuple[Tensor | None, ...] = (),
    ) -> None:
        links = {"selection": _links(selection), "termination": _links(termination), "control": _links(control, True)}
        self.__dict__.update(links=links, evidence=evidence)  # tables are frozen

    selection = cached_property(lambda self: self._tables("selection"))  # type: ignore[assignment]
    termination = cached_property(lambda self: self._tables("termination"))  # type: ignore[assignment]
    control = cached_property(lambda self: self._tables("control"))  # type: ignore[assignment]

    def with_evidence(self, evidence: tuple[Tensor | None, ...]) -> LinkedTables:
        """The same links with this evidence."""
        return LinkedTables(self.parts("selection"), self.parts("termination"), self.parts("control"), evidence)

    def memoryless(self) -> LinkedTables:
        """The same links with ψ = 1 at every level."""
        ended = [always_ending(part.shape[:-1]) for part in self.parts("termination")]
        return LinkedTables(self.parts("selection"), ended, self.parts("control"), self.evidence)

    def parts(self, group: Group) -> tuple[Any, ...]:
        """The links of a group; its tables once they are computed, as their reader may have changed them."""
        return self.__dict__.get(group, self.links[group])  # type: ignore[no-any-return]

    def probe(self) -> Tables:
        """Give each link a probe; the probes. Their gradients are the posteriors of the tables."""

        def probes(group: Group) -> tuple[Tensor, ...]:
            each = [torch.zeros((), dtype=torch.float64).expand(link.shape) for link in self.links[group]]
            for link, probe in zip(self.links[group], each, strict=True):
                link.probe = probe.requires_grad_()
            return tuple(each)

        return Tables(probes("selection"), probes("termination"), probes("control"))

    def _tables(self, group: Group) -> tuple[Tensor, ...]:
        return tuple(link.table for link in self.links[group])


def links_of(tables: Tables, group: Group) -> tuple[Link, ...]:
    """The links of a group of tables."""
    return _links(tables.parts(group), group == "control")


def _links(parts: Sequence[Link | Tensor], log: bool = False) -> tuple[Link, ...]:
    """A table that is given is a link of itself."""
    return tuple(LogTable(part, log) if isinstance(part, Tensor) else part for part in parts)
