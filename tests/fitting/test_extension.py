"""A package outside the tree adds a network, a task and a level; the library is not touched."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import toy_task
from command_line import call
from joblib.externals.loky import get_reusable_executor

import ddco_pyro

PACKAGE = '''
"""A network and a task of one's own."""

import sys
from pathlib import Path

import torch

sys.path.append({tests!r})
import toy_task
from ddco_pyro.simulation.task import Task

task = Task("reach", toy_task.Point, {{"supervisor": toy_task.Supervisor}}, toy_task.outcome, toy_task.frame, (), 12)


class Bilinear(torch.nn.Module):
    """K quadratic forms of the features."""

    def __init__(self, shape, outputs, copies, rank=2):
        super().__init__()
        self.copies, self.outputs = copies, outputs
        self.left = torch.nn.Linear(shape.vector, copies * outputs * rank)
        self.right = torch.nn.Linear(shape.vector, copies * outputs * rank)

    def forward(self, inputs):
        product = self.left(inputs.vector) * self.right(inputs.vector)
        return product.unflatten(-1, (self.copies, self.outputs, -1)).sum(-1)
'''

SPEC = """
task: TASK
demonstrations: {count: 6, valid_fraction: 0.25}
observations: [offsets, visited]
hierarchy:
  levels:
    - {name: move, count: 2, policy: {network: "outside.parts:Bilinear", options: {rank: 3}}}
    - {name: leg, count: 2, policy: {network: linear}}
  meta_policy: {network: linear}
training: {epochs: 1, batch_size: 3}
rollout: {episodes: 1}
"""


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like one that packages are installed in, with a distribution that registers the task ``reach``."""
    site = tmp_path_factory.mktemp("site")
    package = site / "outside"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "parts.py").write_text(PACKAGE.format(tests=str(Path(toy_task.__file__).parent)))
    about = site / "outside-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[ddco_pyro.tasks]\nreach = outside.parts:task\n")
    return site


@pytest.fixture(autouse=True)
def installed(outside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(outside)
    monkeypatch.chdir(tmp_path)
    get_reusable_executor().shutdown(wait=True)  # processes from before do not know of the new package


@pytest.mark.parametrize("task", ["reach", "outside.parts:task"])
def test_all_three_are_checked(task: str) -> None:
    Path("spec.yaml").write_text(SPEC.replace("TASK", task))
    ended = call("check", "spec.yaml", "--allow-code")
    assert ended.status == 0, ended.err
    assert re.search(rf"hierarchy.levels.0.policy +│ +{2 * 2 * (5 + 1) * 2 * 2 * 3 // 2} ", ended.out)
    assert "hierarchy.levels.1.policy" in ended.out


def test_all_three_are_fitted_and_rolled_out() -> None:
    Path("spec.yaml").write_text(SPEC.replace("TASK", "reach"))
    ended = call("fit", "spec.yaml", "--out", "run", "--allow-code", "--set", "compare_with=[]")
    assert ended.status == 0, ended.err
    ended = call("rollout", "run", "--jobs", 1, "--allow-code")
    assert ended.status == 0, ended.err
    assert " of 1 (" in ended.out
    assert ddco_pyro.load("run", allow_code=True).spec.task == "reach"
