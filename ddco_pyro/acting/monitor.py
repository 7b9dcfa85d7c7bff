"""Monitors: online beliefs over active options, given observations and controls so far."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import ObservationError, Window, fitted, numbers, refuse_large
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.inference.logspace import Filter
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.recogniser import Recogniser, observed
from ddco_pyro.model.tables import complete, joint_density
from ddco_pyro.names import choice_names

Lengths = Mapping[str, Sequence[np.ndarray]]
"""How many steps each choice of a level remains active: for each level, an array of lengths for each choice."""


def run_lengths(choices: Iterable[np.ndarray], count: int) -> list[np.ndarray]:
    """The lengths of the runs of each choice 0 to ``count``; a run lasts while the choice is the same.

    >>> run_lengths([np.array([1, 1, 2, 1]), np.array([2, 2])], 2)
    [array([], dtype=int64), array([1, 2]), array([1, 2])]

    :param choices: of each demonstration [T], -1 past its end.
    """
    found: list[list[int]] = [[] for _ in range(1 + count)]
    for row in choices:
        known = row[row >= 0]
        starts = np.flatnonzero(np.diff(known, prepend=-1))
        for start, length in zip(starts, np.diff(starts, append=len(known)), strict=True):
            found[known[start]].append(int(length))
    return [np.sort(np.array(lengths, int)) for lengths in found]


class Progress(NamedTuple):
    """How far an agent is in the active option of a level.

    :param option: the most likely choice; 0 is control.
    :param steps: how many steps, this one included, it has been the most likely choice.
    :param fraction: ``steps`` divided by the expected length of the option's run, given that the run has come so far:
        the mean length of those runs in demonstrations that are not shorter. It is 1 where none of them is longer, and
        None where demonstrations have no run of the option, or none are known.
    :param whole: (k + τ) / K, where the option is number k of K in an order (from 0) and τ is ``fraction``; None
        without an order, without a fraction, or for an option that the order leaves out.
    """

    option: int
    name: str
    steps: int
    fraction: float | None
    whole: float | None


class Monitor:
    """An online filter of another agent's options: call :meth:`step` with each observation and the previous control.

    >>> monitor = fit.monitor()
    >>> demo = demos[0]
    >>> active = monitor.step({"place": demo.observations["place"][0]})
    >>> for t in range(1, 4):
    ...     active = monitor.step({"place": demo.observations["place"][t]}, demo.actions[t - 1])
    >>> active["option"]["control"], round(sum(active["option"].values()), 6)  # and a number for each option
    (0.0, 1.0)

    :param names: the names of the choices of each level, lowest first, such as ``fit.names``; by default numbers.
    :param lengths: how long choices remain active, for :meth:`progress`; ``fit.monitor(demos)`` has those of ``demos``.
    :ivar belief: the exact belief after :meth:`step`, of each level [1, 1 + k], lowest first.
    :raises BadInput: ``hierarchy`` is something else.
    """

    belief: tuple[Tensor, ...]

    def __init__(
        self,
        hierarchy: Hierarchy,
        names: Mapping[str, Sequence[str]] = MappingProxyType({}),
        lengths: Lengths = MappingProxyType({}),
    ) -> None:
        self.hierarchy, self.lengths = fitted(hierarchy), lengths
        counts = enumerate(level.count for level in self.hierarchy.option_levels())
        self.names = names or {f"level-{1 + number}": choice_names(count) for number, count in counts}
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._window, self._filter = Window(self.hierarchy.encoder), Filter(float(self.hierarchy.power))
        self._alone = self._filter if self.hierarchy.recogniser is None else Filter(float(self.hierarchy.power))
        self._seen: list[Tensor] = []
        self._outputs: Outputs | None = None
        self._states: States | None = None
        self._active: dict[str, tuple[int, int]] = {}

    @property
    def log_likelihood(self) -> float:
        """log p of the controls so far, nats, without the evidence of a recogniser."""
        return float(self._alone.log_likelihood)

    def progress(self, order: Mapping[str, Sequence[str]] = MappingProxyType({})) -> dict[str, Progress]:
        """The active option of each level that ``names`` has, and how far its run is, after :meth:`step`.

        >>> monitor = fit.monitor(demos)
        >>> belief = monitor.step({"place": demos[0].observations["place"][0]})
        >>> monitor.progress()["option"].steps
        1

        :param order: for a level, the names of options in the order that they follow each other, for ``whole``.
        :raises BadInput: there is no such level or option.
        """
        for level, ordered in order.items():
            for name, known in ((level, self.names), *((name, self.names.get(level, ())) for name in ordered)):
                if name not in known:
                    raise BadInput(f"order: there is no {name!r}{nearest(name, known)}; there is: {', '.join(known)}")
        found = {}
        for level, (option, steps) in self._active.items():
            name, fraction, whole = self.names[level][option], None, None
            if level in self.lengths and len(lengths := self.lengths[level][option]):
                not_shorter = lengths[lengths >= steps]
                fraction = steps / float(not_shorter.mean()) if len(not_shorter) else 1.0
                if name in (ordered := order.get(level, ())):
                    whole = (ordered.index(name) + fraction) / len(ordered)
            found[level] = Progress(option, name, steps, fraction, whole)
        return found

    def step(
        self, observation: Mapping[str, np.ndarray], control: np.ndarray | None = None
    ) -> dict[str, dict[str, float]]:
        """The probability of each choice of each level by name, p(h_t | s_0..t, a_0..t-1).

        :param control: a_{t-1} [A], in the control's own units; None at the first step, and only there.
        :raises ObservationError: an observation or the control is missing, not finite, or of another shape than in
            training. A refused step changes nothing.
        """
        if self._outputs is None and control is not None:
            raise ObservationError("no control comes before the first observation: leave it out")
        scaled = None if self._outputs is None else self._scaled(control)
        with torch.no_grad():
            inputs = self._window.inputs([observation])
            if self._outputs is not None:
                assert scaled is not None
                for each in {self._filter, self._alone}:
                    each.update(joint_density(self._outputs.tables(scaled).control)[:, 0])
            self._outputs, self._states = self.hierarchy.advance(inputs, self._states)
            tables = self._outputs.tables()
            self.belief = self._alone.predict(complete(tables, ONE_STEP).steps()[0])
            if (recogniser := self.hierarchy.recogniser) is not None:
                tables = tables.with_evidence(recogniser.level, self._evidence(recogniser, inputs, scaled))
                self.belief = self._filter.predict(complete(tables, ONE_STEP).steps()[0])
        probabilities = {}
        for (level, names), choices in zip(self.names.items(), self.belief, strict=True):
            probabilities[level] = dict(zip(names, choices[0].tolist(), strict=True))
            option = int(choices[0].argmax())
            before, steps = self._active.get(level, (option, 0))
            self._active[level] = (option, steps + 1 if option == before else 1)
        return probabilities

    def _evidence(self, recogniser: Recogniser, inputs: Inputs, before: Tensor | None) -> Tensor:
        """What the past says of each choice, [1, 1, 1 + k].

        :param before: the scaled control before this step, [1, 1, A'].
        """
        before = inputs.vector.new_zeros(1, 1, len(self.hierarchy.scaling.varying)) if before is None else before
        now = torch.cat([observed(inputs), before.double()], dim=-1)[0, 0]
        self._seen = [*self._seen, now][-1 - int(recogniser.past.widths.max()) :]
        return (recogniser.gamma * recogniser.past.log_ratio(recogniser.past.latest(self._seen))).reshape(1, 1, -1)

    def _scaled(self, control: np.ndarray | None) -> Tensor:
        scaling = self.hierarchy.scaling
        if control is None:
            raise ObservationError(
                f"the control applied since the last observation is needed, shape ({scaling.size},); got none"
            )
        row = numbers("the control", control, (scaling.size,))[None]
        if scaling.relative_to is not None:
            row = row - self._window.last[0][scaling.relative_to]
        if problem := scaling.impossible("the control", row):
            raise ObservationError(f"{problem}; is it in the demonstrations' units?")
        scaled = scaling.scaled(row)
        refuse_large("the control", scaled)
        return torch.as_tensor(scaled).float().reshape(1, 1, -1)


ONE_STEP = torch.tensor([1])
