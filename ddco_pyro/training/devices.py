"""The device of the networks (``training.device``), and what makes work on it bit-for-bit repeatable."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits

from ddco_pyro.model.seeding import HOST
from ddco_pyro.spec import SpecError, TrainingSpec

WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
"""The environment variable that makes the order of sums in cuBLAS fixed; CUDA reads it at its first use."""


def device_of(training: TrainingSpec) -> torch.device:
    """The device that a spec asks for; of several GPUs each process takes one (``LOCAL_RANK``).

    :raises SpecError: the machine has no such device.
    """
    if training.device == "cpu" or (training.device == "auto" and not torch.cuda.is_available()):
        return HOST
    if not torch.cuda.is_available():
        raise SpecError(
            f"training.device: cuda: torch {torch.__version__} has no GPU here; say cpu, or auto for a GPU where there "
            "is one"
        )
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)) % torch.cuda.device_count())


def described(device: torch.device) -> str:
    """The kind of a device, with the model of a GPU: the bits of a run depend on both."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Inside, a GPU gives the same bits each time, without TF32; nothing changes on the host."""
    if device.type != "cuda":
        yield
        return
    os.environ.setdefault(WORKSPACE, ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.use_deterministic_algorithms(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch, numpy and scikit-learn on one thread inside.

    Small networks run faster so, and results are the same in any process.
    """
    before = torch.get_num_threads()
    with threadpool_limits(1):
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
