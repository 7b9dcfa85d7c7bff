"""The arena without Meta-World: episodes of an exported controller, what is recorded, an expert's phases."""

import functools

import h5py
import numpy as np
import pytest
import torch
from planted import small_spec

from ddco_pyro.exporting import write_numpy
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from studies import arena_recording
from studies.arena_phases import Phases
from studies.arena_playing import exported, play


class World:
    """The state drifts with the control; success once its first number is above ``goal``, up to 30 steps."""

    def __init__(self, goal):
        self.goal = goal
        self.received, self.outcome = [], {}

    def reset(self, seed):
        self.state, self.time, self.received = np.random.default_rng(seed).normal(size=3), 0, []
        return {"state": self.state}

    def step(self, control):
        self.received.append(control)
        self.state = self.state + np.array([0.1, *0.2 * control])
        self.time += 1
        self.outcome = {"time": self.time}
        return {"state": self.state}, bool(self.state[0] > self.goal), self.time == 30


@pytest.fixture(scope="module")
def fitted():
    """Never trained: random networks, and controls of other units."""
    seen = [{"key": "state", "differences": True}]
    spec = small_spec((3,), {"network": "mlp"}, observations=seen, control={"std": 0.5})
    torch.manual_seed(0)
    hierarchy = Hierarchy(spec, Dimensions({"state": (3,)}, 2, 30))
    hierarchy.scaling.scale.copy_(torch.tensor([2.0, 0.5]))
    return Fit(spec, hierarchy.eval())


@pytest.fixture(scope="module")
def runner(fitted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    assert write_numpy(fitted, folder)
    return exported(folder)


@pytest.mark.parametrize(("goal", "success"), [(1.0, True), (1e9, False)])
def test_an_exported_controller_plays_as_its_fit_does(fitted, runner, goal, success):
    for seed in (3, 4):
        world, controller, observed, expected = World(goal), fitted.controller(), [], []
        observation, done, ended = world.reset(seed), False, False
        controller.reset(seed)
        while not (done or ended):
            observed.append(observation)
            expected.append(controller.act(observation))
            observation, done, ended = world.step(expected[-1])
        played = World(goal)
        steps = len(expected)
        assert play(runner, played, seed) == {"success": success, "steps": steps, "time": steps}
        assert (len(expected) < 30) == success
        np.testing.assert_allclose(played.received, expected, atol=1e-5)


def episode(seed):
    """Those of every third seed fail; observations named after what they are."""
    if seed % 3 == 2:
        return None
    steps = 4 + seed
    return {
        "actions": np.arange(steps)[:, None] % 6,
        "obs/body": np.arange(steps, dtype=np.float32)[:, None],
        "obs/instruction_4": np.zeros((steps, 2), np.float32),
        "obs/done": (np.arange(steps)[:, None] > 2).astype(np.float32),
        "labels/subgoal": np.array([-1] + [1] * (steps - 1)),
        "labels/mission": np.zeros(steps, int),
    }


def test_the_first_successes_are_recorded(tmp_path):
    path = tmp_path / "demos.hdf5"
    arena_recording.collect(path, "toy", episode, 4, 1)
    with h5py.File(path) as file:
        assert [group.attrs["seed"] for group in file["data"].values()] == [0, 1, 3, 4]
        assert list(file["mask/valid"]) == [b"demo_0"]
        assert list(file["mask/train"]) == [b"demo_1", b"demo_2", b"demo_3"]
        assert file["data/demo_2/dones"][()].tolist() == [False] * 6 + [True]
        assert file["data"].attrs["total"] == 4 + 5 + 7 + 8


class Expert:
    """Its methods are traced while it acts. Which of four return statements was reached is in the value."""

    @staticmethod
    def _desired_pos(x):
        def shifted(y):
            return y + 100  # not a return of the outer function

        if x < 0:
            place = [shifted(0), 0]
            return place
        elif x < 1:
            return [
                1,
                x,
            ]
        for number in (2, 3):
            if x < number:
                return [number, x]
        return [4, x]

    def get_action(self, x):
        self._desired_pos(-1)  # the last call counts
        return self._desired_pos(x)


@pytest.mark.parametrize(("x", "phase"), {-0.5: 0, 0.5: 1, 1.5: 2, 2.5: 2, 7.0: 3}.items())
def test_a_phase_is_the_return_statement_that_was_reached(x, phase):
    phases, expert = Phases(Expert._desired_pos), Expert()
    assert len(phases.lines) == 4
    assert phases.lines == sorted(phases.lines)
    value, reached = phases.of(expert.get_action, x)
    assert (value, reached) == (expert.get_action(x), phase)


def test_or_the_assignment_to_a_key():
    def get_action(x):
        action = {"move": 0, "grab": 0}
        if x < 0:
            action["move"] = 1
        elif x < 1:
            action["move"] = max(
                x,
                2,
            )
        action["grab"] = 1
        return action

    phases = Phases(get_action, "move")
    assert [phases.of(get_action, x)[1] for x in (-1, 0)] == [0, 1]
    with pytest.raises(LookupError):
        phases.of(get_action, 2)
    with pytest.raises(ValueError, match="has no assignment to 'other'"):
        Phases(get_action, "other")


def test_a_decorated_function_is_seen_through():
    @functools.cache
    def desired(x):
        if x:
            return [1]
        return [0]

    phases = Phases(desired)
    assert [phases.of(desired, x) for x in (True, False)] == [([1], 0), ([0], 1)]
