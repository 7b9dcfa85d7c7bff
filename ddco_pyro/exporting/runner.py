"""Run an exported controller with numpy alone. An export holds this file.

    from runner import Runner

    controller = Runner(".")
    controller.reset(seed=0)
    control = controller.act({"state": state})    # [A], in the control's own units
    controller.choices, controller.terminations   # active options, lowest level first, and their ψ
    controller.active                             # their names, by level

``python runner.py [FOLDER] [numpy|onnx]`` replays the episodes in ``check.npz`` and prints the largest
difference from the original. A user's networks may need ``Runner(".", networks="onnx")`` and onnxruntime.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.model.emissions import CONTROLS

TOLERANCE = 1e-6
"""Difference from the original that is always allowed. The unit of a control is the largest of 1, its spread,
and its distance from its centre. ``check.npz`` holds this controller's tolerance, which grows with its
rounding error."""


ARRAY = "weights.npz"
"""The key, alone in its mapping, under which ``controller.json`` names an array."""

Outputs = dict[str, np.ndarray]
"""``selection_d`` log-probabilities [K, 1 + k], ``termination_d`` ψ [k], ``control_d`` the numbers of the
control [K, size] (scaled means, logits of switches and of discrete actions, then y of every σ that depends on
the state); d counts levels from 0, and the last d is the meta-policy."""

State = list[np.ndarray]
"""The states of recurrent networks, each [1, ...]."""

Networks = Callable[[np.ndarray, int, Mapping[str, np.ndarray], State], tuple[Outputs, State]]
"""Features [F], step, images by key and the state to :data:`Outputs` and the next state."""


class Runner:
    """An exported controller: :meth:`reset`, then :meth:`act` with each observation.

    :param networks: ``numpy`` or ``onnx``, to evaluate the networks.
    """

    def __init__(self, folder: str | Path, networks: str = "numpy") -> None:
        folder = Path(folder)
        self.about = _read(folder)
        if networks not in FORMS:
            raise ValueError(f"networks={networks!r}: it has to be one of {', '.join(FORMS)}")
        self._networks = FORMS[networks](folder, self.about)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Begin an episode. Equal seeds and observations give equal controls."""
        self.seed, self.time = seed, 0
        self.choices: tuple[int, ...] = ()
        self.terminations: tuple[float, ...] = ()
        self.outputs: Outputs = {}
        self._last: dict[str, np.ndarray] | None = None
        self._marginal: np.ndarray | None = None
        state = self.about["state"]
        self._state = [np.array(one["values"], one["kind"]).reshape(one["shape"]) for one in state]

    @property
    def active(self) -> dict[str, str]:
        """The name of the active choice of each level."""
        levels = zip(self.about["names"].items(), self.choices, strict=False)
        return {level: names[choice] for (level, names), choice in levels}

    def act(self, observation: Mapping[str, Any]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises ValueError: an observation is missing, has an unseen shape or is not finite.
        """
        built_in = self.about["step"]
        if built_in:
            observation = {**observation, built_in["key"]: np.array([self.time / built_in["longest"]])}
        specs = self.about["observations"]
        read = (spec | {"key": key} for spec in specs for key in (spec["minus"], spec["key"]) if key)
        now = {spec["key"]: _checked(observation, spec) for spec in read}
        images = {spec["key"]: _picture(now[spec["key"]], spec) for spec in specs if spec["image"]}
        features = self._features(now, self._last or now)
        self.outputs, self._state = self._networks(features, self.time, images, self._state)
        generator = np.random.default_rng([self.seed, self.time])
        choose = self._largest_marginal if self.about["options"] == "marginal" else self._choose
        self.choices = choose(self.outputs, generator)
        self.terminations = self._psi(self.outputs)
        self._last, self.time = now, self.time + 1
        control, key = self._control(self.outputs, generator), self.about["relative_to"]
        return control if key is None else control + now[key]

    def _psi(self, outputs: Outputs) -> tuple[float, ...]:
        """ψ of each active choice, lowest level first; 1 for control."""
        active = enumerate(self.choices)
        return tuple(float(outputs[f"termination_{d}"][h - 1]) if h else 1.0 for d, h in active)

    def _features(self, now: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]) -> np.ndarray:
        parts = [np.zeros(0)]
        for spec in self.about["observations"]:
            if not spec["image"]:
                value = _turned(now, spec)
                parts.append(value)
                if spec["differences"]:
                    parts.append(value - _turned(before, spec))
        return np.concatenate(parts)

    def _choose(self, outputs: Outputs, generator: np.random.Generator) -> tuple[int, ...]:
        """Terminations go bottom-up, selections top-down; at the first step everything is selected."""
        depth, terminated = len(self.about["levels"]), [True]
        for psi in self._psi(outputs):
            ends = self._pick(np.array([1 - psi, psi] if terminated[-1] else [1.0, 0.0]), generator)
            terminated.append(bool(ends))
        choices, caller = [0] * depth, 0
        for level in reversed(range(depth)):
            table = outputs[f"selection_{level + 1}"]
            if level < depth - 1 and caller == 0:
                probabilities = np.eye(table.shape[-1])[0]  # below control there is nothing left to choose
            else:
                probabilities = np.exp(table[caller - 1 if level < depth - 1 else 0].astype(np.float64))
            if self.choices and not terminated[level + 1]:
                probabilities = np.eye(len(probabilities))[self.choices[level]]
            caller = choices[level] = self._pick(probabilities, generator)
        return tuple(choices)

    def _largest_marginal(self, outputs: Outputs, _: np.random.Generator) -> tuple[int, ...]:
        """The choices of largest p(h_t | s_0, ..., s_t); ``_marginal`` has that of all, [C_D, ..., C_1]."""
        depth, kept = len(self.about["levels"]), []
        ended = np.ones(()) if self._marginal is None else self._marginal
        for level in range(depth if self._marginal is not None else 0):
            psi = np.append(1.0, outputs[f"termination_{level}"])  # control lasts a step
            kept.append(ended * (1 - psi))
            ended = (ended * psi).sum(-1)
        for level in reversed(range(depth)):
            selection = np.exp(outputs[f"selection_{level + 1}"].astype(np.float64))
            if level < depth - 1:  # below control there is nothing left to choose
                selection = np.vstack([np.eye(selection.shape[1])[0], selection])
            ended = ended[..., None] * (selection if level < depth - 1 else selection[0])
            ended = ended + (kept[level] if kept else 0.0)
        self._marginal = ended
        return tuple(int(place) for place in reversed(np.unravel_index(ended.argmax(), ended.shape)))

    def _pick(self, probabilities: np.ndarray, generator: np.random.Generator) -> int:
        if self.about["options"] == "most_likely":
            return int(probabilities.argmax())
        total = np.cumsum(probabilities)
        return int((total <= generator.random() * total[-1]).sum())

    def _control(self, outputs: Outputs, generator: np.random.Generator) -> np.ndarray:
        """The likeliest control, or a sample, of the lowest level with an option, else of the meta-policy."""
        level, actor = next(((d, h - 1) for d, h in enumerate(self.choices) if h > 0), (len(self.choices), 0))
        numbers, first = outputs[f"control_{level}"][actor].astype(np.float64), 0
        count = sum(len(part["places"]) for part in self.about["parts"])
        noise = generator.standard_normal(count) if self.about["control"] == "sample" else None
        control = np.array(self.about["constant"])  # dimensions that never varied stay so
        for part in self.about["parts"]:
            own, z = numbers[first : first + part["size"]], None if noise is None else noise[part["places"]]
            control[part["dims"]] = CONTROLS[part["kind"]](part, own, _std(part, level, actor, numbers), z)
            first += part["size"]
        return control


Part = Mapping[str, Any]


def _std(part: Part, level: int, actor: int, numbers: np.ndarray) -> np.ndarray:
    """σ of a part's dimensions for a caller, in scaled units; empty where it has none."""
    each = np.array(part["std"][level]) if part["std"] else np.zeros(0)
    std = each[actor] if each.ndim == 2 else each
    for place, number, floor, start in part["per_state"]:
        std[place] = floor + np.logaddexp(0, numbers[number] + start)
    return std


# kinds of control


def _turned(seen: Mapping[str, np.ndarray], spec: Mapping[str, Any]) -> np.ndarray:
    """The numbers of an observation, less another one where the spec says so, as networks read them.

    Sines and cosines of angles, and products of quaternions, are behind the rest.
    """
    value = seen[spec["key"]].astype(np.float64).ravel()
    angles, quaternions = spec["angles"], spec["quaternions"]
    if spec["minus"]:
        value = value - seen[spec["minus"]].astype(np.float64).ravel()
    four = [value[first : first + 4] for first in quaternions]
    products = [np.outer(q, q)[np.triu_indices(4)] for q in four]
    rest = np.delete(value, [*angles, *(first + place for first in quaternions for place in range(4))])
    return np.concatenate([rest, np.sin(value[angles]), np.cos(value[angles]), *products])


def _picture(picture: np.ndarray, spec: Mapping[str, Any]) -> np.ndarray:
    """A picture [H, W, C] after the cropping and scaling that its ``spec`` asks for."""
    if "crop" in spec:
        top, left, height, width = spec["crop"]
        picture = picture[top : top + height, left : left + width]
    if "resize" in spec and picture.shape[:2] != tuple(spec["resize"]):
        picture = _resized(picture, *spec["resize"])
    return picture


def _resized(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scaled by the mean over areas, with opencv-python-headless."""
    import cv2

    scaled = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(scaled, np.uint8).reshape(height, width, -1)


def _checked(observation: Mapping[str, Any], spec: Mapping[str, Any]) -> np.ndarray:
    key, shape = spec["key"], tuple(spec["shape"])
    if key not in observation:
        raise ValueError(f"the observation has no {key!r} (it has: {', '.join(sorted(observation))})")
    data = np.asarray(observation[key])
    if data.shape != shape:
        raise ValueError(f"observation {key!r} has shape {data.shape}, the demonstrations had {shape}")
    if data.dtype.kind not in "fiub" or (spec["image"] and data.dtype != np.uint8):
        wanted = "uint8" if spec["image"] else "numbers"
        raise ValueError(f"observation {key!r} is {data.dtype}, it has to be {wanted}")
    if not np.isfinite(data).all():
        raise ValueError(f"observation {key!r} is not finite")
    return data


def _read(folder: Path) -> dict[str, Any]:
    """What ``controller.json`` says, with the arrays that it names."""
    weights = read_arrays(folder / ARRAY) if (folder / ARRAY).exists() else {}

    def placed(node: dict[str, Any]) -> Any:
        return weights[node[ARRAY]] if [*node] == [ARRAY] else node

    text = (folder / "controller.json").read_text(encoding="utf-8")
    about: dict[str, Any] = json.loads(text, object_hook=placed)
    return about


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays in an ``.npz`` file by name."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


class NumpyNetworks:
    """Every network of the hierarchy, as a :class:`ddco_pyro.model.networks.perceptrons.NumpyForm` says."""

    def __init__(self, about: Mapping[str, Any]) -> None:
        self._about, self._networks = about, about["networks"]
        self._after: State = []

    def __call__(
        self, features: np.ndarray, step: int, images: Mapping[str, np.ndarray], state: State
    ) -> tuple[Outputs, State]:
        """The outputs of every network for one observation, and the next state."""
        own, depth = self._networks, len(self._about["levels"])
        if "places" in own:
            features = np.clip(features[own["places"]], own["low"], own["high"])
        vector = ((features - own["mean"]) / own["deviation"]).astype(np.float32)
        sizes = self._about["features"]
        ends = np.cumsum([0, *sizes.values()])
        self._seen = {key: vector[first:end] for key, first, end in zip(sizes, ends, ends[1:], strict=False)}
        self._images, self._step = images, step
        self._before, self._after = iter(state), []
        outputs: Outputs = {}
        trunk = self._network("trunk")
        if trunk is not None:
            self._seen = {"trunk": trunk[0]}
        for level, caller in enumerate(self._about["callers"]):
            out = self._network(f"caller_{level}")
            assert out is not None  # every caller has a network
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
        raw, bound = self._network(f"end_{level}"), np.float32(self._about["termination_bound"])
        if raw is None:
            return np.ones(options)
        psi: np.ndarray = 1 / (1 + np.exp(-(bound * np.tanh(raw[:, 0] / bound)).astype(np.float64)))
        return psi

    def _network(self, name: str) -> np.ndarray | None:
        """The outputs of a network for each of K copies, [K, outputs]; None if there is no such network."""
        node = self._networks.get(name)
        return None if node is None else self._evaluate(node)

    def _evaluate(self, node: Mapping[str, Any]) -> np.ndarray:
        """Features of a part of a network for each of K copies, [K, features]."""
        values: np.ndarray = getattr(self, f"_{node['kind']}")(node)
        return values

    def _vectors(self, node: Mapping[str, Any]) -> np.ndarray:
        vector = np.concatenate([np.zeros(0, np.float32), *(self._seen[key] for key in node["keys"])])
        return np.broadcast_to(vector, (node["copies"], len(vector)))

    def _joined(self, node: Mapping[str, Any]) -> np.ndarray:
        return np.concatenate([self._evaluate(of) for of in node["of"]], axis=1)

    def _perceptrons(self, node: Mapping[str, Any]) -> np.ndarray:
        """K perceptrons, those of this step; an activation follows the hidden layers."""
        values = self._evaluate(node["of"])[:, None]
        first = min(self._step, node["steps"] - 1) * node["copies"]
        now = slice(first, first + node["copies"])
        for number, layer in enumerate(node["layers"]):
            values = values @ layer["weight"][now] + layer["bias"][now]
            if number < node["hidden"]:
                values = ACTIVATIONS[node["activation"]](values)
        return values[:, 0]

    def _lstm(self, node: Mapping[str, Any]) -> np.ndarray:
        """K LSTMs. Networks are evaluated in the order of their states."""
        values = self._evaluate(node["of"])[:, None]
        goes_on = np.float32(not node["horizon"] or self._step % node["horizon"] != 0)
        for layer in node["layers"]:
            weight, bias, recurrent = (layer[part] for part in ("inputs.weight", "inputs.bias", "recurrent"))
            h, c = (goes_on * next(self._before).transpose(1, 0, 2) for _ in "hc")
            take, keep, new, give = np.split(values @ weight + bias + h @ recurrent, 4, axis=2)
            c = _sigmoid(keep) * c + _sigmoid(take) * np.tanh(new)
            values = _sigmoid(give) * np.tanh(c)
            self._after += [state.transpose(1, 0, 2) for state in (values, c)]
        return values[:, 0]

    def _convolutions(self, node: Mapping[str, Any]) -> np.ndarray:
        """Convolutions of a picture, each with an activation, and a pooling of the last maps."""
        maps = self._images[node["key"]].astype(np.float32).transpose(2, 0, 1)[None] / 255
        if node["standardize"]:
            maps = (maps - maps.mean()) / np.sqrt(np.maximum(maps.var(), 1 / maps.size))
        for layer in node["layers"]:
            maps = _convolved(np.broadcast_to(maps, (node["copies"], *maps.shape[1:])), layer)
            maps = ACTIVATIONS[node["activation"]](maps)
        return POOLS[node["pool"]](maps).reshape(node["copies"], -1)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))


def _convolved(maps: np.ndarray, layer: Mapping[str, Any]) -> np.ndarray:
    """[K, C, H, W] to [K, filters, H', W']; filters [K · filters, C, size, size]."""
    weight, bias = layer["weight"], layer["bias"]
    size, pad, stride = weight.shape[-1], (layer["padding"],) * 2, layer["stride"]
    padded = np.pad(maps, ((0, 0), (0, 0), pad, pad))
    every = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(2, 3))
    windows = every[:, :, ::stride, ::stride]
    filters = weight.reshape(len(maps), -1, *weight.shape[1:])
    convolved = np.einsum("kchwij,kfcij->kfhw", windows, filters, optimize=True)
    return np.asarray(convolved + bias.reshape(len(maps), -1, 1, 1))


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x: np.where(x > 0, x, np.float32(0.01) * x),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "tanh": np.tanh,
}


def _means(maps: np.ndarray) -> np.ndarray:
    """Means over 8 × 8 fields, [K, filters, 8, 8]."""
    rows, columns = (_fields(length, 8) for length in maps.shape[2:])
    means = [np.stack([maps[:, :, a:b, c:d].mean((2, 3)) for c, d in columns], -1) for a, b in rows]
    return np.stack(means, -2)


def _expected_places(maps: np.ndarray) -> np.ndarray:
    """The expected (row, column), each from -1 to 1, under the softmax of each map, [K, filters, 2]."""
    weights = np.exp(maps - maps.max((2, 3), keepdims=True))
    weights /= weights.sum((2, 3), keepdims=True)
    rows, columns = (np.linspace(-1, 1, length, dtype=np.float32) for length in maps.shape[2:])
    return np.stack([weights.sum(3) @ rows, weights.sum(2) @ columns], -1)


POOLS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mean": _means,
    "flatten": lambda maps: maps,
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


def _numpy(_: Path, about: Mapping[str, Any]) -> Networks:
    if about["networks"] is None:
        raise ValueError('it has networks that numpy cannot evaluate: use Runner(..., networks="onnx")')
    return NumpyNetworks(about)


def _onnx(folder: Path, about: Mapping[str, Any]) -> Networks:
    """Every network of the hierarchy, from ``controller.onnx``, which gives outputs, then the next state."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(folder / "controller.onnx"), options)
    names = about["outputs"]
    read = [argument.name for argument in session.get_inputs()]  # nothing reads the others

    def evaluate(
        features: np.ndarray, step: int, images: Mapping[str, np.ndarray], state: State
    ) -> tuple[Outputs, State]:
        inputs = {"features": features, "step": np.array([step], np.int64)}
        inputs |= {f"image_{number}": image for number, image in enumerate(images.values())}
        inputs |= {f"state_{number}": array for number, array in enumerate(state)}
        values = session.run(None, {name: inputs[name] for name in read})
        return dict(zip(names, values, strict=False)), list(values[len(names) :])

    return evaluate


FORMS: dict[str, Callable[[Path, Mapping[str, Any]], Networks]] = {"numpy": _numpy, "onnx": _onnx}


def replay(controller: Runner, episodes: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Act on recorded observations again: the largest difference, and the median seconds of a step.

    The control is compared with the original's; every caller's mean control and selection probabilities, and
    every option's ψ, with what the original's networks say of the whole episode at once. The difference is
    infinite where another option is active or a number is NaN.
    """
    largest, seconds = 0.0, []
    for number, seed in enumerate(episodes["seeds"]):
        controller.reset(int(seed))
        observations = seen(episodes, number)
        for step in range(len(episodes[f"controls_{number}"])):
            observation = {key: rows[step] for key, rows in observations.items()}
            start = time.perf_counter()
            control = controller.act(observation)
            seconds.append(time.perf_counter() - start)
            if list(controller.choices) != episodes[f"choices_{number}"][step].tolist():
                largest = np.inf
            for name, value in {**controller.outputs, "controls": control}.items():
                recorded = episodes[f"{name}_{number}"][step]
                largest = max(largest, difference(controller.about, name, value, recorded))
    return largest, float(np.median(seconds))


def seen(episodes: Mapping[str, np.ndarray], number: int) -> dict[str, np.ndarray]:
    """The observations of a recorded episode by key, each [T, ...]."""
    prefix = f"observation_{number}_"
    return {key.removeprefix(prefix): rows for key, rows in episodes.items() if key.startswith(prefix)}


def difference(about: Mapping[str, Any], name: str, value: np.ndarray, original: np.ndarray) -> float:
    """The largest difference of an output from the original's, in units of :data:`TOLERANCE`; ∞ for NaN."""
    if name.startswith("selection"):
        value, original = np.exp(value), np.exp(original)
    unit = np.ones(original.shape)
    if name.startswith("control_"):
        unit = np.maximum(1.0, np.abs(original))
    if name == "controls":
        varying = about["varying"]
        distance = np.abs(original[..., varying] - np.array(about["shift"]))
        unit[..., varying] = np.maximum(np.maximum(1.0, about["scale"]), distance)
    difference = float((np.abs(value - original) / unit).max())
    return difference if np.isfinite(difference) else np.inf


def main() -> None:
    """Replay the recorded episodes."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    networks = sys.argv[2] if len(sys.argv) > 2 else "numpy"
    episodes = read_arrays(folder / "check.npz")
    largest, seconds = replay(Runner(folder, networks), episodes)
    allowed = float(episodes["tolerance"])
    found = f"largest difference: {largest:.1e} of {allowed:.1e} that are allowed"
    print(f"{found}; a step takes {1e3 * seconds:.3f} ms")
    sys.exit(0 if largest < allowed else 1)


if __name__ == "__main__":
    main()
