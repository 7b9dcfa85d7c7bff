"""Monitors: online beliefs over active options, given observations and controls so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Window, fitted, numbers, refuse_large
from ddco_pyro.errors import BadInput
from ddco_pyro.inference.logspace import Filter
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.recogniser import Recogniser, observed
from ddco_pyro.model.tables import complete, joint_density
from ddco_pyro.names import choice_names


class Monitor:
    """An online filter of another agent's options: call :meth:`step` with observations and previous controls.

    >>> monitor = fit.monitor()
    >>> demo = demos[0]
    >>> active = monitor.step({"place": demo.observations["place"][0]})
    >>> for t in range(1, 4):
    ...     active = monitor.step({"place": demo.observations["place"][t]}, demo.actions[t - 1])
    >>> active["option"]["control"], round(sum(active["option"].values()), 6)  # and a number for each option
    (0.0, 1.0)

    :param names: of the choices of each level, lowest first, such as ``fit.names``; by default numbers.
    :ivar belief: the exact belief after :meth:`step`, of each level [1, 1 + k], lowest first.
    :raises BadInput: ``hierarchy`` is something else.
    """

    belief: tuple[Tensor, ...]

    def __init__(
        self, hierarchy: Hierarchy, names: Mapping[str, Sequence[str]] = MappingProxyType({})
    ) -> None:
        self.hierarchy = fitted(hierarchy)
        counts = enumerate(level.count for level in self.hierarchy.option_levels())
        self.names = names or {f"level-{1 + number}": choice_names(count) for number, count in counts}
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        power = float(self.hierarchy.power)
        self._window, self._filter = Window(self.hierarchy.encoder), Filter(power)
        self._alone = self._filter if self.hierarchy.recogniser is None else Filter(power)
        self._seen: list[Tensor] = []
        self._outputs: Outputs | None = None
        self._states: States | None = None

    @property
    def log_likelihood(self) -> float:
        """log p of the controls so far, nats, without the evidence of a recogniser."""
        return float(self._alone.log_likelihood)

    def step(
        self, observation: Mapping[str, np.ndarray], control: np.ndarray | None = None
    ) -> dict[str, dict[str, float]]:
        """The probability of each choice of each level by name, p(h_t | s_0..t, a_0..t-1).

        :param control: a_{t-1} [A], in the control's own units; None at the first step, and only there.
        :raises BadInput: an observation or the control is missing, not finite, or of another shape than in
            training. A refused step changes nothing.
        """
        if self._outputs is None and control is not None:
            raise BadInput("no control comes before the first observation: leave it out")
        scaled = None if self._outputs is None else self._scaled(control)
        with torch.no_grad():
            inputs = self._window.inputs(observation)
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
        levels = zip(self.names.items(), self.belief, strict=True)
        return {level: dict(zip(own, one[0].tolist(), strict=True)) for (level, own), one in levels}

    def _evidence(self, recogniser: Recogniser, inputs: Inputs, before: Tensor | None) -> Tensor:
        """What the past says of each choice, [1, 1, 1 + k].

        :param before: the scaled control before this step, [1, 1, A'].
        """
        if before is None:
            before = inputs.vector.new_zeros(1, 1, len(self.hierarchy.scaling.varying))
        now = torch.cat([observed(inputs), before.double()], dim=-1)[0, 0]
        self._seen = [*self._seen, now][-1 - int(recogniser.past.widths.max()) :]
        ratio = recogniser.past.log_ratio(recogniser.past.latest(self._seen))
        return (recogniser.gamma * ratio).reshape(1, 1, -1)

    def _scaled(self, control: np.ndarray | None) -> Tensor:
        scaling = self.hierarchy.scaling
        if control is None:
            raise BadInput(
                f"the control applied since the last observation is needed, shape ({scaling.size},); got none"
            )
        row = numbers("the control", control, (scaling.size,))[None]
        if scaling.relative_to is not None:
            row = row - self._window.last[scaling.relative_to]
        if problem := scaling.impossible("the control", row):
            raise BadInput(f"{problem}; is it in the demonstrations' units?")
        scaled = scaling.scaled(row)
        refuse_large("the control", scaled)
        return torch.as_tensor(scaled).float().reshape(1, 1, -1)


ONE_STEP = torch.tensor([1])
