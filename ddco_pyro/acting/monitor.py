"""Monitors: online beliefs over active options, given observations and controls so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.window import ObservationError, Window
from ddco_pyro.inference.filtering import Belief, Filter
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import complete

Lengths = Mapping[str, Sequence[np.ndarray]]
"""How many steps each choice of a level remains active: for each level, an array of lengths for each choice."""


def run_lengths(choices: np.ndarray, count: int) -> list[np.ndarray]:
    """The lengths of the runs of each choice 0 to ``count``; a run lasts while the choice is the same.

    >>> run_lengths(np.array([[1, 1, 2, 1], [2, 2, -1, -1]]), 2)
    [array([], dtype=int64), array([1, 2]), array([1, 2])]

    :param choices: [N, T], -1 past a demonstration's end.
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

    >>> monitor = ddco_pyro.Monitor(fit.hierarchy)
    >>> demo = demos[0]
    >>> belief = monitor.step({"place": demo.observations["place"][0]})
    >>> for t in range(1, 4):
    ...     belief = monitor.step({"place": demo.observations["place"][t]}, demo.actions[t - 1])
    >>> belief.choices[0].shape, round(float(belief.choices[0].sum()), 6)  # control and two options
    (torch.Size([1, 3]), 1.0)

    :param names: the names of the choices of each level, lowest first, such as ``fit.names``.
    :param lengths: how long choices remain active, for :meth:`progress`; ``fit.monitor(demos)`` has those of ``demos``.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        names: Mapping[str, Sequence[str]] = MappingProxyType({}),
        lengths: Lengths = MappingProxyType({}),
    ) -> None:
        self.hierarchy, self.names, self.lengths = hierarchy.eval(), names, lengths
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._window, self._filter = Window(self.hierarchy.encoder), Filter()
        self._outputs: Outputs | None = None
        self._states: States | None = None
        self._active: dict[str, tuple[int, int]] = {}

    @property
    def log_likelihood(self) -> float:
        """log p of the controls so far, nats."""
        return float(self._filter.log_likelihood)

    def by_name(self, belief: Belief) -> dict[str, dict[str, float]]:
        """The probability of each choice of each level that ``names`` has, by name."""
        levels = zip(self.names.items(), belief.choices, strict=False)
        return {level: dict(zip(own, each[0].tolist(), strict=True)) for (level, own), each in levels}

    def progress(self, order: Mapping[str, Sequence[str]] = MappingProxyType({})) -> dict[str, Progress]:
        """The active option of each level that ``names`` has, and how far its run is, after :meth:`step`.

        >>> monitor = fit.monitor(demos)
        >>> belief = monitor.step({"place": demos[0].observations["place"][0]})
        >>> monitor.progress()["option"].steps
        1

        :param order: for a level, the names of options in the order that they follow each other, for ``whole``.
        """
        return {level: self._progress(level, order.get(level, ())) for level in self._active}

    def _progress(self, level: str, order: Sequence[str]) -> Progress:
        option, steps = self._active[level]
        name, fraction, whole = self.names[level][option], None, None
        if level in self.lengths and len(lengths := self.lengths[level][option]):
            not_shorter = lengths[lengths >= steps]
            fraction = steps / float(not_shorter.mean()) if len(not_shorter) else 1.0
            if name in order:
                whole = (order.index(name) + fraction) / len(order)
        return Progress(option, name, steps, fraction, whole)

    def step(self, observation: Mapping[str, np.ndarray], control: np.ndarray | None = None) -> Belief:
        """p(h_t, b_t | s_0..t, a_0..t-1) of every level.

        :param control: a_{t-1} [A], in the control's own units; None at the first step, and only there.
        :raises ObservationError: an observation or the control is missing, or of another shape than in training.
        """
        with torch.no_grad():
            inputs = self._window.inputs([observation])
            if self._outputs is not None:
                emission = complete(self._outputs.tables(self._scaled(control)), ONE_STEP).steps()[0].emission
                assert emission is not None  # the control is known
                self._filter.update(emission)
            elif control is not None:
                raise ObservationError("no control comes before the first observation: leave it out")
            self._outputs, self._states = self.hierarchy.advance(inputs, self._states)
            belief = self._filter.predict(complete(self._outputs.tables(), ONE_STEP).steps()[0])
        for level, choices in zip(self.names, belief.choices, strict=False):
            option = int(choices[0].argmax())
            before, steps = self._active.get(level, (option, 0))
            self._active[level] = (option, steps + 1 if option == before else 1)
        return belief

    def _scaled(self, control: np.ndarray | None) -> Tensor:
        size = self.hierarchy.scaling.size
        if control is None or np.shape(control) != (size,):
            got = "none" if control is None else f"one of shape {np.shape(control)}"
            raise ObservationError(
                f"the control applied since the last observation is needed, shape ({size},); got {got}"
            )
        scaled = self.hierarchy.scaling.scaled(np.asarray(control, float)[None])
        return torch.as_tensor(scaled).float().reshape(1, 1, -1)


ONE_STEP = torch.tensor([1])
