"""Runs an exported controller with numpy alone. This file stands by itself, beside what it runs.

    from runner import Runner

    controller = Runner(".")
    controller.reset(seed=0)
    control = controller.act({"state": state})    # [A], in the control's own units
    controller.choices, controller.terminations   # active options, lowest level first, and their ψ

``python runner.py [FOLDER] [numpy|torch|onnx]`` replays the episodes in ``check.npz`` and says by how much it differs
from the original. Networks that numpy cannot evaluate (a user's) run with ``Runner(".", networks="torch")``, which
needs torch, or with ``Runner(".", networks="onnx")``, which needs onnxruntime.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.export.runner_networks import FORMS, Outputs

TOLERANCE = 1e-6
"""Differences from the original that are always allowed: of a probability, and of a control in units of the largest of
1, its spread, and its distance from where it is centred. ``check.npz`` says what is allowed of this controller: more
where float32, in which its networks are, rounds more."""


class Runner:
    """An exported controller: :meth:`reset`, then :meth:`act` with each observation.

    :param networks: what evaluates the networks: ``numpy``, ``torch`` (the ``torch.export`` program) or ``onnx``.
    """

    def __init__(self, folder: str | Path, networks: str = "numpy") -> None:
        folder = Path(folder)
        self.about: dict[str, Any] = json.loads((folder / "controller.json").read_text(encoding="utf-8"))
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
        self._pictures: dict[str, list[np.ndarray]] = {}
        self._marginal: np.ndarray | None = None
        self._state = [np.array(part["values"], part["kind"]).reshape(part["shape"]) for part in self.about["state"]]

    def act(self, observation: Mapping[str, Any]) -> np.ndarray:
        """The control [A], in the control's own units.

        :raises ValueError: an observation is missing, has an unseen shape or is not finite.
        """
        built_in = self.about["step"]
        if built_in:
            observation = {**observation, built_in["key"]: np.array([self.time / built_in["longest"]])}
        now = {spec["key"]: _checked(observation, spec) for spec in self.about["observations"]}
        features = self._features(now, self._last or now)
        images = {
            spec["key"]: self._recent(now[spec["key"]], spec) for spec in self.about["observations"] if spec["image"]
        }
        self.outputs, self._state = self._networks(features, self.time, images, self._state)
        outputs = self.outputs
        generator = np.random.default_rng([self.seed, self.time])
        choose = self._largest_marginal if self.about["options"] == "marginal" else self._choose
        self.choices = choose(outputs, generator)
        self.terminations = tuple(
            float(outputs[f"termination_{level}"][choice - 1]) if choice else 1.0
            for level, choice in enumerate(self.choices)
        )
        self._last, self.time = now, self.time + 1
        return self._control(outputs, generator)

    def _recent(self, picture: np.ndarray, spec: Mapping[str, Any]) -> np.ndarray:
        """The picture as networks see it, behind those before it where they see more than one."""
        cut = _picture(picture, spec)
        before = self._pictures.get(spec["key"], [cut] * spec.get("frames", 1))
        self._pictures[spec["key"]] = seen = [*before[1:], cut]
        return np.concatenate(seen, axis=-1)

    def _features(self, now: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]) -> np.ndarray:
        parts = [np.zeros(0)]
        for spec in self.about["observations"]:
            if not spec["image"]:
                value = now[spec["key"]].astype(np.float64).ravel()
                parts.append(value)
                if spec["differences"]:
                    parts.append(value - before[spec["key"]].astype(np.float64).ravel())
        return np.concatenate(parts)

    def _choose(self, outputs: Outputs, generator: np.random.Generator) -> tuple[int, ...]:
        """Terminations go bottom-up, selections top-down; at the first step everything is selected."""
        depth, terminated = len(self.about["levels"]), [True] * len(self.about["levels"])
        if self.choices:
            below = True
            for level, choice in enumerate(self.choices):
                psi = float(outputs[f"termination_{level}"][choice - 1]) if choice else 1.0
                ends = self._pick(np.array([1 - psi, psi] if below else [1.0, 0.0]), generator)
                terminated[level] = below = bool(ends)
        choices, caller = [0] * depth, 0
        for level in reversed(range(depth)):
            table = outputs[f"selection_{level + 1}"]
            if level < depth - 1 and caller == 0:
                probabilities = np.eye(table.shape[-1])[0]  # below control there is nothing left to choose
            else:
                probabilities = np.exp(table[caller - 1 if level < depth - 1 else 0].astype(np.float64))
            if not terminated[level]:
                probabilities = np.eye(len(probabilities))[self.choices[level]]
            caller = choices[level] = self._pick(probabilities, generator)
        return tuple(choices)

    def _largest_marginal(self, outputs: Outputs, _: np.random.Generator) -> tuple[int, ...]:
        """The choices with the largest p(h_t | s_0, ..., s_t); ``_marginal`` has that of all, [C_D, ..., C_1]."""
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
        """The most likely control, or a sample, of the lowest level with an option, else of the meta-policy."""
        level, actor = next(((d, h - 1) for d, h in enumerate(self.choices) if h > 0), (len(self.choices), 0))
        numbers, first = outputs[f"control_{level}"][actor].astype(np.float64), 0
        sampled = self.about["control"] == "sample"
        noise = generator.standard_normal(sum(len(part["places"]) for part in self.about["parts"])) if sampled else None
        control = np.array(self.about["constant"])  # dimensions that never varied in the demonstrations stay so
        for part in self.about["parts"]:
            own, z = numbers[first : first + part["size"]], None if noise is None else noise[part["places"]]
            control[part["dims"]] = KINDS[part["kind"]](part, own, _std(part, level, actor, numbers), z)
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


def _continuous(part: Part, mean: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A mean, or a draw around it, within the bounds there are, in the control's own units."""
    value, scale, shift = mean if z is None else mean + std * z, np.array(part["scale"]), np.array(part["shift"])
    control: np.ndarray = value * scale + shift
    for ends, side in zip(part["ends"], (-1, 1), strict=True):
        for place, end in enumerate(ends):
            if end is not None and side * np.float32(value[place]) >= side * np.float32(
                (end - shift[place]) / scale[place]
            ):
                control[place] = end
    return control


def _hurdle(part: Part, numbers: np.ndarray, std: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """The value, which is where scaled units begin, or what is continuous; the last of ``z`` decides."""
    exactly = numbers[0] >= 0 if z is None else _phi(z[-1]) < 1 / (1 + np.exp(-numbers[0]))
    return np.array(part["shift"]) if exactly else _continuous(part, numbers[1:], std, None if z is None else z[:-1])


def _binary(part: Part, logits: np.ndarray, _: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """The position of each switch."""
    on = logits > 0 if z is None else np.array([_phi(value) for value in z]) < 1 / (1 + np.exp(-logits))
    low, high = (np.array(ends) for ends in part["ends"])
    return np.where(on, high, low)


def _categorical(part: Part, logits: np.ndarray, _: np.ndarray, z: np.ndarray | None) -> np.ndarray:
    """A discrete action, as its value or as a row."""
    index = int(logits.argmax())
    if z is not None:
        total = np.exp(logits - logits.max()).cumsum()
        index = min(int((total <= _phi(z[0]) * total[-1]).sum()), len(total) - 1)
    return np.array([part["values"][index]]) if part["values"] else np.eye(len(logits))[index]


def _phi(z: float) -> float:
    """The probability that a standard normal number is less."""
    return 0.5 * math.erfc(-z / math.sqrt(2))


KINDS: dict[str, Callable[[Part, np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]] = {
    "gaussian": _continuous,
    "clipped": _continuous,
    "hurdle": _hurdle,
    "binary": _binary,
    "categorical": _categorical,
}


def _picture(picture: np.ndarray, spec: Mapping[str, Any]) -> np.ndarray:
    """A picture [H, W, C] as networks see it: a part of it, scaled, without colours, where it is so."""
    if "crop" in spec:
        top, left, height, width = spec["crop"]
        picture = picture[top : top + height, left : left + width]
    if "resize" in spec and picture.shape[:2] != tuple(spec["resize"]):
        picture = _resized(picture, *spec["resize"])
    if spec.get("grey"):
        red, green, blue = np.moveaxis(picture.astype(np.uint32), -1, 0)
        picture = ((299 * red + 587 * green + 114 * blue + 500) // 1000).astype(np.uint8)[..., None]
    return picture


def _resized(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scaled by the mean over areas.

    :raises ImportError: there is no cv2.
    """
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "pictures are scaled with cv2, which is missing: pip install opencv-python-headless"
        ) from error
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
        raise ValueError(f"observation {key!r} is {data.dtype}, it has to be {'uint8' if spec['image'] else 'numbers'}")
    if not np.isfinite(data).all():
        raise ValueError(f"observation {key!r} is not finite")
    return data


def replay(controller: Runner, episodes: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Act on recorded observations again: the largest difference, and the median seconds of a step.

    The control is compared with the original's; every caller's mean control and selection probabilities, and every
    option's ψ, with what the original's networks say of the whole episode at once. The difference is infinite where
    another option is active or a number is NaN.
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
                largest = max(largest, difference(controller.about, name, value, episodes[f"{name}_{number}"][step]))
    return largest, float(np.median(seconds))


def seen(episodes: Mapping[str, np.ndarray], number: int) -> dict[str, np.ndarray]:
    """The observations of a recorded episode by key, each [T, ...]."""
    prefix = f"observation_{number}_"
    return {key.removeprefix(prefix): rows for key, rows in episodes.items() if key.startswith(prefix)}


def difference(about: Mapping[str, Any], name: str, value: np.ndarray, original: np.ndarray) -> float:
    """The largest difference of an output from the original's, in the units of :data:`TOLERANCE`; infinite for NaN."""
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
    with np.load(folder / "check.npz", allow_pickle=False) as file:
        episodes = {name: file[name] for name in file.files}
    largest, seconds = replay(Runner(folder, networks), episodes)
    allowed = float(episodes["tolerance"])
    print(f"largest difference: {largest:.1e} of {allowed:.1e} that are allowed; a step takes {1e3 * seconds:.3f} ms")
    sys.exit(0 if largest < allowed else 1)


if __name__ == "__main__":
    main()
