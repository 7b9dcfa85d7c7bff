"""Where the next skill is hidden from what is seen, options that last succeed and a mixture does not.

The supervisor moves one way or the other on a line, 1 or -1: this is its *intention*, which the observation
``seen`` does not tell. In the control case the observation ``intention`` tells it, and the two are equal.
Clusters are of observations and controls, since those of observations cannot tell apart what looks alike.
Seeds are those that the library counts from by default; none is chosen for what it gives.
"""

from functools import cache, partial
from pathlib import Path

import dm_env
import numpy as np
import yaml
from dm_env import specs
from scipy import stats

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import Task
from ddco_pyro.spec import parse_spec
from ddco_pyro.statistics import paired_difference, rate

SHAKING = 0.15  # of the supervisor's hand, beside a control of 1 or -1
STEPS, SPEED = 30, 0.125


class ThereAndBack(dm_env.Environment):
    """To the far end at 1 and back to 0, where the episode ends; position is seen, velocity is not."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def reset(self) -> dm_env.TimeStep:
        self.time, self.position, self.direction, self.been_there = 0, self.random.uniform(0.0, 0.1), 1, False
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.time += 1
        self.position += SPEED * float(np.clip(action[0], -2, 2))
        self.been_there |= self.position > 0.9
        self.direction = -1 if self.position > 1 else self.direction
        if self.arrived or self.time == STEPS:
            return dm_env.termination(float(self.arrived), self._observation())
        return dm_env.transition(0.0, self._observation())

    @property
    def arrived(self) -> bool:
        return self.been_there and self.position < 0

    def odds(self) -> float:
        """How often the supervisor's direction is 1 where it sees what is seen now."""
        return 1.0 if self.position < 0 else 0.0 if self.position > 1 else 0.5

    def _observation(self) -> dict[str, np.ndarray]:
        return {"seen": np.array([self.position]), "intention": np.array([float(self.direction)])}

    def observation_spec(self) -> dict[str, specs.Array]:
        return {name: specs.Array((1,), float, name) for name in ("seen", "intention")}

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((1,), float, -2.0, 2.0, "velocity")


class Supervisor:
    """Moves as it intends to, with a hand that shakes.

    :param forgetful: it draws its intention anew at every step, about as often as the supervisor has it where
        it sees what is seen. It knows both moves exactly, and lacks memory alone.
    """

    def __init__(self, environment: ThereAndBack, forgetful: bool = False) -> None:
        self.environment, self.forgetful = environment, forgetful

    def reset(self, seed: int) -> None:
        self.random = np.random.default_rng([seed, 1])

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        direction = self.environment.direction
        if self.forgetful:
            direction = 1 if self.random.random() < self.environment.odds() else -1
        return direction + SHAKING * self.random.normal(size=1)


there_and_back = Task(
    name="there and back",
    load=ThereAndBack,
    policies={"supervisor": Supervisor, "forgetful": partial(Supervisor, forgetful=True)},
    outcome=lambda ended: {"success": float(ended.arrived)},
    frame=lambda environment: np.zeros((48, 64, 3), np.uint8),
    sources=(Path(__file__),),
    steps=STEPS,
)

SPEC = """
task: {task}
demonstrations: {{count: 40, valid_fraction: 0.25}}
observations: {observed}
control: {{std: {{learn: true}}}}
hierarchy:
  levels:
    - {{count: 2, policy: {{network: linear}}}}
  meta_policy: {{network: linear}}
compare_with: [mixture]
training:
  starts: [vq_controls]
  layerwise: false
  epochs: 40
  patience: null
  batch_size: 6
  optimizer: {{lr: 0.3, schedule: cosine}}
rollout: {{options: sample, episodes: 100}}
"""
UNLIKELY = 1e-3


@cache
def demonstrations():
    return Demonstrations(tuple(run_episode(there_and_back, "supervisor", seed).record for seed in range(40)))


def chance():
    """Successes of the supervisor whose intention is drawn anew at every step, in 300 episodes."""
    episodes = [run_episode(there_and_back, "forgetful", seed) for seed in range(2000, 2300)]
    return rate(int(sum(episode.outcome["success"] for episode in episodes)), len(episodes))


def fitted(observed):
    """The fit, and whether its options and the mixture succeed from the same starts."""
    spec = parse_spec(yaml.safe_load(SPEC.format(observed=observed, task=f"{__name__}:there_and_back")))
    fit = ddco_pyro.fit(spec, demonstrations())
    starts, played = range(1000, 1000 + spec.rollout.episodes), []
    for hierarchy in (fit.hierarchy, fit.baselines["mixture"].hierarchy):
        controller = Controller(hierarchy, spec.rollout.control, spec.rollout.options)
        played.append([run_episode(there_and_back, controller, seed).outcome["success"] for seed in starts])
    return fit, *played


def worth(fit):
    """What options that last are worth, held-out nats per step: the ends of the 95 % t interval."""
    found, held_out = fit.metrics.worth.memory, fit.metrics.demonstrations.valid
    half = found.standard_error * stats.t.ppf(0.975, held_out - 1)
    return found.nats_per_step - half, found.nats_per_step + half


def test_options_remember_what_a_mixture_cannot():
    """The mixture succeeds no more often than a binomial bound on what the supervisor does without memory."""
    fit, options, mixture = fitted(["seen"])
    by_chance = chance()
    low, _ = worth(fit)
    assert sum(options) >= 0.95 * len(options)
    most = stats.binomtest(by_chance.successes, by_chance.trials).proportion_ci(1 - 2 * UNLIKELY).high
    assert sum(mixture) <= stats.binom.isf(UNLIKELY, len(mixture), most)
    assert low > 0


def test_where_the_intention_is_seen_there_is_nothing_to_remember():
    fit, options, mixture = fitted(["seen", "intention"])
    low, high = worth(fit)
    assert sum(options) >= 0.95 * len(options)
    assert paired_difference(options, mixture).p_value > 0.05
    assert low <= 0 <= high
