"""Training: stages, resuming bit for bit, refusing what is not finite, and planted hierarchies recovered."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from planted import CONTROL, TRAINING, make_spec, make_trainer, make_truth, plant, recovered

from ddco_pyro.demonstrations import Demonstration, Demonstrations
from ddco_pyro.training import TrainingError, plan


def random_demonstrations(number=10, steps=8, seed=0):
    generator = np.random.default_rng(seed)
    return Demonstrations(
        tuple(
            Demonstration(f"demo_{n}", {"state": generator.normal(size=(steps, 3))}, generator.normal(size=(steps, 2)))
            for n in range(number)
        )
    )


@pytest.mark.parametrize(
    ("training", "depth", "names"),
    [
        ({}, 1, ["vq-1", "level-1", "meta-policy", "joint"]),
        ({}, 2, ["vq-1", "level-1", "vq-2", "level-2", "meta-policy", "joint"]),
        ({"initialize": "random"}, 2, ["level-1", "level-2", "meta-policy", "joint"]),
        ({"lower_levels": "frozen"}, 1, ["vq-1", "level-1", "meta-policy"]),
        ({"layerwise": False}, 2, ["vq-1", "vq-2", "joint"]),
        ({"layerwise": False, "initialize": "random"}, 3, ["joint"]),
        ({}, 0, ["policy"]),
    ],
)
def test_stages_go_from_the_lowest_level_up(training, depth, names):
    assert [stage.name for stage in plan(make_spec(**training), depth)] == names


@pytest.mark.parametrize("optimizer", ["adam", "momentum"])
def test_resuming_gives_the_same_bits(tmp_path, optimizer):
    spec = make_spec((2, 2), optimizer={"name": optimizer, "lr": 0.01}, restarts=2, epochs=3)
    demos = random_demonstrations()
    whole = make_trainer(spec, demos, tmp_path / "whole")
    expected = whole.run().state_dict()
    rows = len(whole.progress.history)
    assert rows == 2 * 6 * 3
    for stop in range(1, rows, 4):
        folder = tmp_path / f"stop-{stop}"
        seen = []

        def interrupt(row, seen=seen, stop=stop):
            seen.append(row)
            if len(seen) == stop + 1:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            make_trainer(spec, demos, folder, interrupt).run()
        resumed = make_trainer(spec, demos, folder)
        found = resumed.run().state_dict()
        assert resumed.progress.history == whole.progress.history
        assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_frozen_levels_stay_as_they_were_discovered(tmp_path):
    snapshots = {}
    spec = make_spec((2,), lower_levels="frozen")
    trainer = make_trainer(spec, random_demonstrations(), tmp_path)

    def keep(row):
        snapshots[row["stage"]] = {name: t.clone() for name, t in trainer._saved["best"].items()}

    trainer.on_epoch = keep
    final = trainer.run().state_dict()
    lower = [name for name in final if name.startswith("levels.")]
    meta = [name for name in final if name.startswith("meta_policy.network")]
    assert all(torch.equal(final[name], snapshots["level-1"][name]) for name in lower)
    assert any(not torch.equal(final[name], snapshots["level-1"][name]) for name in meta)


def test_both_engines_train_to_the_same_model(tmp_path):
    demos = random_demonstrations(6, 5)
    states = []
    for engine in ("fused", "enumerate"):
        spec = make_spec((2,), epochs=2, control={"std": 1.0})
        spec = spec.model_copy(update={"inference": spec.inference.model_copy(update={"engine": engine})})
        states.append(make_trainer(spec, demos, tmp_path / engine).run().state_dict())
    for name, value in states[0].items():
        torch.testing.assert_close(states[1][name], value, rtol=1e-3, atol=1e-5)


def test_what_is_not_finite_names_the_demonstration(tmp_path):
    demos = random_demonstrations()
    bad = [Demonstration(d.name, d.observations, d.actions * (1e200 if d.name == "demo_0" else 1.0)) for d in demos]
    train, _ = demos.split(0.2, 0)
    assert "demo_0" in train.names
    with pytest.raises(TrainingError, match=r"demo_0 is not finite"):
        make_trainer(make_spec(), Demonstrations(tuple(bad)), tmp_path).run()


# --- planted hierarchies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [(4,), (4, 2)])
def test_a_planted_hierarchy_is_recovered(tmp_path, counts):
    """Held-out log-likelihood within 2 % of the truth's own, and segments that agree with the true options."""
    spec = make_spec(counts, control=CONTROL, **TRAINING)
    truth = make_truth(spec)
    demos, _ = plant(truth, 80, 40, seed=1)
    values = recovered(make_trainer(spec, demos, tmp_path).run(), truth, *plant(truth, 40, 40, seed=2))
    assert values["found"] > values["truth"] - 0.02 * abs(values["truth"]), values
    assert values["found nmi"][0] > 0.95, values
