"""Every public function and class has an example that runs."""

import doctest
import inspect
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from random_demonstrations import numbered

import ddco_pyro

MINE = """
demonstrations: {path: mine.hdf5}
observations: [place]
control: {std: 0.5}
hierarchy:
  levels: [{count: 2, policy: {network: linear}, termination: {network: linear}}]
  meta_policy: {network: linear}
compare_with: [{kind: flat, policy: {network: linear}}]
training: {epochs: 12, optimizer: {lr: 0.05}}
"""
PUBLIC = [name for name in ddco_pyro.__all__ if name not in ("encoding", "inference")]
INFERENCE = ["log_likelihood", "most_likely_path", "posterior", "sample_paths", "segment"]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """The names in examples; the working folder holds ``mine.yaml``, ``mine.hdf5`` and ``runs/mine``."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("examples"))
    Path("mine.yaml").write_text(MINE)
    turn = np.repeat([[-2.0], [2.0]], 5, 0)
    places = np.random.default_rng(0).normal(size=(6, 10, 2))
    demos = numbered(({"place": place}, turn * place) for place in places)
    demos.write("mine.hdf5")
    fit = ddco_pyro.fit("mine.yaml", demos, out="runs/mine")
    yield {"ddco_pyro": ddco_pyro, "np": np, "demos": demos, "fit": fit}
    os.chdir(before)


@pytest.mark.parametrize("name", [*PUBLIC, *(f"inference.{name}" for name in INFERENCE)])
def test_the_example_runs(name, names):
    found = ddco_pyro
    for part in name.split("."):
        found = getattr(found, part)
    module = sys.modules[inspect.unwrap(found).__module__]
    examples = doctest.DocTestFinder().find(inspect.unwrap(found), name, module, extraglobs=names)
    assert examples[0].examples, f"{name} has no example"
    for example in examples:
        assert doctest.DocTestRunner().run(example).failed == 0
