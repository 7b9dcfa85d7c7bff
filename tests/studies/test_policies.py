"""Policies that a user would pick instead: what they learn of planted demonstrations, and how they act."""

import numpy as np
import pytest
import torch
from planted import small_spec

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.errors import BadInput
from studies import apart, arena_playing, policies
from studies.cells import Cell, Job

BRIEF = {"steps": 400, "hidden": [32, 32], "rate": 5e-3}


def demonstrations(*pairs):
    """Of observations and controls."""
    return Demonstrations(tuple(Demonstration(f"demo_{n}", *pair) for n, pair in enumerate(pairs)))


def trained(demos, kind, seed=0, **settings):
    return policies.fit(demos, policies.KINDS[kind].given({**BRIEF, **settings}), seed)


def acted(policy, observations, seed=0):
    policy.reset(seed)
    rows = (dict(zip(observations, row, strict=True)) for row in zip(*observations.values(), strict=True))
    return np.stack([policy.act(row) for row in rows])


@pytest.fixture(scope="module")
def curved():
    """Of two observations in odd units, a control that is their product, and one that never changes."""
    rng = np.random.default_rng(0)
    places = [rng.uniform(-1, 1, size=(2, 50, 1)) for _ in range(9)]
    return demonstrations(
        *(({"far": 1e3 * a + 5e3, "near": 1e-3 * b}, np.hstack([a * b, 0 * a + 7])) for a, b in places)
    )


@pytest.mark.parametrize("kind", ["bc", "chunks", "flow", "lstm"])
def test_a_planted_function_is_learned(curved, kind):
    train, unseen = curved[:8], curved[8]
    settings = {"hidden": [32], "batch": 100} if kind == "lstm" else {"chunk": 1, "executed": 1}
    given = acted(trained(Demonstrations(tuple(train)), kind, **settings), unseen.observations)
    assert np.abs(given[:, 0] - unseen.actions[:, 0]).mean() < {"flow": 0.15}.get(kind, 0.06)  # of 0.25
    np.testing.assert_allclose(given[:, 1], 7)


def test_a_flow_keeps_both_ways_where_the_error_is_least_between_them():
    rng = np.random.default_rng(0)
    ways = np.repeat(rng.choice([-1.0, 1.0], size=200), 4)[:, None]
    demos = demonstrations(*(({"x": np.zeros((4, 1))}, ways[n : n + 4]) for n in range(0, 800, 4)))
    same = {"x": np.zeros((200, 1))}
    flow = trained(demos, "flow", chunk=4, executed=4, history=1, hidden=[64, 64], steps=800)
    given = acted(flow, same).reshape(50, 4)
    assert np.mean(np.abs(np.abs(given) - 1) < 0.5) > 0.9
    assert 0.25 < np.mean(given > 0) < 0.75
    assert np.mean(np.sign(given) == np.sign(given[:, :1])) > 0.95  # one way for a whole chunk
    assert np.abs(acted(trained(demos, "bc"), same)).max() < 0.3


def test_an_lstm_remembers_a_cue():
    def shown(cue):
        observations = np.zeros((12, 1))
        observations[0] = cue
        return {"x": observations}, np.full((12, 1), cue)

    demos = demonstrations(*(shown(cue) for cue in [-1.0, 1.0] * 4))
    lstm = trained(demos, "lstm", hidden=[16], batch=48)
    bc = trained(demos, "bc", steps=200)
    for cue in (-1.0, 1.0):
        observations, actions = shown(cue)
        np.testing.assert_allclose(acted(lstm, observations), actions, atol=0.1)
        assert np.abs(acted(bc, observations)[1:]).max() < 0.3


def test_numpy_acts_as_the_network_of_torch(curved):
    """Without chunks, of all steps at once; a flow moves noise in ten steps."""
    seen = [policies.vector(demo, ["far", "near"]) for demo in curved]
    mean, std = np.mean(np.concatenate(seen), 0), np.std(np.concatenate(seen), 0)
    seen = torch.as_tensor((seen[0] - mean) / std, dtype=torch.float32)
    for kind in ("bc", "lstm", "flow"):
        settings = policies.KINDS[kind].given({"steps": 1, "chunk": 1, "executed": 1, "history": 1})
        policy = policies.fit(curved, settings, 3)
        network = policies.Network(settings, 2, 2)
        arrays = policy.controller.arrays
        network.load_state_dict({name: torch.as_tensor(one) for name, one in arrays.items() if "." in name})
        given = torch.as_tensor(np.random.default_rng(0).normal(size=(1, 2)), dtype=torch.float32)
        with torch.no_grad():
            if kind == "flow":
                for step in range(10):
                    t = torch.full((1, 1), step / 10)
                    given = given + network(torch.cat([seen[:1], given, policies.times(t, torch)], -1)) / 10
                wanted = given
            else:
                wanted = network(seen[None])[0]
        mean, std = arrays["done"]
        wanted = np.clip(wanted.numpy() * std + mean, *arrays["range"])
        np.testing.assert_allclose(acted(policy, curved[0].observations)[: len(wanted)], wanted, atol=1e-5)


@pytest.mark.parametrize("kind", policies.KINDS)
def test_equal_seeds_act_equally_and_a_written_policy_acts_as_the_trained_one(curved, kind, tmp_path):
    observations = {key: values[:20] for key, values in curved[0].observations.items()}
    one, two, other = (trained(curved, kind, seed, steps=5, hidden=[8]) for seed in (1, 1, 2))
    given = acted(one, observations)
    assert np.array_equal(given, acted(two, observations))
    assert np.array_equal(given, acted(one, observations))  # nothing is left of an episode
    assert not np.array_equal(given, acted(other, observations))
    assert (kind == "flow") != np.array_equal(given, acted(one, observations, seed=1))
    one.write(tmp_path)
    assert np.array_equal(given, acted(arena_playing.exported(tmp_path), observations))


def test_held_out_demonstrations_have_no_part(curved):
    masks = {"train": tuple(curved.names[:2]), "valid": tuple(curved.names[2:])}
    part = trained(Demonstrations(curved.demonstrations, masks), "bc", steps=5)
    alone = trained(Demonstrations(curved.demonstrations[:2]), "bc", steps=5)
    assert np.array_equal(acted(part, curved[5].observations), acted(alone, curved[5].observations))


class Told:
    """A controller of chunks of three: at time t it gives 10 t, 10 t + 1 and 10 t + 2 for three steps."""

    def reset(self, seed):
        self.time = -1

    def act(self, observation):
        self.time += 1
        return 10.0 * self.time + np.arange(3.0)


def test_chunks_of_actions_are_averaged_over_what_was_given_for_a_step():
    """By hand: step 2 was given 2 at time 0, 11 at time 1 and 20 at time 2; the oldest weighs most."""
    chunks, weights = arena_playing.Chunks(Told(), 3), np.exp([0, -0.01, -0.02])
    given = [[0.0], [1.0, 10.0], [2.0, 11.0, 20.0], [12.0, 21.0, 30.0]]
    for _ in range(2):  # nothing is left of an episode
        chunks.reset(0)
        acted = [float(chunks.act({})[0]) for _ in given]
        assert acted == pytest.approx([np.average(one, weights=weights[: len(one)]) for one in given])


def test_a_part_of_a_chunk_is_executed_before_the_next_one():
    chunks = arena_playing.Chunks(Told(), 3, executed=2)
    for _ in range(2):
        chunks.reset(0)
        assert [float(chunks.act({})[0]) for _ in range(5)] == [0, 1, 20, 21, 40]


class Here:
    """A simulator in this process: an episode sees the first demonstration, and misses it by ``error``."""

    def __init__(self, demo, folder):
        self.demo, self.folder = demo, folder

    def played(self, task, methods, first, episodes):
        methods["policy"].write(self.folder)
        errors = []
        for seed in range(first, first + episodes):
            found = acted(arena_playing.exported(self.folder), self.demo.observations, seed)
            errors.append(np.abs(found - self.demo.actions).max())
        each = [{"error": error, "seed": first + n} for n, error in enumerate(errors)]
        return {"episodes": {"policy": each}}


def test_a_world_trains_with_the_settings_of_a_cell_and_plays_what_it_wrote(tmp_path):
    """Linear controls, which linear options with chunks as control follow, as a perceptron's chunks do."""
    rng = np.random.default_rng(0)
    places = (np.cumsum(rng.normal(size=(20, 1)), 0) for _ in range(6))
    demos = demonstrations(*(({"x": x}, x * [[1.0, -2.0]]) for x in places))
    training = {"epochs": 60, "optimizer": {"name": "em"}}
    spec = small_spec(observations=["x"], control={"kind": "gaussian", "std": 0.1}, training=training)
    world, cell = apart.World(Here(demos[0], tmp_path)), Cell("test", "PushT", "", 6, 0)

    def measured(method, **settings):
        return world.methods[method](Job(cell, spec, demos, range(5, 8), tmp_path / method, settings))

    exact = measured("chunked", chunk=2, executed=1, **{"hierarchy.levels.0.count": 1})
    assert exact["seed"] == 6
    assert exact["error"] < 0.2 < 10 < np.abs(demos[0].actions).max()
    assert measured("chunks", **BRIEF, chunk=2, executed=1)["error"] < 1
    with pytest.raises(BadInput, match="no setting 'chunck'"):
        measured("chunks", chunck=2)
