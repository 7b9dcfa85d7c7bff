"""A fitted hierarchy as an online policy: the AHMM run forward, one step for each observation (paper §3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from ddco_pyro.acting.window import Window
from ddco_pyro.model.ahmm import Tabulated, choose, complete
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Decision, Outputs
from ddco_pyro.spec import RolloutSpec


class Controller:
    """Acts with a hierarchy: :meth:`reset`, then :meth:`act` with each observation.

    At each step the active options may terminate, new ones are selected, and the lowest of them gives the control.
    After it ``choices`` says which options are active, and ``terminations`` how likely each is to end in a state like
    the one just seen (ψ; 1 for choice 0), lowest level first.

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
        self.terminations: tuple[float, ...] = ()

    @property
    def choices(self) -> tuple[int, ...]:
        """The active choice of each level, lowest first: 1 to k_d, or 0 for control by the caller."""
        return () if self._choices is None else tuple(int(choice) for choice in self._choices)

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises ObservationError: an observation is missing, is not finite, or has an unseen shape.
        """
        generator = np.random.default_rng([self.seed, self.time])
        with torch.no_grad():
            outputs = self.hierarchy(self._window.inputs(observation))
            self._choices = self._choose(outputs, generator)
            scaled = self._control(*self._actor(outputs), generator)
        self.terminations = tuple(
            float(table[0, 0, choice - 1, 1].double().exp()) if choice else 1.0
            for table, choice in zip(outputs.termination, self.choices, strict=True)
        )
        self.time += 1
        return self.hierarchy.scaling.unscaled(scaled)

    def _choose(self, outputs: Outputs, generator: np.random.Generator) -> tuple[Tensor, ...]:
        actions = torch.zeros(1, 1, len(self.hierarchy.scaling.scale))
        tables = outputs.tables(actions, self.hierarchy.scaling.log_volume)
        now = complete(tables, torch.tensor([1])).steps()[0]
        with MostLikely() if self.options == "most_likely" else _Drawn(generator):
            return choose(self.time, now, self._choices)

    def _actor(self, outputs: Outputs) -> tuple[Decision, int]:
        """The lowest level whose choice is an option, and that option; else the meta-policy."""
        for level, choice in enumerate(self.choices):
            if choice > 0:
                return outputs.decisions[level], choice - 1
        return outputs.decisions[-1], 0

    def _control(self, decision: Decision, actor: int, generator: np.random.Generator) -> Tensor:
        assert decision.mean is not None  # a caller that emits no control never selects choice 0
        mean = decision.mean[0, 0, actor].double()
        if self.control == "mean":
            return mean
        return mean + decision.std.double() * torch.from_numpy(generator.standard_normal(len(mean)))


class MostLikely(Messenger):
    """Every choice takes its most likely value instead of a sample."""

    def _pyro_sample(self, message: dict[str, Any]) -> None:
        distribution: Tabulated = message["fn"]
        message["value"] = distribution.logits.argmax(-1)
        message["done"] = True


class _Drawn(Messenger):
    """Every choice is drawn with numpy's random numbers, which an exported controller has too."""

    def __init__(self, generator: np.random.Generator) -> None:
        super().__init__()
        self.generator = generator

    def _pyro_sample(self, message: dict[str, Any]) -> None:
        distribution: Tabulated = message["fn"]
        total = distribution.logits.exp().cumsum(-1)
        message["value"] = (total <= self.generator.random() * total[..., -1:]).sum(-1)
        message["done"] = True
