"""What it costs to train on a trajectory of pictures in chunks of time: ``python benchmarks/chunks.py``.

Prints the processor's time of a gradient in chunks over that of the same gradient in one piece, on one thread: the
median of pairs that ran one right after the other.
"""

from __future__ import annotations

import statistics
import time

import torch

from ddco_pyro.inference import log_likelihood
from ddco_pyro.model import hierarchy as networks
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.spec import parse_spec

STEPS, SIDE, CHUNKS, ROUNDS = 240, 64, 8, 9
CONV = {"network": "conv", "filters": 8, "kernel": 5, "hidden": [32]}
NETWORKS = {"conv": CONV, "lstm over conv": {"network": "lstm", "over": CONV, "hidden": 32}}


def problem(network: dict[str, object]) -> tuple[Hierarchy, Batch]:
    """Three options, random pictures and controls: one trajectory."""
    torch.manual_seed(0)
    termination = {"network": "conv", "filters": 2, "hidden": []}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["camera"],
            "hierarchy": {
                "levels": [{"count": 3, "policy": network, "termination": termination}],
                "meta_policy": termination,
            },
        }
    )
    hierarchy = Hierarchy(spec, {"camera": (SIDE, SIDE, 3)}, 3, STEPS)
    pictures = torch.randint(256, (1, STEPS, SIDE, SIDE, 3), dtype=torch.uint8)
    inputs = Inputs({}, {"camera": pictures}, torch.arange(STEPS))
    return hierarchy, Batch(inputs, torch.randn(1, STEPS, 3), torch.tensor([STEPS]))


def gradient(hierarchy: Hierarchy, batch: Batch, chunks: int) -> float:
    """Seconds of the processor for the gradient of the log-likelihood, in so many chunks of time."""
    networks.BYTES_AT_ONCE = hierarchy.step_bytes * -(-STEPS // chunks)
    hierarchy.zero_grad(set_to_none=True)
    start = time.process_time()
    log_likelihood(hierarchy.tabulate(batch), batch.lengths).sum().backward()
    return time.process_time() - start


def main() -> None:
    """Print what chunks cost."""
    torch.set_num_threads(1)
    for name, network in NETWORKS.items():
        case = problem(network)
        pairs = [(gradient(*case, CHUNKS), gradient(*case, 1)) for _ in range(ROUNDS + 1)][1:]  # the first one warms up
        cost = statistics.median(chunked / whole for chunked, whole in pairs)
        print(f"{name}, {CHUNKS} chunks: {cost:.2f} times the time of one piece")


if __name__ == "__main__":
    main()
