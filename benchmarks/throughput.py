"""How fast pictures are read, encoded and trained on: ``python benchmarks/throughput.py``, as ``make bench`` does.

Ratios, each the median of pairs that ran one right after the other on the same file. Reading goes on in other processes
and is compared by the clock, as what a second process saves is; the rest by the time of this process's processor, which
other work on the machine changes little. Writes ``benchmarks/throughput.json`` and a table in ``docs/performance.md``.
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import Job, Readers, Transform
from ddco_pyro.encoding import Encoding, encode
from ddco_pyro.encoding.autoencoder import Convolutions
from ddco_pyro.events import EpochEnded, Event
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.spec import parse_spec
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import Trainer

sys.path.append(str(Path(__file__).parents[1] / "studies"))
from processes import FF
from processes import epoch as shared_epoch
from provenance import record, sentence, text

HERE = Path(__file__).parent
COMMAND = "python benchmarks/throughput.py"
BEGIN, END = "<!-- throughput, written by make bench -->\n", "<!-- end of throughput -->\n"

NUMBER, STEPS, SIZE = 12, 60, (120, 160, 3)
FEW, SHORT = 4, 16
"""Demonstrations that are trained on, beside one to tune with, and the steps of each."""

WORKERS, BATCH = 2, 16
"""Of both ways to read: robomimic's settings for pictures."""

ROUNDS = 5


class SingleSteps(Dataset):
    """robomimic's loading pattern, rebuilt: ``SequenceDataset`` with ``hdf5_cache_mode="low_dim"``.

    Vectors and controls are in memory; a sample is a single step, whose picture is read from the file, which each
    worker opens once.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.file = path, None
        with h5py.File(path) as file:
            self.low = {
                name: {"pose": demo["obs/pose"][()], "actions": demo["actions"][()].astype(np.float32)}
                for name, demo in file["data"].items()
            }
        self.index = [(name, step) for name, each in self.low.items() for step in range(len(each["actions"]))]

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, number: int) -> dict[str, np.ndarray]:
        if self.file is None:
            self.file = h5py.File(self.path, "r", swmr=True, libver="latest")
        name, step = self.index[number]
        camera = self.file[f"data/{name}/obs/camera"][step : step + 1]
        return {"camera": camera, **{key: values[step : step + 1] for key, values in self.low[name].items()}}


def made(number: int, steps: int) -> Demonstrations:
    """Pictures of noise."""
    random = np.random.default_rng(0)

    def one(index: int) -> Demonstration:
        camera = random.integers(0, 256, (steps, *SIZE), dtype=np.uint8)
        return Demonstration(
            f"demo_{index}", {"pose": random.normal(size=(steps, 3)), "camera": camera}, random.normal(size=(steps, 3))
        )

    return Demonstrations(tuple(one(index) for index in range(number)))


def paired(*calls: Callable[[], float]) -> Iterator[float]:
    """Medians over rounds of what each but the first call gives, divided by what the first gives; the first round
    warms up.
    """
    rounds = [[call() for call in calls] for _ in range(ROUNDS + 1)][1:]
    for number in range(1, len(calls)):
        yield statistics.median(row[number] / row[0] for row in rounds)


def seconds(clock: Callable[[], float], call: Callable[[], object]) -> float:
    """What a call takes by a clock."""
    start = clock()
    call()
    return clock() - start


def reading(path: Path) -> Iterator[tuple[str, float]]:
    """Frames in a second that come from two processes, over robomimic's pattern with two."""
    loader = DataLoader(SingleSteps(path), BATCH, shuffle=True, num_workers=WORKERS, persistent_workers=True)
    demos = list(Demonstrations.read(path))

    def theirs() -> None:
        assert sum(len(batch["camera"]) for batch in loader) == NUMBER * STEPS

    with Readers(WORKERS) as readers:

        def ours() -> None:
            order = np.random.default_rng(0).permutation(len(demos)).tolist()
            jobs = [_job(demos[number], number) for number in order]
            readers.plan(jobs)
            assert sum(readers.take(job)["camera"].shape[1] for job in jobs) == NUMBER * STEPS

        times = partial(seconds, time.perf_counter)
        (ratio,) = paired(partial(times, ours), partial(times, theirs))
    yield "frames_read_over_robomimic_pattern", ratio


def _job(demo: Demonstration, number: int) -> Job:
    pictures = {"camera": (demo.observations["camera"],)}
    return Job((number,), pictures, slice(0, len(demo)), {"camera": Transform()}, {})


def encoding(path: Path) -> Iterator[tuple[str, float]]:
    """``ddco-pyro encode`` on the file, over its network alone on the same frames in memory."""
    network = Convolutions("random_conv", SIZE, 0)
    frames = [np.asarray(demo.observations["camera"]) for demo in Demonstrations.read(path)]

    def alone() -> None:
        with one_thread():
            for block in frames:
                network.encode(block)

    def whole() -> None:
        with tempfile.TemporaryDirectory() as folder:
            encode(path, Path(folder) / "out.hdf5", Encoding("camera"))

    times = partial(seconds, time.process_time)
    (ratio,) = paired(partial(times, alone), partial(times, whole))
    yield "encode_over_its_network_in_memory", ratio


def training(path: Path) -> Iterator[tuple[str, float]]:
    """An epoch, tuning included, of pictures in a file over the same in memory, and over the networks alone."""
    memory, stored = made(FEW + 1, SHORT), path.with_name("few.hdf5")
    memory.write(stored)
    streamed = Demonstrations.read(stored)
    (read,) = paired(partial(epoch, memory), partial(epoch, streamed))
    yield "epoch_streamed_over_in_memory", read
    (ahead,) = paired(partial(epoch, memory), partial(epoch, streamed, WORKERS))
    yield "epoch_streamed_with_workers_over_in_memory", ahead
    (alone,) = paired(networks_alone(memory), partial(epoch, memory))
    yield "epoch_in_memory_over_networks_alone", alone


def trainer(demos: Demonstrations, workers: int = 0) -> Trainer:
    """The paper's FF networks, three options, a few epochs."""
    level = {"count": 3, "policy": FF, "termination": {"network": "linear", "inputs": ["pose"]}}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["pose", "camera"],
            "hierarchy": {"levels": [level], "meta_policy": FF},
            "training": {
                "initialize": "random",
                "layerwise": False,
                "batch_size": FEW // 2,
                "epochs": 2,
                "patience": None,
                "workers": workers,
            },
        }
    )
    train, tune = demos.select(demos.names[:FEW]), demos.select(demos.names[FEW:])
    return Trainer(spec, Dimensions.of(demos), train, tune, on_event=lambda event: None)


def epoch(demos: Demonstrations, workers: int = 0) -> float:
    """Seconds of this process's processor that the second epoch takes."""
    clocks: list[float] = []

    def tell(event: Event) -> None:
        if isinstance(event, EpochEnded):
            clocks.append(time.process_time())

    made_for = trainer(demos, workers)
    made_for.on_event = tell
    made_for.run()
    return next(after - before for before, after in pairwise(clocks))


def networks_alone(demos: Demonstrations) -> Callable[[], float]:
    """Forward and backward of the same networks with a sum as loss, Adam, and forward alone where an epoch tunes."""
    material = trainer(demos).data
    model = material.hierarchy(0).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    networks = list(model.networks().values())
    train, tune = material.train, material.tune

    def run() -> None:
        for rows in torch.arange(FEW).split(FEW // 2):
            optimizer.zero_grad()
            for _, piece in train.select(rows).pieces(model.steps_at_once):
                inputs = piece.inputs.loaded()
                sum(network(inputs).sum() for network in networks).backward()
            optimizer.step()
        with torch.no_grad():
            for _, piece in tune.pieces(model.steps_at_once):
                inputs = piece.inputs.loaded()
                for network in networks:
                    network(inputs)

    def timed() -> float:
        with one_thread():
            return seconds(time.process_time, run)

    return timed


def sharing(path: Path) -> Iterator[tuple[str, float]]:
    """An epoch of one process over the same of two that share each gradient step, by the clock."""
    alone, shared = shared_epoch(1), shared_epoch(2)
    yield "epoch_one_process_over_two", alone[0] / shared[0]


AIMS = {"epoch_streamed_over_in_memory": ("≤", 1.15), "epoch_one_process_over_two": ("≥", 1.7)}


def table(found: dict[str, float]) -> str:
    """The ratios in Markdown."""
    lines = ["| ratio | | aim |", "|---|---|---|"]
    for name, value in found.items():
        sign, bound = AIMS.get(name, ("", math.nan))
        reached = (value <= bound) if sign == "≤" else (value >= bound)
        aim = f"{sign} {bound:g} {'reached' if reached else '**not reached**'}" if sign else ""
        lines.append(f"| `{name}` | {value:.3g} | {aim} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure everything, and write it down."""
    made_by, found = record(COMMAND), {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demos.hdf5"
        made(NUMBER, STEPS).write(path)
        for part in (reading, encoding, training, sharing):
            for name, value in part(path):
                found[name] = value
                print(f"{name}: {value:.3g}", flush=True)
    (HERE / "throughput.json").write_text(text({"ratios": found}, [made_by]))
    page = HERE.parent / "docs" / "performance.md"
    above, _, rest = page.read_text().partition(BEGIN)
    below = rest.partition(END)[2]
    page.write_text(f"{above}{BEGIN}{sentence(COMMAND, [made_by])}\n\n{table(found)}{END}{below}")


if __name__ == "__main__":
    main()
