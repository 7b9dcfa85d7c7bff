"""What a second process that shares each gradient step saves: ``python benchmarks/processes.py``.

The paper's FF networks (a convolution of 64 filters of 5 × 5 and a fully connected layer) on pictures of 160 × 120.
Prints the seconds of an epoch, tuning included, with one process and with two, and the processor's time of the first
process: what seconds come to where each process has a core to itself.
"""

from __future__ import annotations

import statistics
import time
from itertools import pairwise

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.events import EpochEnded, Event
from ddco_pyro.spec import Spec, parse_spec
from ddco_pyro.training.launching import together
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import Trainer

NUMBER, STEPS, EPOCHS = 8, 16, 4
FF = {"network": "conv", "filters": 64, "kernel": 5, "hidden": [64]}
"""The paper's: a convolution of 64 filters of 5 × 5 and a fully connected layer (SM 1.2)."""


def problem() -> tuple[Spec, Demonstrations, Demonstrations]:
    """Three options; random pictures and controls."""
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["camera"],
            "hierarchy": {"levels": [{"count": 3, "policy": FF, "termination": FF}], "meta_policy": FF},
            "training": {
                "initialize": "random",
                "layerwise": False,
                "batch_size": NUMBER,
                "shards": 2,
                "epochs": EPOCHS,
                "patience": None,
            },
        }
    )
    random = np.random.default_rng(0)

    def demonstration(number: int) -> Demonstration:
        pictures = random.integers(0, 256, (STEPS, 120, 160, 3), dtype=np.uint8)
        return Demonstration(f"demo_{number}", {"camera": pictures}, random.normal(size=(STEPS, 3)))

    train, tune = (Demonstrations(tuple(map(demonstration, range(count)))) for count in (NUMBER, 2))
    return spec, train, tune


def epoch(processes: int) -> tuple[float, float]:
    """Seconds of an epoch, and those of this process's processor: medians, the first epoch left out."""
    spec, train, tune = problem()
    clocks: list[tuple[float, float]] = []

    def tell(event: Event) -> None:
        if isinstance(event, EpochEnded):
            clocks.append((time.monotonic(), time.process_time()))

    with together(processes) as ranks:
        Trainer(spec, Dimensions.of(train), train, tune, on_event=tell, ranks=ranks).run()
    pairs = list(pairwise(clocks))
    seconds, processor = (statistics.median(after[kind] - before[kind] for before, after in pairs) for kind in (0, 1))
    return seconds, processor


def main() -> None:
    """Print what the second process saves."""
    alone, shared = epoch(1), epoch(2)
    for name, before, after in zip(("seconds", "the first process's processor"), alone, shared, strict=True):
        print(f"{name}: {before:.2f} s with one process, {after:.2f} s with two: {before / after:.2f} times as fast")


if __name__ == "__main__":
    main()
