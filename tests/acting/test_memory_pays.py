"""Where the next skill is hidden from what is seen, options that last succeed and a memoryless mixture does not.

Two kinds of hidden intention (``memory_tasks``): the way there and back along one line, and a side of an obstacle that
is chosen at random and kept. In the control case the intention is observed, and the two are equal.

Clusters are of observations and controls, since those of observations cannot tell apart what looks alike. Options are
drawn (``sample``): only drawing reproduces a choice that the supervisor makes at random. Seeds are those that the
library counts from by default; none is chosen for what it gives.
"""

from __future__ import annotations

from functools import cache

import memory_tasks
import pytest
import yaml
from scipy import stats

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import parse_spec
from ddco_pyro.statistics import paired_difference, rate

SPEC = """
task: memory_tasks:{task}
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
def demonstrations(name):
    task = getattr(memory_tasks, name)
    return Demonstrations(tuple(run_episode(task, "supervisor", seed).record for seed in range(40)))


def chance(name):
    """Successes of the supervisor whose intention is drawn anew at every step, in 300 episodes."""
    task = getattr(memory_tasks, name)
    episodes = [run_episode(task, "forgetful", seed) for seed in range(2000, 2300)]
    return rate(int(sum(episode.outcome["success"] for episode in episodes)), len(episodes))


def fitted(name, observed):
    """The fit, and the outcomes of its options and of the mixture from the same starts."""
    spec = parse_spec(yaml.safe_load(SPEC.format(task=name, observed=observed)))
    fit = ddco_pyro.fit(spec, demonstrations(name))
    starts, task = range(1000, 1000 + spec.rollout.episodes), getattr(memory_tasks, name)
    played = []
    for hierarchy in (fit.hierarchy, fit.baselines["mixture"].hierarchy):
        controller = Controller(hierarchy, spec.rollout.control, spec.rollout.options)
        played.append([run_episode(task, controller, seed).outcome for seed in starts])
    return fit, *played


def worth(fit):
    """What options that last are worth, held-out nats per step: the ends of the 95 % t interval."""
    found, held_out = fit.metrics.worth.memory, fit.metrics.demonstrations.valid
    half = found.standard_error * stats.t.ppf(0.975, held_out - 1)
    return found.nats_per_step - half, found.nats_per_step + half


def successes(outcomes):
    return [outcome["success"] for outcome in outcomes]


@pytest.mark.parametrize("name", ["there_and_back", "obstacle"])
def test_options_remember_what_a_mixture_cannot(name):
    """The mixture succeeds no more often than a binomial bound on what the supervisor does without memory."""
    fit, options, mixture = fitted(name, ["seen"])
    ours, theirs = sum(successes(options)), sum(successes(mixture))
    by_chance = chance(name)
    low, _ = worth(fit)
    assert ours >= 0.95 * len(options)
    most = stats.binomtest(by_chance.successes, by_chance.trials).proportion_ci(1 - 2 * UNLIKELY).high
    assert theirs <= stats.binom.isf(UNLIKELY, len(mixture), most)
    assert low > 0
    if name == "obstacle":  # either side is passed, as in the demonstrations
        assert {outcome["side"] for outcome in options} == {-1.0, 1.0}


@pytest.mark.parametrize("name", ["there_and_back", pytest.param("obstacle", marks=pytest.mark.slow)])
def test_where_the_intention_is_seen_there_is_nothing_to_remember(name):
    fit, options, mixture = fitted(name, ["seen", "intention"])
    low, high = worth(fit)
    assert sum(successes(options)) >= 0.95 * len(options)
    assert paired_difference(successes(options), successes(mixture)).p_value > 0.05
    assert low <= 0 <= high
