"""Parts of the benchmark about pictures: training on them, in chunks of time.

Times are of this process's processor, which other work on the machine changes little.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from measuring import Row, of_pairs, seconds, side_by_side

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.events import EpochEnded, Event
from ddco_pyro.inference import log_likelihood
from ddco_pyro.model import hierarchy as networks
from ddco_pyro.model.batch import Batch
from ddco_pyro.spec import parse_spec
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.processes import one_thread
from ddco_pyro.training.restarts import Trainer

AIMS = {"epoch of pictures in a file / pictures in memory": ("≤", 1.15)}
FF = {"network": "conv", "hidden": [64]}
"""The paper's: a convolution of 64 filters of 5 × 5 and a fully connected layer (SM 1.2)."""

SIZE = (120, 160, 3)
FEW, SHORT = 4, 16
"""Demonstrations that are trained on, beside one to tune with, and the steps of each."""

ROUNDS = 5


def made(number: int, steps: int) -> Demonstrations:
    """Pictures of noise."""
    random = np.random.default_rng(0)

    def one(index: int) -> Demonstration:
        camera = random.integers(0, 256, (steps, *SIZE), dtype=np.uint8)
        seen = {"pose": random.normal(size=(steps, 3)), "camera": camera}
        return Demonstration(f"demo_{index}", seen, random.normal(size=(steps, 3)))

    return Demonstrations(tuple(one(index) for index in range(number)))


def measured(names: tuple[str, str], *calls: Callable[[], float]) -> Row:
    """The row of calls that give seconds, in turns; the first round warms up."""
    return of_pairs(names, [tuple(1e3 * call() for call in calls) for _ in range(ROUNDS + 1)][1:])


def training() -> Iterator[Row]:
    """An epoch of the paper's FF networks, tuning included."""
    with tempfile.TemporaryDirectory() as folder:
        memory, stored = made(FEW + 1, SHORT), Path(folder) / "few.hdf5"
        memory.write(stored)
        streamed = Demonstrations.read(stored)
        held, read = partial(epoch, memory), partial(epoch, streamed)
        yield measured(("epoch of pictures in a file", "pictures in memory"), read, held)
        yield measured(("epoch of pictures in memory", "networks alone"), held, networks_alone(memory))


def trainer(demos: Demonstrations) -> Trainer:
    """The paper's FF networks, three options, a few epochs; the last demonstration tunes."""
    level = {"count": 3, "policy": FF, "termination": {"network": "linear", "inputs": ["pose"]}}
    train, tune = demos.select(demos.names[:-1]), demos.select(demos.names[-1:])
    budget = {"epochs": 2, "patience": None, "batch_size": len(train) // 2}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["pose", "camera"],
            "hierarchy": {"levels": [level], "meta_policy": FF},
            "training": {"starts": ["random"], "layerwise": False, **budget},
        }
    )
    return Trainer(spec, Dimensions.of(demos), train, tune)


def epoch(demos: Demonstrations) -> float:
    """Seconds of an epoch of this process's processor, the first epoch left out."""
    clocks: list[float] = []

    def tell(event: Event) -> None:
        if isinstance(event, EpochEnded):
            clocks.append(time.process_time())

    made_for = trainer(demos)
    made_for.on_event = tell
    made_for.run()
    return statistics.median(after - before for before, after in pairwise(clocks))


def networks_alone(demos: Demonstrations) -> Callable[[], float]:
    """Forward and backward of the same networks with a sum as loss, Adam, and forward where it tunes."""
    material = trainer(demos).data
    model = material.hierarchy(0).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3, fused=True)
    each, train, tune = list(model.networks().values()), material.train, material.tune

    def run() -> None:
        for rows in torch.arange(FEW).split(FEW // 2):
            optimizer.zero_grad()
            for _, piece in train.select(rows).pieces(model.steps_at_once):
                inputs = piece.inputs.loaded()
                sum(network(inputs)[0].sum() for network in each).backward()
            optimizer.step()
        with torch.no_grad():
            for _, piece in tune.pieces(model.steps_at_once):
                inputs = piece.inputs.loaded()
                for network in each:
                    network(inputs)

    def timed() -> float:
        with one_thread():
            return seconds(run, time.process_time)

    return timed


def chunks() -> Iterator[Row]:
    """A gradient of 240 pictures of 64 × 64 in eight chunks of time, over the same in one piece."""
    layer = {"kernel": 5, "stride": 2, "padding": 2}
    conv = {"network": "conv", "layers": [{"filters": 8, **layer}], "hidden": [32]}
    ends = {"network": "conv", "layers": [{"filters": 2, **layer}], "hidden": []}
    steps, random = 240, np.random.default_rng(0)
    camera = random.integers(256, size=(steps, 64, 64, 3), dtype=np.uint8)
    demos = Demonstrations((Demonstration("demo_0", {"camera": camera}, random.normal(size=(steps, 3))),))
    policies = {"conv": conv, "lstm over conv": {"network": "lstm", "over": conv, "hidden": 32}}
    for name, policy in policies.items():
        level = {"count": 3, "policy": policy, "termination": ends}
        of_pictures = {"demonstrations": {"path": "unused.hdf5"}, "observations": ["camera"]}
        spec = parse_spec({**of_pictures, "hierarchy": {"levels": [level], "meta_policy": ends}})
        made_for = Trainer(spec, Dimensions.of(demos), demos, demos)
        model, batch = made_for.hierarchy, made_for.data.train

        def gradient(number: int, model: networks.Hierarchy = model, batch: Batch = batch) -> None:
            networks.BYTES_AT_ONCE = model.step_bytes * -(-steps // number)
            model.zero_grad(set_to_none=True)
            log_likelihood(model.tabulate(batch), batch.lengths).sum().backward()

        calls = partial(gradient, 8), partial(gradient, 1)
        yield side_by_side((f"gradient of {name} in chunks", "in one piece"), *calls, ROUNDS)


PARTS = {"pictures": training, "chunks": chunks}
