"""Monitors: online beliefs over active options, given observations and controls so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.window import ObservationError, Window
from ddco_pyro.inference.filtering import Belief, Filter
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import complete


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
    """

    def __init__(self, hierarchy: Hierarchy, names: Mapping[str, Sequence[str]] = MappingProxyType({})) -> None:
        self.hierarchy, self.names = hierarchy.eval(), names
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._window, self._filter = Window(self.hierarchy.encoder), Filter()
        self._outputs: Outputs | None = None
        self._states: States | None = None

    @property
    def log_likelihood(self) -> float:
        """log p of the controls so far, nats."""
        return float(self._filter.log_likelihood)

    def by_name(self, belief: Belief) -> dict[str, dict[str, float]]:
        """The probability of each choice of each level that ``names`` has, by name."""
        levels = zip(self.names.items(), belief.choices, strict=False)
        return {level: dict(zip(own, each[0].tolist(), strict=True)) for (level, own), each in levels}

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
            return self._filter.predict(complete(self._outputs.tables(), ONE_STEP).steps()[0])

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
