"""The worked example: a task, a network and labels of one's own in one spec."""

from pathlib import Path

import torch
from ddco_tasks.example import task
from ddco_tasks.example_network import Radial

import ddco_pyro
from ddco_pyro.model.networks import Inputs, InputShape
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import load_spec

SPEC = Path(__file__).parents[2] / "specs" / "example.yaml"


def test_the_spec_fits_and_acts(cache: Path, tmp_path: Path) -> None:
    small = ["demonstrations.count=8", "training.epochs=6", "compare_with=[]"]
    found = ddco_pyro.fit(load_spec(SPEC, small, allow_code=True), out=tmp_path / "run")
    assert found.metrics.engine_check.value < 1e-6
    trunk = found.hierarchy.trunk
    assert isinstance(trunk.module, Radial)
    assert (trunk.features, trunk.module.width) == (32, 2.0)
    episode = run_episode(task, found.controller(), 0)
    assert len(episode.record) > 0


def test_a_centre_is_near_itself() -> None:
    network = Radial(InputShape({"place": 3}, {}, 2), 4, 2, width=0.5)
    place = network.centres[0, 1].detach()[None, None] + torch.tensor([0.5, 0, 0])
    inputs = Inputs({"place": place}, {}, torch.zeros(1))
    found = network(inputs)
    assert found.shape == (1, 1, 2, 4)
    torch.testing.assert_close(found[0, 0, 0, 1], torch.tensor(-0.5).exp())
