"""How a task is found, and the toy task itself."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import gymnasium
import numpy as np
import pytest
import toy_task
from gymnasium import spaces

from ddco_pyro.errors import BadInput
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import Task, find_task
from ddco_pyro.spec.base import TASKS


def test_a_policy_sees_the_name_of_its_task():
    class Seeing:
        def reset(self, seed):
            self.seen = set()

        def act(self, observation):
            self.seen.add(observation["task"])
            return np.zeros(2)

    policy = Seeing()
    run_episode(toy_task.task, policy, 0)
    assert policy.seen == {toy_task.task.name}


def test_a_registered_task_whose_packages_are_missing_is_one_line(monkeypatch):
    point = EntryPoint("needs", "no_such_package.of_mine:task", TASKS)
    monkeypatch.setattr("ddco_pyro.simulation.task.entry_points", lambda group: [point])
    with pytest.raises(BadInput, match=r"^task 'needs' needs the package 'no_such_package', which"):
        find_task("needs")


NO_MODULE = "^task 'no_such_module:task' cannot be loaded: No module named 'no_such_module'$"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:task", NO_MODULE),
        ("toy_task:missing", "^task 'toy_task:missing' cannot be loaded: .*has no attribute 'missing'$"),
        (":task", "^task ':task' cannot be loaded: invalid format: ':task'$"),
        ("toy_task:SPEC", r"leads to a str, not to a ddco_pyro\.simulation\.task\.Task$"),
    ],
)
def test_a_task_that_cannot_be_found_says_why(name, message):
    with pytest.raises(BadInput, match=message):
        find_task(name)


def with_outcome(outcome, **measures):
    return replace(toy_task.task, outcome=lambda environment: outcome, measures=measures)


RATE = "and a rate is 0 or 1 in every episode; make it a"
OTHERS = r"its outcome has success, topples, and its measures are success, topple; declare all of them"


@pytest.mark.parametrize(
    ("outcome", "measures", "message"),
    [
        ({"success": 0.5}, {}, rf"^task 'toy': success is 0\.5, {RATE}"),
        ({"done": 2.0}, {"done": "rate"}, f"^task 'toy': done is 2, {RATE}"),
        ({"success": 1.0, "topples": 2.0}, {"success": "rate", "topple": "mean"}, f"^task 'toy': {OTHERS}"),
    ],
)
def test_an_outcome_that_is_not_what_was_declared_is_refused(outcome, measures, message):
    task = with_outcome(outcome, **measures)
    with pytest.raises(BadInput, match=message):
        task.measured(None)
    with pytest.raises(BadInput, match=message):
        run_episode(task, "supervisor", 0)


NO_MEAN = "task 'toy': success is a rate, by which methods are compared; call the mean otherwise"
NO_COUNT = "task 'toy': topples is declared a 'count'; it has to be a 'rate' or a 'mean'"


@pytest.mark.parametrize(
    ("measures", "message"), [({"success": "mean"}, NO_MEAN), ({"topples": "count"}, NO_COUNT)]
)
def test_a_wrong_declaration_is_refused(measures, message):
    with pytest.raises(BadInput) as caught:
        with_outcome({}, **measures)
    assert str(caught.value) == message


# --- Gymnasium environments as tasks ------------------------------------------------------------------------


class Line(gymnasium.Env):
    """A point on a line that has to come near 0."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, discrete=False, told=False, named=False, render_mode=None):
        self.discrete, self.told, self.named, self.render_mode = discrete, told, named, render_mode
        place, goal = spaces.Box(-9, 9, (1,), np.float32), spaces.Discrete(3)
        self.observation_space = spaces.Dict({"place": place, "goal": goal}) if named else place
        self.action_space = spaces.Discrete(3, start=-1) if discrete else spaces.Box(-1, 1, (1,), np.float32)

    def _seen(self):
        place = np.array([self.place], np.float32)
        return {"place": place, "goal": 1} if self.named else place

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(2, 3)
        return self._seen(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.place += float(np.ravel(action)[0])
        arrived = abs(self.place) < 0.6
        return self._seen(), -1.0, arrived, False, {"is_success": self.place > 0} if self.told else {}

    def render(self):
        return np.zeros((8, 8, 3), np.uint8) if self.render_mode else None


gymnasium.register("ddco-test/Line-v0", Line, max_episode_steps=10)


class Towards:
    """Goes to 0, faster than the action space allows."""

    def __init__(self, environment):
        assert isinstance(environment.gymnasium.unwrapped, Line)

    def reset(self, seed):
        pass

    def act(self, observation):
        return -5 * np.sign(observation["state" if "state" in observation else "place"])


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_an_environment_is_a_task(discrete, named):
    task = Task.from_gymnasium("ddco-test/Line-v0", {"supervisor": Towards}, discrete=discrete, named=named)
    assert task.steps == 10
    episode, again = (run_episode(task, "supervisor", 3) for _ in range(2))
    assert episode.outcome == {"success": 1.0, "return": -float(len(episode.record))}
    np.testing.assert_array_equal(episode.record.actions, again.record.actions)
    assert episode.record.observations.keys() == ({"place", "goal"} if named else {"state"})
    assert episode.record.observations["place" if named else "state"][0, 0] == pytest.approx(
        gymnasium.make("ddco-test/Line-v0").reset(seed=3)[0][0]
    )


def test_success_is_what_the_environment_says():
    task = Task.from_gymnasium("ddco-test/Line-v0", {"supervisor": Towards}, told=True)
    outcomes = {run_episode(task, "supervisor", seed).outcome["success"] for seed in range(8)}
    assert outcomes == {0.0, 1.0}


def test_an_episode_that_runs_out_of_time_is_no_success():
    class Away(Towards):
        def act(self, observation):
            return np.ones(1)

    episode = run_episode(Task.from_gymnasium("ddco-test/Line-v0", {"supervisor": Away}), "supervisor", 0)
    assert episode.outcome == {"success": 0.0, "return": -10.0}


def test_frames_need_a_render_mode():
    filmed = Task.from_gymnasium("ddco-test/Line-v0", {"supervisor": Towards}, render_mode="rgb_array")
    assert run_episode(filmed, "supervisor", 0, film=True).frames[0].shape == (8, 8, 3)
    line = Task.from_gymnasium("ddco-test/Line-v0", {"supervisor": Towards})
    with pytest.raises(BadInput, match="render_mode='rgb_array'"):
        run_episode(line, "supervisor", 0, film=True)


def test_what_cannot_be_a_task_is_refused():
    with pytest.raises(BadInput, match="nowhere"):
        Task.from_gymnasium("nowhere/Line-v0")

    class Sets(Line):
        def __init__(self, **options):
            super().__init__()
            self.action_space = spaces.MultiBinary(3)

    gymnasium.register("ddco-test/Sets-v0", Sets)
    with pytest.raises(BadInput, match="the action is a MultiBinary"):
        Task.from_gymnasium("ddco-test/Sets-v0")
