"""Training: stages, resuming bit for bit, refusing what is not finite, and planted hierarchies recovered."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.ahmm import choose, complete
from ddco_pyro.data import Dimensions, build_hierarchy
from ddco_pyro.demonstrations import Demonstration, Demonstrations
from ddco_pyro.encoding import encode
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.networks import Inputs
from ddco_pyro.spec import parse_spec
from ddco_pyro.training import Trainer, TrainingError, plan


def make_spec(counts=(2,), seed=0, control=None, **training):
    levels = [
        {"name": f"level-{d}", "count": k, "policy": {"network": "linear"}, "termination": {"network": "linear"}}
        for d, k in enumerate(counts, 1)
    ]
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["state"],
            "control": control or {"std": 0.1, "scale": "none"},
            "hierarchy": {"levels": levels, "meta_policy": {"network": "linear"}},
            "training": {"optimizer": {"lr": 0.03}, "epochs": 5, **training},
            "seed": seed,
        }
    )


def random_demonstrations(number=10, steps=8, seed=0):
    generator = np.random.default_rng(seed)
    return Demonstrations(
        tuple(
            Demonstration(f"demo_{n}", {"state": generator.normal(size=(steps, 3))}, generator.normal(size=(steps, 2)))
            for n in range(number)
        )
    )


def make_trainer(spec, demos, path, on_epoch=lambda row: None):
    train, tune = demos.split(0.2, 0)
    dimensions = Dimensions.of(demos)

    def make():
        hierarchy = build_hierarchy(spec, dimensions)
        hierarchy.encoder.fit(train)
        hierarchy.scaling.fit(train)
        return hierarchy

    first = make()
    batches = [encode(part, first.encoder, first.scaling) for part in (train, tune)]
    return Trainer(spec, make, batches[0], batches[1], path / "latest.safetensors", list(train.names), on_epoch)


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


def plant(truth, number, steps, seed):
    """Demonstrations and true choices from running the Pyro model forward in a plane that the control moves through."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    state = torch.rand(number, 2, generator=generator) * 2 - 1
    states, actions, choices, previous = [], [], [], None
    for t in range(steps):
        with torch.no_grad():
            outputs = truth(Inputs(state[:, None], {}, torch.tensor([t])))
            tables = outputs.tables(torch.zeros(number, 1, 2), truth.scaling.log_volume)
            previous = choose(t, complete(tables, torch.ones(number, dtype=torch.long)).steps()[0], previous)
            mean = outputs.decisions[0].mean[torch.arange(number), 0, previous[0] - 1]
        action = torch.normal(mean, outputs.decisions[0].std.expand_as(mean), generator=generator)
        states.append(state)
        actions.append(action)
        choices.append(torch.stack(previous, -1))
        state = (state + action).clamp(-1, 1)
    arrays = [torch.stack(part, 1).double().numpy() for part in (states, actions)]
    demos = Demonstrations(
        tuple(Demonstration(f"demo_{n}", {"state": arrays[0][n]}, arrays[1][n]) for n in range(number))
    )
    return demos, torch.stack(choices, 1)


def make_truth(spec, seed):
    """Options that each head for a corner of their own and end there; callers that prefer some by where they are."""
    truth = build_hierarchy(spec, Dimensions({"state": (2,)}, 2, 1))
    truth.encoder.requires_grad_(False)
    corners = torch.tensor([[0.8, 0.8], [-0.8, 0.8], [-0.8, -0.8], [0.8, -0.8]])
    with torch.no_grad():
        for number, level in enumerate(truth.levels):
            k = level.count
            if number == 0:
                level.policy.network.layers[0].weight[:] = -0.35 * torch.eye(2)
                level.policy.network.layers[0].bias[:] = 0.35 * corners[:k, None]
            else:
                level.policy.network.layers[0].weight.zero_()
                level.policy.network.layers[0].bias[:] = torch.tensor([[[4.0, 4, -4, -4]], [[-4, -4, 4, 4.0]]])
            level.termination.layers[0].weight.zero_()
            level.termination.layers[0].bias[:] = -1.7
        truth.meta_policy.network.layers[0].weight.zero_()
        truth.meta_policy.network.layers[0].bias.zero_()
    return truth.eval()


@pytest.mark.parametrize("counts", [(4,), (4, 2)])
def test_a_planted_hierarchy_is_recovered(tmp_path, counts):
    """Held-out log-likelihood within 2 % of the truth's own, and segments that agree with the true options."""
    control = {"std": 0.05, "scale": "none"}
    spec = make_spec(counts, control=control, epochs=150, restarts=3, patience=25, initialize="vq_controls")
    truth = make_truth(spec, 0)
    demos, _ = plant(truth, 80, 40, seed=1)
    held_out, choices = plant(truth, 40, 40, seed=2)
    found = make_trainer(spec, demos, tmp_path).run()
    values = {}
    for name, model in (("found", found), ("truth", truth)):
        with torch.no_grad():
            batch = encode(held_out, model.encoder, model.scaling)
            tables = model.tabulate(batch)
            values[name] = float(log_likelihood(tables, batch.lengths).sum()) / batch.steps
            segments = segment(tables, batch.lengths)
        values[f"{name} nmi"] = normalized_mutual_info_score(choices[..., 0].flatten(), segments[0].flatten())
    assert values["found"] > values["truth"] - 0.02 * abs(values["truth"]), values
    assert values["found nmi"] > 0.95, values
