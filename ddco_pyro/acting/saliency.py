"""What a policy looks at: how much the control of the active option changes with each pixel (Simonyan et al., 2014)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.window import Window
from ddco_pyro.drawing.heat import overlaid
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.networks.state import States
from ddco_pyro.model.outputs import Outputs


class Look(NamedTuple):
    """A picture [H, W, C] as networks see it, uint8, and how much the control changes with each pixel, [H, W]."""

    picture: np.ndarray
    saliency: np.ndarray


class Slopes(NamedTuple):
    """An input as networks see it, of any shape, and ∂y/∂x of each number y of what they say of it, [A, ...]."""

    seen: Tensor
    slopes: Tensor


class Saliency:
    """Follows an episode: :meth:`step` or :meth:`slopes` with each observation and the options that are active then.

    The saliency of a pixel is the norm of ∂μ/∂x over the numbers μ of the active caller's control, in scaled units, and
    the colours x of the pixel, of all pictures that are seen together; what is remembered of earlier steps is constant.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        self.hierarchy = hierarchy.eval()
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._window = Window(self.hierarchy.encoder)
        self._states: States | None = None

    def step(self, observation: Mapping[str, np.ndarray], choices: Sequence[int]) -> dict[str, Look]:
        """What is looked at, by the key of the pictures.

        :param choices: the active choice of each level, lowest first; 0 for control by the caller.
        :raises ObservationError: an observation is missing or has an unseen shape.
        """
        looks = {}
        for key, (seen, slopes) in self.slopes(observation, lambda outputs: control(outputs, choices)).items():
            if key in self.hierarchy.encoder.images:
                picture = self._last(key, seen.numpy())
                looks[key] = Look(picture, slopes.square().sum((0, -1)).sqrt().numpy())
        return looks

    def slopes(self, observation: Mapping[str, np.ndarray], numbers: Callable[[Outputs], Tensor]) -> dict[str, Slopes]:
        """How some numbers [A] of what the networks say change with what is observed, by the key of the observation.

        :param numbers: takes them from what the networks say of this step, [1, 1, ...].
        :raises ObservationError: as :meth:`step` does.
        """
        seen = self._window.inputs([observation])
        arrays = {**seen.vectors, **seen.images}
        inputs = {key: array.detach().float().requires_grad_() for key, array in arrays.items()}
        vectors, images = ({key: inputs[key] for key in part} for part in (seen.vectors, seen.images))
        with torch.enable_grad():
            outputs, states = self.hierarchy.advance(Inputs(vectors, images, seen.time), self._states)
            self._states = {name: tuple(part.detach() for part in state) for name, state in states.items()}
            each = [
                torch.autograd.grad(
                    number, [*inputs.values()], retain_graph=True, allow_unused=True, materialize_grads=True
                )
                for number in numbers(outputs)
            ]
        slopes = (torch.stack([one[0, 0] for one in of_input]) for of_input in zip(*each, strict=True))
        return {key: Slopes(arrays[key][0, 0], own) for key, own in zip(inputs, slopes, strict=True)}

    def _last(self, key: str, pictures: np.ndarray) -> np.ndarray:
        """The newest of the pictures that are seen together."""
        return pictures[..., -(pictures.shape[-1] // self.hierarchy.encoder.transforms[key].frames) :]


def control(outputs: Outputs, choices: Sequence[int]) -> Tensor:
    """The numbers [A] of the active caller's control, in scaled units, in what networks say of a single step.

    :param choices: the active choice of each level, lowest first; 0 for control by the caller.
    """
    level = next((number for number, choice in enumerate(choices) if choice), len(choices))
    emission = outputs.emissions[level]
    assert emission is not None  # whoever is active emits the control
    return emission.numbers[0, 0, choices[level] - 1 if level < len(choices) else 0]


class Looking:
    """A controller that acts as it does, and whose ``frames`` show what it looks at, uint8 [H, W, 3] at each step."""

    def __init__(self, controller: Controller) -> None:
        self._controller, self._saliency = controller, Saliency(controller.hierarchy)

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._controller.reset(seed)
        self._saliency.reset()
        self.frames: list[np.ndarray] = []

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The controller's control [A]."""
        control = self._controller.act(observation)
        looks = self._saliency.step(observation, self.choices)
        self.frames.append(np.hstack([overlaid(*look) for look in looks.values()]))
        return control

    @property
    def choices(self) -> tuple[int, ...]:
        """The active choice of each level."""
        return self._controller.choices
