"""Files that are larger than memory: streamed where that can be, else refused before they are read."""

import math
import zlib
from pathlib import Path

import forked
import h5py
import numpy as np
import pytest
import toy_task
import yaml
from command_line import call, done, refused

from ddco_pyro.data import arrays


@pytest.fixture(autouse=True)
def two_gigabytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is free does not depend on the machine that runs the tests."""
    monkeypatch.setattr(arrays, "free", lambda: 2 * 10**9)


def zeros(
    group: h5py.Group, place: str, shape: tuple[int, ...], chunk: tuple[int, ...], dtype: str = "f8"
) -> None:
    """An array of zeros that is really there: every chunk of it is stored, compressed to a thousandth."""
    stored = {"chunks": chunk, "maxshape": (None, *shape[1:]), "compression": "gzip"}
    dataset = group.create_dataset(place, shape, dtype, **stored)
    stored = zlib.compress(bytes(int(np.prod(chunk)) * dataset.dtype.itemsize), 1)
    for start in np.ndindex(*(-(-size // part) for size, part in zip(shape, chunk, strict=True))):
        dataset.id.write_direct_chunk(tuple(np.multiply(start, chunk)), stored)


def large(path: Path, number: int, steps: int, size: int = 1000) -> Path:
    """Demonstrations of as many numbers, all zero, compressed; controls that are not."""
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(number):
            group = file.create_group(f"data/demo_{index}")
            zeros(group, "obs/state", (steps, size), (min(steps, 1000), size))
            group["obs/arm"] = random.normal(size=(steps, 2))
            group["actions"] = random.normal(size=(steps, 2))
    return path


def spec_of(path: Path, *observations: str) -> Path:
    spec = path.with_suffix(".yaml")
    data = yaml.safe_load(toy_task.SPEC)
    del data["task"], data["rollout"], data["compare_with"]
    data |= {"demonstrations": {"path": str(path)}, "observations": list(observations)}
    spec.write_text(yaml.safe_dump(data))
    return spec


def test_a_fit_to_what_is_larger_than_memory_is_refused(tmp_path: Path) -> None:
    """8 GB in a file of a few megabytes: 28 bytes for each observation and control of a step, and more."""
    eight = large(tmp_path / "eight.hdf5", 10, 100_000)
    spec, out = spec_of(eight, "state"), ("--out", tmp_path)
    size = f"{math.ceil((28 * 10**6 * (1000 + 2) + arrays.PROGRAM) / 1e8) / 10:g}"
    for command in (["check", spec], ["fit", spec, "--out", tmp_path / "run"], ["select", spec, *out]):
        refused(f": {eight}: a fit to state takes about {size} GB of memory, and 2 are free; leave", *command)
    assert not (tmp_path / "run").exists()
    done("check", spec_of(eight, "arm"))


def test_a_demonstration_that_cannot_be_segmented_is_refused(toy_run, tmp_path: Path) -> None:
    """What the toy run was fitted to, much of it."""
    path, steps = tmp_path / "long.hdf5", 10**6
    with h5py.File(path, "w") as file:
        for name in ("demo_0", "demo_1"):
            for key, size in (("obs/offsets", 4), ("obs/visited", 1), ("actions", 2)):
                zeros(file, f"data/{name}/{key}", (steps, size), (steps, size))
    said = f"{path}: demo_0: segmenting its 1000000 steps takes about"
    assert "divide it" in refused(said, "segment", toy_run.folder, path, "--in-place").err


def test_looking_does_not_take_more_than_a_block(tmp_path: Path) -> None:
    paths = [large(tmp_path / f"{steps}.hdf5", 3, steps) for steps in (100, 10_000)]
    base, found = (forked.run(lambda path=path: call("inspect", path)) for path in paths)
    assert (base.value.status, found.value.status) == (0, 0)
    assert "3 demonstrations of 10000 to 10000 steps" in found.value.out
    assert found.grown - base.grown < 150e6  # of 240 MB
