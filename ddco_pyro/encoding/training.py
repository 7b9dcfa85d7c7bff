"""Training the autoencoder on pictures that are read little by little; what is killed goes on with the same bits."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.encoding.networks import Autoencoder, Convolutions
from ddco_pyro.encoding.pictures import AT_ONCE, Pictures
from ddco_pyro.events import OnEvent, TrainingBegan, TrainingEnded, UpdatesDone
from ddco_pyro.training.checkpoint import copy_of, optimizer_state, restore_optimizer

UPDATES = 2000
"""Gradient steps, each on :data:`ddco_pyro.encoding.pictures.AT_ONCE` pictures."""

KEPT_EVERY = 50
"""Gradient steps between two checkpoints."""

LEARNING_RATE = 3e-3


def train(
    encoder: Convolutions, pictures: Pictures, seed: int, updates: int, checkpoint: Path, on_event: OnEvent
) -> None:
    """Train an encoder as the first half of an autoencoder, from where ``checkpoint`` stands, if it is there.

    :raises Damaged: the checkpoint does not hold what was written.
    """
    model = Autoencoder(encoder, pictures.shape, seed)
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    done = _restore(model, optimizer, checkpoint) if checkpoint.exists() else 0
    on_event(TrainingBegan("the autoencoder", updates))
    errors: list[float] = []
    for batch in islice(_batches(pictures, seed, done), updates - done):
        loss = model.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(loss.item())
        done += 1
        if done % KEPT_EVERY == 0 or done == updates:
            _keep(model, optimizer, done, checkpoint)
            on_event(UpdatesDone(done, float(np.mean(errors))))
            errors.clear()
    on_event(TrainingEnded("the autoencoder"))


def _batches(pictures: Pictures, seed: int, done: int) -> Iterator[Tensor]:
    """Pictures for one gradient step each, after those of the steps that are done, epoch after epoch without end."""
    size = min(AT_ONCE, pictures.number)
    each = pictures.number // size
    epoch, skip = divmod(done, each)
    while True:
        frames = islice(pictures.at_random(seed, epoch), skip * size, None)
        yield from (torch.from_numpy(np.stack(list(islice(frames, size)))) for _ in range(skip, each))
        epoch, skip = epoch + 1, 0


def _keep(model: Autoencoder, optimizer: torch.optim.Optimizer, done: int, path: Path) -> None:
    tensors = {f"model/{name}": value for name, value in copy_of(model).items()}
    tensors |= {f"optimizer/{name}": value for name, value in optimizer_state(optimizer).items()}
    write_tensors(path, tensors, {"updates": str(done)})


def _restore(model: Autoencoder, optimizer: torch.optim.Optimizer, path: Path) -> int:
    """The gradient steps that are done."""
    tensors, metadata = read_tensors(path, "remove it and do the same again: the autoencoder begins anew")
    parts: dict[str, dict[str, Tensor]] = {"model": {}, "optimizer": {}}
    for name, value in tensors.items():
        part, _, rest = name.partition("/")
        parts[part][rest] = value
    model.load_state_dict(parts["model"])
    restore_optimizer(optimizer, parts["optimizer"])
    return int(metadata["updates"])
