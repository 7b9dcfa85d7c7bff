"""Whatever is wrong with a spec or a file of demonstrations: one line and exit code 2, or a correct result.

Never a traceback, a hang, or more than 2 GB of memory. The long versions are slow tests.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import call
from fuzz import SECONDS, Worker, damaged_file, damaged_spec
from random_demonstrations import demonstrations

SPEC = """
demonstrations: {path: PATH, valid_fraction: 0.25, labels: phase}
observations: [{key: pose, differences: true}]
control: {std: {learn: true, floor: 0.01}, scale: [1.0, 2.0]}
hierarchy:
  levels:
    - {name: skill, count: 2, policy: {network: mlp, hidden: [8], dropout: 0.1}, termination: {network: linear}}
    - {name: phase, count: 2, policy: {network: linear, emits: [options, control]}}
  meta_policy: {network: mlp, hidden: [8]}
compare_with: [flat, {kind: per_timestep, policy: {hidden: [4]}}]
training: {initialize: vq, epochs: 24, batch_size: 3, restarts: 2, patience: 5, optimizer: {name: adam, lr: 1.0e-2}}
selection: {folds: 2, grid: {hierarchy.levels.0.count: [1, 2]}}
rollout: {episodes: 4}
seed: 3
"""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("fuzz") / "demos.hdf5"
    demonstrations(6).write(path)
    return yaml.safe_load(SPEC.replace("PATH", str(path)))


def check_specs(base: dict[str, Any], path: Path, seeds: range) -> None:
    ended = {0: 0, 2: 0}
    for seed in seeds:
        path.write_bytes(damaged_spec(base, seed))
        start = time.process_time()
        found = call("check", path)
        assert found.status in ended, f"seed {seed}: {found.err}"
        assert time.process_time() - start < SECONDS, f"seed {seed}"
        assert found.status == 0 or all(line.startswith("ddco-pyro: ") for line in found.err.splitlines()), seed
        assert (found.err == "") == (found.status == 0), f"seed {seed}: {found.err}"
        ended[found.status] += 1
    print(f"{len(seeds)} damaged specs: {ended[0]} read, {ended[2]} refused")
    assert min(ended.values()) > 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2 * 2**20


def check_files(folder: Path, seeds: range) -> None:
    worker, ended = Worker(), Counter[str]()
    try:
        for seed in seeds:
            path = folder / f"{seed}.hdf5"
            damaged_file(path, seed)
            found = worker.try_file(path)
            assert set(found) <= {"fine", "refused"}, f"seed {seed}: {found}"
            ended.update(found)
            path.unlink()
    finally:
        worker.close()
    print(f"{len(seeds)} damaged files, each read, looked at and imported: {dict(ended)}")
    assert set(ended) == {"fine", "refused"}


def test_damaged_specs(base: dict[str, Any], tmp_path: Path) -> None:
    check_specs(base, tmp_path / "spec.yaml", range(20))


def test_damaged_files(tmp_path: Path) -> None:
    check_files(tmp_path, range(12))


@pytest.mark.slow
def test_very_many_damaged_specs(base: dict[str, Any], tmp_path: Path) -> None:
    check_specs(base, tmp_path / "spec.yaml", range(1000, 2200))


@pytest.mark.slow
def test_very_many_damaged_files(tmp_path: Path) -> None:
    check_files(tmp_path, range(1000, 1500))
