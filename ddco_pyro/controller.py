"""A fitted hierarchy as an online policy: the AHMM run forward, one step for each observation (paper §3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from ddco_pyro.ahmm import Tabulated, choose, complete
from ddco_pyro.hierarchy import Hierarchy
from ddco_pyro.observing import Window
from ddco_pyro.outputs import Decision, Outputs
from ddco_pyro.spec import RolloutSpec


class Controller:
    """Acts with a hierarchy: :meth:`reset`, then :meth:`act` with each observation.

    At each step the active options may terminate, new ones are selected, and the lowest of them gives the control.

    :param control: execute the ``mean`` control or a ``sample``.
    :param options: ``sample`` terminations and selections, or take the ``most_likely``.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        control: Literal["mean", "sample"] = "mean",
        options: Literal["sample", "most_likely"] = "sample",
        seed: int = 0,
    ) -> None:
        self.hierarchy = hierarchy.eval()
        self.control, self.options = control, options
        self.reset(seed)

    @classmethod
    def from_spec(cls, hierarchy: Hierarchy, spec: RolloutSpec, seed: int = 0) -> Controller:
        """The controller that a spec's ``rollout`` asks for."""
        return cls(hierarchy, spec.control, spec.options, seed)

    def reset(self, seed: int = 0) -> None:
        """Begin an episode. Equal seeds and observations give equal controls."""
        self.seed, self.time = seed, 0
        self._window = Window(self.hierarchy.encoder)
        self._choices: tuple[Tensor, ...] | None = None

    @property
    def choices(self) -> tuple[int, ...]:
        """The active choice of each level, lowest first: 1 to k_d, or 0 for control by the caller."""
        return () if self._choices is None else tuple(int(choice) for choice in self._choices)

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises ObservationError: an observation is missing or has an unseen shape.
        """
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(np.random.SeedSequence([self.seed, self.time]).generate_state(1)[0]))
            outputs = self.hierarchy(self._window.inputs(observation))
            self._choices = self._choose(outputs)
            scaled = self._control(*self._actor(outputs))
        self.time += 1
        return self.hierarchy.scaling.unscaled(scaled)

    def _choose(self, outputs: Outputs) -> tuple[Tensor, ...]:
        actions = torch.zeros(1, 1, len(self.hierarchy.scaling.scale))
        tables = outputs.tables(actions, self.hierarchy.scaling.log_volume)
        now = complete(tables, torch.tensor([1])).steps()[0]
        if self.options == "most_likely":
            with MostLikely():
                return choose(self.time, now, self._choices)
        return choose(self.time, now, self._choices)

    def _actor(self, outputs: Outputs) -> tuple[Decision, int]:
        """The lowest level whose choice is an option, and that option; else the meta-policy."""
        for level, choice in enumerate(self.choices):
            if choice > 0:
                return outputs.decisions[level], choice - 1
        return outputs.decisions[-1], 0

    def _control(self, decision: Decision, actor: int) -> Tensor:
        assert decision.mean is not None  # a caller that emits no control never selects choice 0
        mean = decision.mean[0, 0, actor]
        return mean if self.control == "mean" else torch.normal(mean, decision.std)


class MostLikely(Messenger):
    """Every choice takes its most likely value instead of a sample."""

    def _pyro_sample(self, message: dict[str, Any]) -> None:
        distribution: Tabulated = message["fn"]
        message["value"] = distribution.logits.argmax(-1)
        message["done"] = True
