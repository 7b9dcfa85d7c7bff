"""Controllers: a fitted hierarchy as an online policy, the AHMM run forward a step per observation (§3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from ddco_pyro.data.arrays import NUMBERS, usable
from ddco_pyro.data.demonstration import number
from ddco_pyro.data.tasks import one_hot
from ddco_pyro.errors import BadInput, check_whole
from ddco_pyro.inference.logspace import arrive
from ddco_pyro.model.ahmm import Acting, Tabulated, choose
from ddco_pyro.model.batch import LARGEST_SCALED
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs, States
from ddco_pyro.model.tables import Chain, complete
from ddco_pyro.names import option_name
from ddco_pyro.spec import TASK, OptionExecution

ControlExecution = Literal["mean", "sample"]


def fitted(hierarchy: Hierarchy) -> Hierarchy:
    """The networks of a fit, for acting.

    :raises BadInput: ``hierarchy`` is something else.
    """
    if not isinstance(hierarchy, Hierarchy):
        raise BadInput(f"a {type(hierarchy).__name__} in place of networks: give fit.hierarchy")
    return hierarchy.eval()


class Controller:
    """A policy from a fitted hierarchy: call :meth:`reset`, then :meth:`act` with each observation.

    At each step active options may terminate, new options are selected, and the lowest option emits the
    control. After a step ``choices`` holds the active option of each level, 1 to k_d or 0 for control by the
    caller, and ``terminations`` their ψ in the last state (1 for choice 0), lowest level first.

    >>> controller = ddco_pyro.Controller(fit.hierarchy, options="most_likely")  # or fit.controller()
    >>> controller.reset(seed=0)
    >>> controller.act({"place": np.array([0.5, -1.0])}).shape, len(controller.choices)
    ((2,), 1)

    :param hierarchy: such as ``fit.hierarchy``.
    :param control: execute the ``mean`` control or a ``sample``.
    :param options: ``sample`` terminations and selections; take the ``most_likely`` of each; or the choices
        with the largest ``marginal`` p(h_t | s_0, ..., s_t), which adds up how likely options have ended.
    :param seed: of the first episode.
    :param names: the names of the choices of each level, lowest first, such as ``fit.names``.
    :raises BadInput: one of these is something else.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        control: ControlExecution = "mean",
        options: OptionExecution = "sample",
        seed: int = 0,
        names: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self.hierarchy, self.names = fitted(hierarchy), names
        asked = (("control", control, ControlExecution), ("options", options, OptionExecution))
        for name, given, known in asked:
            if given not in get_args(known):
                raise BadInput(f"{name}={given!r}: has to be one of {', '.join(get_args(known))}")
        self.control, self.options = control, options
        self.reset(seed)

    def reset(self, seed: int = 0) -> None:
        """Begin an episode. Equal seeds and observations give equal controls.

        :raises BadInput: the seed is not a whole number from 0 on.
        """
        check_whole("seed", seed)
        self.seed, self.time = seed, 0
        self.choices: tuple[int, ...] = ()
        self.terminations: tuple[float, ...] = ()
        self._window = Window(self.hierarchy.encoder)
        self._log_marginal: Tensor | None = None
        self._states: States | None = None

    @property
    def active(self) -> dict[str, str]:
        """The name of the active choice of each level that ``names`` has."""
        levels = zip(self.names.items(), self.choices, strict=False)
        return {level: option_name(choice, own) for (level, own), choice in levels}

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises BadInput: an observation is missing, not finite, or of another shape than in training.
        """
        generator = np.random.default_rng([self.seed, self.time])
        with torch.no_grad():
            outputs, self._states = self.hierarchy.advance(self._window.inputs(observation), self._states)
            (now,) = complete(outputs.tables(), torch.tensor([1])).steps()
            chosen = self._chosen(now, generator)
            each = (None if own is None else own.steps()[0] for own in outputs.emissions)
            acting = Acting(tuple(each), chosen)
            if self.control == "mean":
                control = acting.mode
            else:
                control = acting.draw(torch.from_numpy(generator.standard_normal(acting.noise))[None])
        self.choices = tuple(int(choice) for choice in chosen)
        pairs = zip(now.termination, self.choices, strict=True)
        self.terminations = tuple(float(table[0, choice, 1].exp()) for table, choice in pairs)
        self.time += 1
        emitted: np.ndarray = self.hierarchy.scaling.emitted(control).numpy()[0]
        key = self.hierarchy.scaling.relative_to
        return emitted if key is None else emitted + self._window.last[key]

    def _chosen(self, now: Chain, generator: np.random.Generator) -> tuple[Tensor, ...]:
        """The choice of each level, [1], lowest first."""
        if self.options == "marginal":
            self._log_marginal = arrive(self._log_marginal, now)
            sizes = self._log_marginal.shape[1:]  # C_D, ..., C_1
            likeliest = self._log_marginal.flatten(1).argmax(-1) if sizes else None
            return () if likeliest is None else tuple(reversed(torch.unravel_index(likeliest, sizes)))
        before = tuple(torch.tensor([choice]) for choice in self.choices)
        with Chosen(None if self.options == "most_likely" else generator):
            return choose(self.time, now, before or None)


class Chosen(Messenger):
    """Make every sampled choice as exported controllers do.

    :param generator: numpy's; None for the most likely values.
    """

    def __init__(self, generator: np.random.Generator | None) -> None:
        super().__init__()
        self.generator = generator

    def _pyro_sample(self, message: dict[str, Any]) -> None:
        distribution: Tabulated = message["fn"]
        if self.generator is None:
            message["value"] = distribution.logits.argmax(-1)
        else:
            total = distribution.logits.exp().cumsum(-1)
            message["value"] = (total <= self.generator.random() * total[..., -1:]).sum(-1)
        message["done"] = True


# --- observations that arrive one at a time -----------------------------------------------------------------


class Window:
    """The last two observations, for what the encoder makes of both.

    ``time`` counts the observations, of which ``last`` is the latest.
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        self.encoder, self.time = encoder, 0
        self.last: dict[str, np.ndarray] = {}

    def inputs(self, observation: Mapping[str, np.ndarray]) -> Inputs:
        """The networks' inputs for an observation, N = T = 1.

        :raises BadInput: an observation is missing, has another shape than in training, is not finite, or too
            large for networks.
        """
        now = {key: self._checked(observation, key, shape) for key, shape in self.encoder.shapes.items()}
        seen = [self.last, now] if self.time else [now]  # differences are from the step before
        both = {key: np.stack([one[key] for one in seen]) for key in now}
        recent = self.encoder.inputs([both], np.full(len(seen), self.time))
        latest = recent.part(slice(None), slice(-1, None)).loaded()
        inputs = Inputs(latest.vectors, latest.images, torch.tensor([self.time]))
        for key, vector in latest.vectors.items():
            refuse_large(f"observation {key!r}", vector.numpy())
        self.last, self.time = now, self.time + 1
        return inputs

    def _checked(self, observation: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
        if not isinstance(observation, Mapping):
            given = type(observation).__name__
            raise BadInput(f"an observation has to be a mapping, such as {{{key!r}: array}}; got {given}")
        if key not in observation:
            known = ", ".join(sorted(map(str, observation)))
            raise BadInput(f"the observation has no {key!r} (it has: {known})")
        given = observation[key]
        if key == TASK and isinstance(given, str):
            given = one_hot(given, self.encoder.tasks)
        value = numbers(f"observation {key!r}", given, tuple(shape))
        if key in self.encoder.images and value.dtype != np.uint8:
            raise BadInput(f"observation {key!r} is {value.dtype}, it has to be uint8")
        return value


def numbers(what: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An array of finite real numbers.

    :param what: the name of the value in errors.
    :raises BadInput: the value is something else, or has another shape.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise BadInput(f"{what} is no array: {' '.join(str(error).split())}") from None
    if array.shape != shape:
        raise BadInput(f"{what} has shape {array.shape}, the demonstrations had {shape}")
    if array.dtype.kind not in NUMBERS:
        raise BadInput(f"{what} is {array.dtype}, it has to be numbers")
    if not usable(array).all():
        raise BadInput(f"{what} is {'too large' if np.isfinite(array).all() else 'not finite'}")
    return array


def refuse_large(what: str, scaled: np.ndarray) -> None:
    """Refuse numbers in scaled units that are too large for networks.

    :raises BadInput: one of them is.
    """
    largest = np.abs(scaled).max(initial=0.0)
    if largest > LARGEST_SCALED:
        raise BadInput(
            f"{what} is {number(float(f'{largest:.2g}'))} once it is scaled, and networks take at most "
            f"{LARGEST_SCALED:g}; is it in the demonstrations' units?"
        )
