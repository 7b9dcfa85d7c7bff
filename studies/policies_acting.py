"""Lets a policy of ``policies.py`` act with numpy alone. A written policy has this file as ``runner.py``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

EULER = 10
"""Steps from noise to a chunk of controls."""

Arrays = Mapping[str, np.ndarray]
"""Weights by their names in torch, and ``seen``, ``done`` [2, ...]: mean and deviation; ``range`` [2, A]."""


def times(t: Any, numbers: Any = np) -> Any:
    """What a flow is told of its time t in [0, 1], [..., 1]: sines and cosines, [..., 8].

    :param numbers: ``numpy`` or ``torch``.
    """
    waves = [wave(np.pi * 2**power * t) for power in range(4) for wave in (numbers.sin, numbers.cos)]
    return numbers.concatenate(waves, -1)


class Acting:
    """A policy: :meth:`reset`, then :meth:`act` with each observation.

    :param about: ``keys`` observed, ``history``, ``kind`` (``perceptron``, ``lstm``, ``flow``), ``chunk``.
    """

    def __init__(self, about: Mapping[str, Any], arrays: Arrays) -> None:
        self.about, self.arrays = about, {name: array.astype(np.float32) for name, array in arrays.items()}
        weights = [name for name in arrays if name.startswith("layers.") and "weight" in name]
        self._layers = [name[: -len(".weight")] for name in weights]
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Begin an episode. Equal seeds and observations give equal controls."""
        self._random, self._seen = np.random.default_rng(seed), list[np.ndarray]()
        self._hidden = self._cell = np.zeros(len(self.arrays.get("lstm.weight_hh_l0", ())) // 4, np.float32)

    def act(self, observation: Mapping[str, Any]) -> np.ndarray:
        """The controls from now on, [chunk · A], inside the range of those that were demonstrated."""
        mean, std = self.arrays["seen"]
        row = np.concatenate([np.ravel(observation[key]) for key in self.about["keys"]]).astype(np.float32)
        row = (row - mean) / std
        self._seen = [*(self._seen or [row] * self.about["history"]), row][-self.about["history"] :]
        forward = getattr(self, f"_{self.about['kind']}")
        chunk = forward(np.concatenate(self._seen)).reshape(self.about["chunk"], -1)
        mean, std = self.arrays["done"]
        return np.clip(chunk * std + mean, *self.arrays["range"]).astype(np.float64).ravel()

    def _perceptron(self, features: np.ndarray) -> np.ndarray:
        for name in self._layers:
            features = self.arrays[f"{name}.weight"] @ features + self.arrays[f"{name}.bias"]
            if name != self._layers[-1]:
                features = np.maximum(features, 0)
        return features

    def _lstm(self, features: np.ndarray) -> np.ndarray:
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        of_input, of_state, bias, other = (self.arrays[f"lstm.{name}_l0"] for name in names)
        gates = of_input @ features + bias + of_state @ self._hidden + other
        let_in, kept, new, let_out = np.split(gates, 4)
        self._cell = _sigmoid(kept) * self._cell + _sigmoid(let_in) * np.tanh(new)
        self._hidden = _sigmoid(let_out) * np.tanh(self._cell)
        return self._perceptron(self._hidden)

    def _flow(self, features: np.ndarray) -> np.ndarray:
        size = self.about["chunk"] * len(self.arrays["range"][0])
        chunk = self._random.normal(size=size).astype(np.float32)
        for t in np.arange(EULER, dtype=np.float32)[:, None] / np.float32(EULER):
            chunk = chunk + self._perceptron(np.concatenate([features, chunk, times(t)])) / EULER
        return chunk


class Runner(Acting):
    """The policy that was written into a folder."""

    def __init__(self, folder: str | Path) -> None:
        with np.load(Path(folder) / "policy.npz") as arrays:
            super().__init__(json.loads((Path(folder) / "policy.json").read_text()), dict(arrays))


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-values)))
