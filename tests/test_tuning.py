"""What of the tuning demonstrations decides: their mean, or their median, which one odd demonstration cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import CONTROL, make_spec, make_trainer, make_truth, plant

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.inference import log_likelihood
from ddco_pyro.training.checkpoint import Progress
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.stages import plan

LEARNT = {"std": {"learn": True, "floor": 0.01}, "scale": "none"}
TRAINING = {"epochs": 200, "patience": 10, "initialize": "vq_controls"}


@pytest.fixture(scope="module")
def planted():
    """30 demonstrations of 30 steps of two options."""
    return plant(make_truth(make_spec((2,), control=CONTROL)), 30, 30, seed=1)[0]


def cut(demos):
    """The same with lengths of their own."""
    each = (replace(demo, observations={"state": demo.observations["state"][: 9 + n]}, actions=demo.actions[: 9 + n])
            for n, demo in enumerate(demos))  # fmt: skip
    return Demonstrations(tuple(each))


def odd(demos, name):
    """The same, but for a demonstration whose control goes the other way, three times as far."""
    return Demonstrations(
        tuple(replace(demo, actions=-3 * demo.actions) if demo.name == name else demo for demo in demos)
    )


def per_step(model, batch):
    with torch.no_grad():
        return float(log_likelihood(model.tabulate(batch), batch.lengths).sum()) / batch.steps


@pytest.mark.parametrize("number", [25, 30])
def test_the_median_is_over_demonstrations_and_per_step_of_each(planted, tmp_path, number):
    """Of five, and of six."""
    spec = make_spec((2,), tune_by="median")
    material = make_trainer(spec, cut(planted.select(planted.names[:number])), tmp_path).data
    model, batch = material.hierarchy(0), material.tune
    assert len(batch) == number // 5
    with torch.no_grad():
        values = (log_likelihood(model.tabulate(batch), batch.lengths) / batch.lengths).numpy()
    assert Objective(material, Progress(0), plan(spec, 1)[-1]).tune(model) == pytest.approx(np.median(values))
    assert abs(np.median(values) - float(values @ batch.lengths.numpy() / batch.steps)) > 1e-3


def test_an_odd_demonstration_among_six_does_not_stop_training(planted, tmp_path):
    """With the mean it does: the better the others are known, the less likely it is."""
    _, tune = planted.split(0.2, 0)
    demos, kept = odd(planted, tune[0].name), {}
    for tune_by in ("mean", "median"):
        trainer = make_trainer(make_spec((2,), control=LEARNT, tune_by=tune_by, **TRAINING), demos, tmp_path / tune_by)
        assert tune[0].name not in trainer.data.names
        kept[tune_by] = per_step(trainer.run(), trainer.data.train)
    assert kept["median"] > kept["mean"] + 0.5
