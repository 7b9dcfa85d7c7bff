"""Policies that a user would pick instead of options: plain torch, from low-dimensional observations.

    policy = fit(demos, KINDS["flow"], seed=0)
    policy.reset(seed=0)
    control = policy.act(observation)    # [A]
    policy.write(folder)                 # for a simulator with numpy alone

``bc`` is behaviour cloning by a perceptron. ``chunks`` gives chunks of controls and acts by temporal
ensembling, as ACT does (Zhao et al. 2023). ``flow`` draws chunks of controls by flow matching, as a diffusion
policy does (Chi et al. 2023): from two observations, with averaged weights, and half of a chunk is executed.
``lstm`` remembers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from inspect import getsource
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.spec.training import OptimizerSpec
from ddco_pyro.training.optimizers import gradient_optimizer, learning_rate
from studies import policies_acting
from studies.arena_playing import Chunks, write_chunk
from studies.policies_acting import Acting, times


@dataclass(frozen=True)
class Settings:
    """How a policy is made and trained.

    :param kind: ``perceptron``, ``lstm`` or ``flow``.
    :param hidden: units of the hidden layers; of an LSTM its one.
    :param chunk: steps that are predicted at once.
    :param executed: steps of a chunk that are executed before the next one; 0: all chunks are averaged (ACT).
    :param history: observations that the policy sees.
    :param power: of the error: 1 (L1) or 2 (squared).
    :param steps: gradient steps, the same for all policies.
    :param batch: steps of demonstrations in a gradient step; an LSTM takes whole demonstrations.
    :param rate: learning rate, which falls to 0 by a cosine.
    :param decay: of weights.
    :param averaged: decay of the moving average of the weights, with which the policy acts; 0: the last ones.
    """

    kind: str = "perceptron"
    hidden: tuple[int, ...] = (256, 256)
    chunk: int = 1
    executed: int = 1
    history: int = 1
    power: int = 2
    steps: int = 2000
    batch: int = 128
    rate: float = 1e-3
    decay: float = 1e-4
    averaged: float = 0.0

    def given(self, values: Mapping[str, Any]) -> Settings:
        """With other values.

        :raises BadInput: there is no such setting.
        """
        for name in values.keys() - asdict(self).keys():
            raise BadInput(f"a policy has no setting {name!r}{nearest(name, asdict(self))}")
        as_tuples = {name: tuple(one) if isinstance(one, list) else one for name, one in values.items()}
        return replace(self, **as_tuples)


KINDS = {
    "bc": Settings(),
    "chunks": Settings(chunk=8, executed=0, power=1),
    "flow": Settings(kind="flow", hidden=(256, 256, 256), chunk=16, executed=8, history=2, averaged=0.995),
    "lstm": Settings(kind="lstm", hidden=(128,), batch=400),
}
"""The policies by name. The LSTM has about as many parameters as the perceptron of ``bc``."""


class Network(nn.Module):
    """Features [N, ..., F] to chunks of controls [N, ..., C]; a flow gets the noisy chunk and time, too."""

    def __init__(self, settings: Settings, features: int, size: int) -> None:
        super().__init__()
        sizes = [features + (size + 8 if settings.kind == "flow" else 0), *settings.hidden, size]
        if settings.kind == "lstm":
            self.lstm = nn.LSTM(sizes[0], sizes[1], batch_first=True)
            sizes = sizes[1:]
        linear = [nn.Linear(*pair) for pair in pairwise(sizes)]
        self.layers = nn.Sequential(*[part for one in linear for part in (one, nn.ReLU())][:-1])

    def forward(self, features: Tensor) -> Tensor:
        """The chunks, or how a flow moves them."""
        return self.layers(self.lstm(features)[0] if hasattr(self, "lstm") else features)  # type: ignore[no-any-return]


class Policy(Chunks):
    """A trained policy; ``parameters`` is their number."""

    def __init__(self, acting: Acting, settings: Settings) -> None:
        super().__init__(acting, settings.chunk, settings.executed)
        self.settings = settings
        weights = (array.size for name, array in acting.arrays.items() if "." in name)
        self.parameters = sum(weights)

    def write(self, folder: Path) -> None:
        """Write it for :func:`arena_playing.exported`, which needs numpy alone."""
        np.savez(folder / "policy.npz", **self.controller.arrays)
        (folder / "policy.json").write_text(json.dumps(self.controller.about))
        (folder / "runner.py").write_text(getsource(policies_acting))
        write_chunk(folder, self.chunk, self.executed)


def fit(demos: Demonstrations, settings: Settings, seed: int, keys: Iterable[str] | None = None) -> Policy:
    """Train a policy on the demonstrations of the mask ``train``, or on all where there is none.

    Others have no part, not even in when the training ends. Equal seeds give equal policies.

    :param keys: of observations, vectors; None: all.
    """
    demos = demos.select(demos.masks["train"]) if "train" in demos.masks else demos
    keys = sorted(demos.observation_shapes if keys is None else keys)
    seen, done = ([values(demo) for demo in demos] for values in (lambda demo: vector(demo, keys), _actions))
    arrays = {"seen": _scale(seen), "done": _scale(done)}
    features = [_history(_scaled(one, arrays["seen"]), settings.history) for one in seen]
    scaled = [chunks(_scaled(one, arrays["done"]), settings.chunk) for one in done]
    data = [_tensors(*pair) for pair in zip(features, scaled, strict=True)]
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        weights = _trained(data, settings)
    about = {"keys": keys, "kind": settings.kind, "history": settings.history, "chunk": settings.chunk}
    whole = np.concatenate(done)
    arrays |= {"range": np.stack([whole.min(0), whole.max(0)]), **weights}
    return Policy(Acting(about, arrays), settings)


Pair = tuple[Tensor, Tensor]
"""Features and chunks of controls of a demonstration, both scaled: [T, F], [T, C]."""


def _trained(data: list[Pair], settings: Settings) -> dict[str, np.ndarray]:
    """The weights after all gradient steps."""
    network = Network(settings, data[0][0].shape[-1], data[0][1].shape[-1])
    spec = OptimizerSpec(name="adamw", lr=settings.rate, weight_decay=settings.decay, schedule="cosine")
    optimizer = gradient_optimizer(spec.name, spec, list(network.parameters()))
    averaged = {name: one.clone() for name, one in network.state_dict().items()}
    batches = _whole(data, settings) if settings.kind == "lstm" else _rows(data, settings)
    loss = _flow_loss if settings.kind == "flow" else _error
    for step, (features, chunk) in zip(range(settings.steps), batches, strict=False):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(spec, step, settings.steps)
        optimizer.zero_grad()
        loss(network, features, chunk, settings.power).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        share = 1 - min(settings.averaged, step / (step + 10))
        for name, one in network.state_dict().items():
            averaged[name].lerp_(one, share)
    return {name: one.numpy() for name, one in averaged.items()}


def _error(network: Callable[[Tensor], Tensor], features: Tensor, chunk: Tensor, power: int) -> Tensor:
    """The mean error of the chunks; NaN fills up shorter demonstrations."""
    there = ~chunk.isnan()
    return (network(features)[there] - chunk[there]).abs().pow(power).mean()


def _flow_loss(network: Callable[[Tensor], Tensor], features: Tensor, chunk: Tensor, power: int) -> Tensor:
    """The error of the straight way from noise to a chunk, at a random time of it."""
    noise, t = torch.randn_like(chunk), torch.rand(len(chunk), 1)
    inputs = torch.cat([features, noise + t * (chunk - noise), times(t, torch)], -1)
    return _error(network, inputs, chunk - noise, power)


def _rows(data: list[Pair], settings: Settings) -> Iterator[Pair]:
    """Random steps of all demonstrations."""
    features, chunk = (torch.cat(parts) for parts in zip(*data, strict=True))
    while True:
        drawn = torch.randint(len(features), (settings.batch,))
        yield features[drawn], chunk[drawn]


def _whole(data: list[Pair], settings: Settings) -> Iterator[Pair]:
    """Random demonstrations from their beginning."""
    mean = np.mean([len(chunk) for _, chunk in data])
    number = max(1, round(settings.batch / mean))
    while True:
        drawn = [data[place] for place in torch.randint(len(data), (number,)).tolist()]
        features, chunk = zip(*drawn, strict=True)
        pad = nn.utils.rnn.pad_sequence
        yield pad(features, True), pad(chunk, True, float("nan"))


def vector(demo: Demonstration, keys: Iterable[str]) -> np.ndarray:
    """The observations of these keys side by side, [T, F]."""
    return np.concatenate([np.asarray(demo.observations[key]).reshape(len(demo), -1) for key in keys], -1)


def chunks(actions: np.ndarray, chunk: int) -> np.ndarray:
    """The controls [T, A] of ``chunk`` steps from each step on, [T, chunk · A]; the last one is repeated.

    >>> chunks(np.array([[1.0], [2.0], [3.0]]), 2).tolist()
    [[1.0, 2.0], [2.0, 3.0], [3.0, 3.0]]
    """
    steps = np.minimum(np.arange(len(actions))[:, None] + np.arange(chunk), len(actions) - 1)
    return np.asarray(actions[steps].reshape(len(actions), -1))


def chunked(demos: Demonstrations, chunk: int) -> Demonstrations:
    """The demonstrations with the controls of ``chunk`` steps as one control (:func:`chunks`)."""

    def of(demo: Demonstration) -> Demonstration:
        return replace(demo, actions=chunks(demo.actions, chunk))

    return Demonstrations(tuple(map(of, demos)), demos.masks, demos.attributes)


def _actions(demo: Demonstration) -> np.ndarray:
    return demo.actions


def _history(rows: np.ndarray, length: int) -> np.ndarray:
    """The last observations up to each step side by side, the oldest first, [T, length · F]."""
    steps = np.maximum(np.arange(len(rows))[:, None] + np.arange(1 - length, 1), 0)
    return np.asarray(rows[steps].reshape(len(rows), -1))


def _scale(parts: list[np.ndarray]) -> np.ndarray:
    """Mean and standard deviation over all steps, [2, F]; 1 where a number never changes."""
    whole = np.concatenate(parts)
    std = whole.std(0)
    return np.stack([whole.mean(0), np.where(std > 1e-6, std, 1.0)])


def _scaled(rows: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Rows in units of their standard deviation, [T, F]."""
    return np.asarray((rows - scale[0]) / scale[1])


def _tensors(*arrays: np.ndarray) -> Any:
    return tuple(torch.as_tensor(array, dtype=torch.float32) for array in arrays)
