"""Saliency maps: the gradient of the active option's control with respect to each pixel (Simonyan et al., 2014)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.window import Window
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States


class Look(NamedTuple):
    """A picture as networks see it, uint8 [H, W, C], and the saliency of each pixel, [H, W]."""

    picture: np.ndarray
    saliency: np.ndarray


class Saliency:
    """Saliency maps of one episode: call :meth:`step` with each observation and its active options.

    The saliency of a pixel is the norm of ∂μ/∂x. Here μ are the numbers of the active caller's control, in scaled
    units, and x the pixel's colours in all stacked pictures. The states of recurrent networks count as constant.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        self.hierarchy = hierarchy.eval()
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._window = Window(self.hierarchy.encoder)
        self._states: States | None = None

    def step(self, observation: Mapping[str, np.ndarray], choices: Sequence[int]) -> dict[str, Look]:
        """The saliency map of each observed picture, by key.

        :param choices: the active choice of each level, lowest first; 0 for control by the caller.
        :raises ObservationError: an observation is missing or has an unseen shape.
        """
        seen = self._window.inputs([observation])
        images = {key: image.float().requires_grad_() for key, image in seen.images.items()}
        with torch.enable_grad():
            outputs, states = self.hierarchy.advance(Inputs(seen.vectors, images, seen.time), self._states)
            self._states = {name: tuple(part.detach() for part in state) for name, state in states.items()}
            level = next((number for number, choice in enumerate(choices) if choice), len(choices))
            of_callers = outputs.callers[level].numbers
            assert of_callers is not None  # the active caller emits the control
            caller = choices[level] - 1 if level < len(choices) else 0
            numbers = of_callers[0, 0, caller, : self.hierarchy.scaling.numbers]
            squared = {key: torch.zeros(image.shape[2:4]) for key, image in images.items()}
            for number in numbers:
                slopes = torch.autograd.grad(number, [*images.values()], retain_graph=True, allow_unused=True)
                for key, slope in zip(images, slopes, strict=True):
                    if slope is not None:  # the caller reads this picture
                        squared[key] += slope[0, 0].square().sum(-1)
        return {
            key: Look(self._last(key, seen.images[key][0, 0].numpy()), squared[key].sqrt().numpy()) for key in images
        }

    def _last(self, key: str, pictures: np.ndarray) -> np.ndarray:
        """The newest of the stacked pictures."""
        return pictures[..., -(pictures.shape[-1] // self.hierarchy.encoder.transforms[key].frames) :]


class Looking:
    """A controller whose ``looks`` are the saliency maps of each step of an episode."""

    def __init__(self, controller: Controller) -> None:
        self._controller, self._saliency = controller, Saliency(controller.hierarchy)

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._controller.reset(seed)
        self._saliency.reset()
        self.looks: list[dict[str, Look]] = []

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The controller's control [A]."""
        control = self._controller.act(observation)
        self.looks.append(self._saliency.step(observation, self.choices))
        return control

    @property
    def choices(self) -> tuple[int, ...]:
        """The active choice of each level."""
        return self._controller.choices
