"""Where the next skill is hidden from what is seen, options that last succeed and a memoryless mixture does not.

The way there and back along one line (``memory_tasks``). In the control case the intention is observed, and the two
are equal. Clusters are of observations and controls, since those of observations cannot tell apart what looks alike.
Seeds are those that the library counts from by default; none is chosen for what it gives.
"""

from __future__ import annotations

from functools import cache

import yaml
from memory_tasks import there_and_back
from scipy import stats

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import parse_spec
from ddco_pyro.statistics import paired_difference, rate

SPEC = """
task: memory_tasks:there_and_back
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
    spec = parse_spec(yaml.safe_load(SPEC.format(observed=observed)))
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
