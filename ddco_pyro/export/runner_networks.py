"""What evaluates the networks of an exported controller: numpy, a ``torch.export`` program, or ONNX.

An exported ``runner.py`` is :mod:`ddco_pyro.export.runner` with this module in it: here is nothing of this library, and
no import that is not there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Outputs = dict[str, np.ndarray]
"""``selection_d`` log-probabilities [K, 1 + k], ``termination_d`` ψ [k], ``control_d`` the numbers of the control
[K, size] (scaled means, logits of switches and of discrete actions, then y of every σ that depends on the state); d
counts levels from 0, and the last d is the meta-policy."""

State = list[np.ndarray]
"""What networks remember, each array [1, ...]."""

Networks = Callable[[np.ndarray, int, Mapping[str, np.ndarray], State], tuple[Outputs, State]]
"""Features [F], step, images by key and the state to :data:`Outputs` and the next state."""


class NumpyNetworks:
    """Every network of the hierarchy, from ``weights.npz``."""

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        if not about["numpy"]:
            raise ValueError('it has networks that numpy cannot evaluate: use Runner(..., networks="torch") or "onnx"')
        with np.load(folder / "weights.npz", allow_pickle=False) as file:
            self._weights = {name: file[name] for name in file.files}
        self._about = about
        self._after: State = []

    def __call__(
        self, features: np.ndarray, step: int, images: Mapping[str, np.ndarray], state: State
    ) -> tuple[Outputs, State]:
        """The outputs of every network for one observation, and the next state."""
        weights, depth = self._weights, len(self._about["levels"])
        if "places" in weights:
            features = np.clip(features[weights["places"]], weights["low"], weights["high"])
        vector = ((features - weights["mean"]) / weights["deviation"]).astype(np.float32)
        sizes = self._about["features"]
        ends = np.cumsum([0, *sizes.values()])
        self._seen = {key: vector[first:end] for key, first, end in zip(sizes, ends, ends[1:], strict=False)}
        self._images, self._step = images, step
        self._before, self._after = iter(state), []
        outputs: Outputs = {}
        whole = self._evaluate(self._about["trunk"], "trunk") if self._about["trunk"] else None
        for level, caller in enumerate(self._about["callers"]):
            self._features = whole
            if level < depth and self._about["trunks"][level]:
                self._features = self._evaluate(self._about["trunks"][level], f"trunk_{level}")
            out = self._evaluate(caller["network"], f"caller_{level}")
            logits, mean = out[:, : caller["logits"]], out[:, caller["logits"] :]
            if caller["choices"]:
                outputs[f"selection_{level}"] = _selection(logits, caller)
            if mean.shape[1]:
                outputs[f"control_{level}"] = mean
            if level < depth:
                outputs[f"termination_{level}"] = self._termination(level, len(out))
        return outputs, self._after

    def _termination(self, level: int, options: int) -> np.ndarray:
        """ψ [k] of a level, whose options end after every step where no network says when."""
        network, bound = self._about["terminations"][level], np.float32(self._about["termination_bound"])
        if network is None:
            return np.ones(options)
        raw = self._evaluate(network, f"end_{level}")[:, 0]
        psi: np.ndarray = 1 / (1 + np.exp(-(bound * np.tanh(raw / bound)).astype(np.float64)))
        return psi

    def _evaluate(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        """What a part of a network gives for each of K copies, [K, features]; ``name`` begins those of its arrays."""
        values: np.ndarray = getattr(self, f"_{node['kind']}")(node, name)
        return values

    def _vectors(self, node: Mapping[str, Any], _: str) -> np.ndarray:
        vector = np.concatenate([np.zeros(0, np.float32), *(self._seen[key] for key in node["keys"])])
        return np.broadcast_to(vector, (node["copies"], len(vector)))

    def _trunk(self, _: Mapping[str, Any], __: str) -> np.ndarray:
        assert self._features is not None  # what reads a trunk comes after it
        return self._features

    def _joined(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        return np.concatenate([self._evaluate(of, f"{name}.{number}") for number, of in enumerate(node["of"])], axis=1)

    def _shared(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        values = self._evaluate(node["of"], f"{name}.of")
        return np.broadcast_to(values, (node["copies"], values.shape[1]))

    def _perceptrons(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        """K perceptrons, those of this step; an activation follows the hidden layers."""
        values = self._evaluate(node["of"], f"{name}.of")[:, None]
        first = min(self._step, node["steps"] - 1) * node["copies"]
        own = slice(first, first + node["copies"])
        for layer in range(node["layers"]):
            values = values @ self._weights[f"{name}.{layer}.weight"][own] + self._weights[f"{name}.{layer}.bias"][own]
            if layer < node["hidden"]:
                values = ACTIVATIONS[node["activation"]](values)
        return values[:, 0]

    def _lstm(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        """K LSTMs; networks are evaluated in the order in which the state has theirs."""
        values = self._evaluate(node["of"], f"{name}.of")[:, None]
        goes_on = np.float32(not node["horizon"] or self._step % node["horizon"] != 0)
        for layer in range(node["layers"]):
            weight, bias, recurrent = (
                self._weights[f"{name}.{layer}.{part}"] for part in ("inputs.weight", "inputs.bias", "recurrent")
            )
            h, c = (goes_on * next(self._before).transpose(1, 0, 2) for _ in "hc")
            take, keep, new, give = np.split(values @ weight + bias + h @ recurrent, 4, axis=2)
            c = _sigmoid(keep) * c + _sigmoid(take) * np.tanh(new)
            values = _sigmoid(give) * np.tanh(c)
            self._after += [state.transpose(1, 0, 2) for state in (values, c)]
        return values[:, 0]

    def _convolutions(self, node: Mapping[str, Any], name: str) -> np.ndarray:
        """Convolutions of a picture, an activation after each, and what is read of their maps."""
        maps = self._images[node["key"]].astype(np.float32).transpose(2, 0, 1)[None] / 255
        if node["standardize"]:
            maps = (maps - maps.mean()) / np.sqrt(np.maximum(maps.var(), 1 / maps.size))
        for number, layer in enumerate(node["layers"]):
            weight, bias = self._weights[f"{name}.{number}.weight"], self._weights[f"{name}.{number}.bias"]
            maps = _convolved(np.broadcast_to(maps, (node["copies"], *maps.shape[1:])), weight, bias, layer)
            maps = ACTIVATIONS[node["activation"]](maps)
        return POOLS[node["pool"]](maps, node["pooled"]).reshape(node["copies"], -1)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))


def _convolved(maps: np.ndarray, weight: np.ndarray, bias: np.ndarray, layer: Mapping[str, Any]) -> np.ndarray:
    """[K, C, H, W] to [K, filters, H', W']; filters [K · filters, C, size, size]."""
    size, pad, stride = weight.shape[-1], (layer["padding"],) * 2, layer["stride"]
    padded = np.pad(maps, ((0, 0), (0, 0), pad, pad))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(2, 3))[:, :, ::stride, ::stride]
    own = weight.reshape(len(maps), -1, *weight.shape[1:])
    convolved = np.einsum("kchwij,kfcij->kfhw", windows, own, optimize=True)
    return np.asarray(convolved + bias.reshape(len(maps), -1, 1, 1))


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x: np.where(x > 0, x, np.float32(0.01) * x),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "tanh": np.tanh,
}


def _means(maps: np.ndarray, pooled: int) -> np.ndarray:
    """Means over ``pooled`` × ``pooled`` fields, [K, filters, pooled, pooled]."""
    rows, columns = (_fields(length, pooled) for length in maps.shape[2:])
    return np.stack([np.stack([maps[:, :, a:b, c:d].mean((2, 3)) for c, d in columns], -1) for a, b in rows], -2)


def _expected_places(maps: np.ndarray, _: int) -> np.ndarray:
    """The expected (row, column), each from -1 to 1, under the softmax of each map, [K, filters, 2]."""
    weights = np.exp(maps - maps.max((2, 3), keepdims=True))
    weights /= weights.sum((2, 3), keepdims=True)
    rows, columns = (np.linspace(-1, 1, length, dtype=np.float32) for length in maps.shape[2:])
    return np.stack([weights.sum(3) @ rows, weights.sum(2) @ columns], -1)


POOLS: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "mean": _means,
    "flatten": lambda maps, _: maps,
    "spatial_softmax": _expected_places,
}


def _fields(length: int, number: int) -> list[tuple[int, int]]:
    return [(i * length // number, -((i + 1) * length // -number)) for i in range(number)]


def _selection(logits: np.ndarray, caller: Mapping[str, Any]) -> np.ndarray:
    """Log-probabilities of control and of each option; -inf for what this caller does not emit."""
    if not caller["logits"]:
        return np.array([[0.0] + [-np.inf] * caller["choices"]] * len(logits))
    shifted = logits - logits.max(1, keepdims=True)
    log_probabilities = shifted - np.log(np.exp(shifted).sum(1, keepdims=True))
    return log_probabilities if caller["hybrid"] else np.insert(log_probabilities, 0, -np.inf, axis=1)


class TorchNetworks:
    """Every network of the hierarchy, from ``controller.pt2``."""

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        import torch

        self._torch = torch
        self._program = torch.export.load(folder / "controller.pt2").module()
        self._outputs = about["outputs"]

    def __call__(
        self, features: np.ndarray, step: int, images: Mapping[str, np.ndarray], state: State
    ) -> tuple[Outputs, State]:
        """The outputs of every network for one observation, and the next state."""
        given = (features, np.array([step], np.int64), *images.values(), *state)
        threads = self._torch.get_num_threads()
        self._torch.set_num_threads(1)  # networks are small: more threads only wait for one another
        try:
            with self._torch.no_grad():
                values = self._program(*(self._torch.tensor(array) for array in given))
        finally:
            self._torch.set_num_threads(threads)
        return _divided(self._outputs, [tensor.numpy() for tensor in values])


class OnnxNetworks:
    """Every network of the hierarchy, from ``controller.onnx``."""

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(folder / "controller.onnx"), options)
        self._inputs = {argument.name for argument in self._session.get_inputs()}
        self._outputs = about["outputs"]

    def __call__(
        self, features: np.ndarray, step: int, images: Mapping[str, np.ndarray], state: State
    ) -> tuple[Outputs, State]:
        """The outputs of every network for one observation, and the next state."""
        given = {"features": features, "step": np.array([step], np.int64)}
        given |= {f"image_{number}": image for number, image in enumerate(images.values())}
        given |= {f"state_{number}": array for number, array in enumerate(state)}
        values = self._session.run(None, {name: array for name, array in given.items() if name in self._inputs})
        return _divided(self._outputs, values)


def _divided(names: list[str], values: list[np.ndarray]) -> tuple[Outputs, State]:
    """What a program gives: first its outputs, then the next state."""
    return dict(zip(names, values, strict=False)), list(values[len(names) :])


FORMS: dict[str, Callable[[Path, Mapping[str, Any]], Networks]] = {
    "numpy": NumpyNetworks,
    "torch": TorchNetworks,
    "onnx": OnnxNetworks,
}
