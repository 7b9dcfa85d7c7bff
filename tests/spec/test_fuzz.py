"""Whatever is wrong with a spec or a file of demonstrations: one line and exit code 2, or a correct result.

Never a traceback, a hang, or more than 2 GB of memory. The long versions are slow tests.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml
from command_line import call
from fuzz import SECONDS, damaged_file, damaged_spec, tried
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
training: {starts: [vq, vq], epochs: 24, batch_size: 3, patience: 5, optimizer: {name: adam, lr: 1.0e-2}}
selection: {folds: 2, grid: {hierarchy.levels.0.count: [1, 2]}}
rollout: {episodes: 4}
seed: 3
"""


@pytest.mark.parametrize("seeds", [range(20), pytest.param(range(1000, 2200), marks=pytest.mark.slow)], ids=len)
def test_damaged_specs(tmp_path: Path, seeds: range) -> None:
    path, ended = tmp_path / "spec.yaml", {0: 0, 2: 0}
    demonstrations(6).write(tmp_path / "demos.hdf5")
    base = yaml.safe_load(SPEC.replace("PATH", str(tmp_path / "demos.hdf5")))
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


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(1000, 1500), marks=pytest.mark.slow)], ids=len)
def test_damaged_files(tmp_path: Path, seeds: range) -> None:
    ended = Counter[str]()
    for seed in seeds:
        path = tmp_path / f"{seed}.hdf5"
        damaged_file(path, seed)
        found = tried(path)
        assert set(found) <= {"fine", "refused"}, f"seed {seed}: {found}"
        ended.update(found)
        path.unlink()
    print(f"{len(seeds)} damaged files, each read, looked at and imported: {dict(ended)}")
    assert set(ended) == {"fine", "refused"}
