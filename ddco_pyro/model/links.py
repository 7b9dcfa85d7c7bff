"""Links from networks' outputs to log-probabilities, each by a formula in torch and by compiled passes.

The formula defines a link: evaluation, the Pyro program and log space use it. The fused engine uses the compiled
passes (:mod:`ddco_pyro.model.passes`). They give the probabilities for the elimination, and turn its posteriors into
gradients of the outputs, so that training builds no table of logarithms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from ddco_pyro.model.passes import LOGARITHMS, PROBABILITIES, SOFTMAX, TERMINATION_BOUND, TERMINATIONS, Pass
from ddco_pyro.model.tables import NEVER, Group, Tables, always_ending


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

    @abstractmethod
    def map(self, change: Callable[[Tensor], Tensor]) -> Link:
        """The link of changed inputs, without a probe."""

    @abstractmethod
    def passes(self) -> list[Pass]:
        """The compiled passes, whose tensors are :attr:`inputs`.

        Passes of selections and terminations give probabilities; those of controls add up to log-densities.
        """

    @cached_property
    def table(self) -> Tensor:
        """The table, with the probe."""
        return self.formula() if self.probe is None else self.formula() + self.probe

    @property
    def columns(self) -> int:
        """Entries of the table in a step."""
        return self.shape[2:].numel()


class LogTable(Link):
    """A table that is given.

    :param log: whether its pass gives logarithms.
    """

    def __init__(self, table: Tensor, log: bool = False) -> None:
        self.inputs, self.shape, self.log = (table,), table.shape, log

    def formula(self) -> Tensor:
        """The table."""
        return self.inputs[0]

    def map(self, change: Callable[[Tensor], Tensor]) -> LogTable:
        """The link of a changed table."""
        return LogTable(change(self.inputs[0]), self.log)

    def passes(self) -> list[Pass]:
        """A copy, or exponentials."""
        size = self.shape[3:].numel()
        return [Pass(LOGARITHMS if self.log else PROBABILITIES, self.columns // size, size, self.inputs)]


class Selection(Link):
    """log η of K callers: :func:`log_selection` of logits [N, T, K, C]."""

    def __init__(self, logits: Tensor, control: int) -> None:
        self.inputs, self.control = (logits,), control
        self.shape = torch.Size([*logits.shape[:-1], control + logits.shape[-1]])

    def formula(self) -> Tensor:
        """[N, T, K, control + C]."""
        return log_selection(self.inputs[0], self.control)

    def map(self, change: Callable[[Tensor], Tensor]) -> Selection:
        """The link of changed logits."""
        return Selection(change(self.inputs[0]), self.control)

    def passes(self) -> list[Pass]:
        """A softmax."""
        callers, size = self.inputs[0].shape[2:]
        return [Pass(SOFTMAX, callers, size, self.inputs, self.control)]


class Termination(Link):
    """(log(1 - ψ), log ψ): :func:`log_termination` of logits [N, T, k]."""

    def __init__(self, logits: Tensor) -> None:
        self.inputs, self.shape = (logits,), torch.Size([*logits.shape, 2])

    def formula(self) -> Tensor:
        """[N, T, k, 2]."""
        return log_termination(self.inputs[0])

    def map(self, change: Callable[[Tensor], Tensor]) -> Termination:
        """The link of changed logits."""
        return Termination(change(self.inputs[0]))

    def passes(self) -> list[Pass]:
        """A logistic function of bounded logits; kept is the slope of the bound."""
        return [Pass(TERMINATIONS, self.shape[2], 1, self.inputs, kept=self.shape[2])]


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
