"""Controllers: a fitted hierarchy as an online policy, the AHMM run forward one step for each observation (§3)."""

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
from ddco_pyro.model.tables import Step, complete
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

    At each step active options may terminate, new options are selected, and the lowest option emits the control.
    After a step ``choices`` holds the active options, and ``terminations`` their ψ in the last state (1 for choice 0),
    lowest level first. :meth:`reset_all` and :meth:`act_all` act in several episodes at once, with equal results.

    >>> controller = ddco_pyro.Controller(fit.hierarchy, options="most_likely")  # or fit.controller()
    >>> controller.reset(seed=0)
    >>> controller.act({"place": np.array([0.5, -1.0])}).shape, len(controller.choices)
    ((2,), 1)

    :param hierarchy: such as ``fit.hierarchy``.
    :param control: execute the ``mean`` control or a ``sample``.
    :param options: ``sample`` terminations and selections; take the ``most_likely`` of each; or take the choices with
        the largest ``marginal`` p(h_t | s_0, ..., s_t), which accumulates the probability that options have ended.
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
        for name, given, known in (("control", control, ControlExecution), ("options", options, OptionExecution)):
            if given not in get_args(known):
                raise BadInput(f"{name}={given!r}: has to be one of {', '.join(get_args(known))}")
        self.control, self.options = control, options
        self.reset(seed)

    def reset(self, seed: int = 0) -> None:
        """Begin an episode. Equal seeds and observations give equal controls."""
        self.reset_all([seed])

    def reset_all(self, seeds: Sequence[int]) -> None:
        """Begin N episodes, each with its own seed.

        :raises BadInput: a seed is not a whole number from 0 on.
        """
        for seed in seeds:
            check_whole("seed", seed)
        self.seeds, self.time = list(seeds), 0
        self._window = Window(self.hierarchy.encoder)
        self._choices: tuple[Tensor, ...] | None = None
        self._log_marginal: Tensor | None = None
        self._states: States | None = None
        self.all_terminations = np.zeros((len(seeds), 0))

    @property
    def choices(self) -> tuple[int, ...]:
        """The active choice of each level, lowest first: 1 to k_d, or 0 for control by the caller."""
        return tuple(self.all_choices[0].tolist())

    @property
    def active(self) -> dict[str, str]:
        """The name of the active choice of each level that ``names`` has."""
        levels = zip(self.names.items(), self.choices, strict=False)
        return {level: option_name(choice, own) for (level, own), choice in levels}

    @property
    def terminations(self) -> tuple[float, ...]:
        """ψ of each active choice, lowest level first."""
        return tuple(self.all_terminations[0].tolist())

    @property
    def all_choices(self) -> np.ndarray:
        """The active choices of every episode, [N, D], lowest level first."""
        return _columns(self._choices or (), len(self.seeds)).astype(int)

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises ObservationError: an observation is missing, not finite, or of another shape than in training.
        """
        control: np.ndarray = self.act_all([observation])[0]
        return control

    def act_all(self, observations: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray:
        """The controls [N, A] of all episodes.

        :raises ObservationError: an observation is missing, not finite, or of another shape than in training.
        """
        if len(observations) != len(self.seeds):
            raise BadInput(
                f"there are {len(self.seeds)} episodes and {len(observations)} observations; give one for each"
            )
        generators = [np.random.default_rng([seed, self.time]) for seed in self.seeds]
        with torch.no_grad():
            outputs, self._states = self.hierarchy.advance(self._window.inputs(observations), self._states)
            now = complete(outputs.tables(), torch.ones(len(self.seeds), dtype=torch.int64)).steps()[0]
            self._choices = self._chosen(now, generators)
            steps = (None if emission is None else emission.steps()[0] for emission in outputs.emissions)
            acting = Acting(tuple(steps), self._choices)
            if self.control == "mean":
                control = acting.mode
            else:
                noise = [generator.standard_normal(acting.noise) for generator in generators]
                control = acting.draw(torch.from_numpy(np.stack(noise)))
        rows = torch.arange(len(self.seeds))
        ended = [table[rows, choice, 1].exp() for table, choice in zip(now.termination, self._choices, strict=True)]
        self.all_terminations = _columns(ended, len(self.seeds))
        self.time += 1
        controls, key = self.hierarchy.scaling.emitted(control).numpy(), self.hierarchy.scaling.relative_to
        return controls if key is None else controls + np.stack([seen[key] for seen in self._window.last])

    def _chosen(self, now: Step, generators: Sequence[np.random.Generator]) -> tuple[Tensor, ...]:
        if self.options == "marginal":
            self._log_marginal = arrive(self._log_marginal, now)
            sizes = self._log_marginal.shape[1:]  # C_D, ..., C_1
            if not sizes:
                return ()
            return tuple(reversed(torch.unravel_index(self._log_marginal.flatten(1).argmax(-1), sizes)))
        with Chosen(None if self.options == "most_likely" else generators):
            return choose(self.time, now, self._choices)


def _columns(levels: Sequence[Tensor], number: int) -> np.ndarray:
    """Values [N] of each level as [N, D]."""
    return np.stack([level.numpy() for level in levels], axis=1) if levels else np.zeros((number, 0))


class Chosen(Messenger):
    """Make every sampled choice as exported controllers do.

    :param generators: numpy's, one for each episode; None for the most likely values.
    """

    def __init__(self, generators: Sequence[np.random.Generator] | None) -> None:
        super().__init__()
        self.generators = generators

    def _pyro_sample(self, message: dict[str, Any]) -> None:
        distribution: Tabulated = message["fn"]
        if self.generators is None:
            message["value"] = distribution.logits.argmax(-1)
        else:
            total = distribution.logits.exp().cumsum(-1)
            uniform = torch.tensor([[generator.random()] for generator in self.generators], dtype=total.dtype)
            message["value"] = (total <= uniform * total[..., -1:]).sum(-1)
        message["done"] = True


# --- observations that arrive one at a time ---------------------------------------------------------------------------


class ObservationError(BadInput):
    """An observation that is missing, or of another shape than in the demonstrations."""


class Window:
    """A window over the last observations, for what the encoder makes of several.

    ``time`` counts the observations, of which ``last`` has the latest of each episode.
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        self.encoder, self.time = encoder, 0
        self.last: list[dict[str, np.ndarray]] = []

    def inputs(self, observations: Sequence[Mapping[str, np.ndarray]]) -> Inputs:
        """The networks' inputs for an observation of each of N episodes, T = 1.

        :raises ObservationError: an observation is missing, has another shape than in training, is not finite, or too
            large for networks.
        """
        now = [
            {key: self._checked(observation, key, shape) for key, shape in self.encoder.shapes.items()}
            for observation in observations
        ]
        if not now:
            raise ObservationError("there are no observations; give one for each episode")
        last = [self.last, now] if self.last else [now]  # differences are from the step before
        episodes = zip(*last, strict=True)
        recent = self.encoder.inputs(
            ({key: np.stack([seen[key] for seen in episode]) for key in self.encoder.shapes} for episode in episodes),
            np.full(len(last), self.time),
        )
        latest = recent.part(slice(None), slice(-1, None)).loaded()
        inputs = Inputs(latest.vectors, latest.images, torch.tensor([self.time]))
        for key, vector in latest.vectors.items():
            refuse_large(f"observation {key!r}", vector.numpy())
        self.last, self.time = now, self.time + 1
        return inputs

    def _checked(self, observation: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
        if not isinstance(observation, Mapping):
            given = type(observation).__name__
            raise ObservationError(f"an observation has to be a mapping, such as {{{key!r}: array}}; got {given}")
        if key not in observation:
            known = ", ".join(sorted(map(str, observation)))
            raise ObservationError(f"the observation has no {key!r} (it has: {known})")
        given = observation[key]
        if key == TASK and isinstance(given, str):
            given = one_hot(given, self.encoder.tasks)
        value = numbers(f"observation {key!r}", given, tuple(shape))
        if key in self.encoder.images and value.dtype != np.uint8:
            raise ObservationError(f"observation {key!r} is {value.dtype}, it has to be uint8")
        return value


def numbers(what: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An array of finite real numbers.

    :param what: the name of the value in errors.
    :raises ObservationError: the value is something else, or has another shape.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ObservationError(f"{what} is no array: {' '.join(str(error).split())}") from None
    if array.shape != shape:
        raise ObservationError(f"{what} has shape {array.shape}, the demonstrations had {shape}")
    if array.dtype.kind not in NUMBERS:
        raise ObservationError(f"{what} is {array.dtype}, it has to be numbers")
    if not usable(array).all():
        raise ObservationError(f"{what} is {'too large' if np.isfinite(array).all() else 'not finite'}")
    return array


def refuse_large(what: str, scaled: np.ndarray) -> None:
    """Refuse numbers in scaled units that are too large for networks.

    :raises ObservationError: one of them is.
    """
    largest = np.abs(scaled).max(initial=0.0)
    if largest > LARGEST_SCALED:
        raise ObservationError(
            f"{what} is {number(float(f'{largest:.2g}'))} once it is scaled, and networks take at most "
            f"{LARGEST_SCALED:g}; is it in the demonstrations' units?"
        )
