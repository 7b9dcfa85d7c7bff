"""Episodes as recorded against the environment's own arithmetic; intervals and tests against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import toy_task
from scipy import stats
from toy_task import task

from ddco_pyro.metrics import Mean, Rate
from ddco_pyro.simulation.episodes import run_episode, run_episodes, summarize
from ddco_pyro.statistics import paired_difference, rate


class Noted:
    """A policy that keeps what it saw and did."""

    def __init__(self, controls):
        self.controls, self.seen, self.seeds = controls, [], []

    def reset(self, seed):
        self.seeds.append(seed)

    def act(self, observation):
        self.seen.append(observation)
        return self.controls[len(self.seen) - 1]


class Broken(Noted):
    def act(self, observation):
        raise ZeroDivisionError("a policy's defect")


def kept(made):
    """The task, keeping its environments in ``made``."""

    def load(seed):
        made.append(toy_task.Point(seed))
        return made[-1]

    return replace(task, load=load)


CONTROLS = np.random.default_rng(0).uniform(-0.5, 0.5, (toy_task.STEPS, 2))


def test_an_episode_records_what_was_seen_before_each_control():
    policy = Noted(CONTROLS)
    made = []
    record = run_episode(kept(made), policy, 3).record
    assert (policy.seeds, len(record), record.name) == ([3], toy_task.STEPS, "demo_3")
    np.testing.assert_array_equal(record.actions, CONTROLS)
    for t, observation in enumerate(policy.seen):
        for key, values in record.observations.items():
            np.testing.assert_array_equal(values[t], observation[key])
    steps = -np.diff(record.observations["offsets"][:, :2], axis=0)
    np.testing.assert_allclose(steps, toy_task.SPEED * CONTROLS[:-1])


def test_a_disturbed_policy_is_recorded_as_it_meant_to_act():
    class Disturbed(Noted):
        def act(self, observation):
            self.intended = super().act(observation)
            return self.intended + 0.5

    controls = np.zeros((toy_task.STEPS, 2))
    meant = run_episode(task, Disturbed(controls), seed=3).record
    done = run_episode(task, Noted(controls + 0.5), seed=3).record
    np.testing.assert_array_equal(meant.actions, 0.0)
    np.testing.assert_array_equal(meant.observations["offsets"], done.observations["offsets"])


def test_an_episode_ends_with_its_outcome():
    made = []
    episode = run_episode(kept(made), "supervisor", 3)
    (environment,) = made
    assert environment.closed
    assert len(episode.record) == environment.time < toy_task.STEPS
    assert episode.outcome == {"success": 1.0, "error": environment.distance(environment.goal)}
    assert episode.record.attributes == {"seed": 3, **episode.outcome}
    visited = episode.record.observations["visited"][:, 0]
    np.testing.assert_array_equal(episode.record.labels["phase"], visited)
    assert (episode.choices.shape, episode.frames) == ((len(episode.record), 0), [])


def test_what_a_policy_changes_afterwards_does_not_change_the_record():
    class Reusing(Noted):
        buffer = np.zeros(2)

        def act(self, observation):
            self.buffer += 0.1
            return self.buffer

    record = run_episode(task, Reusing([]), 0).record
    np.testing.assert_allclose(record.actions[:, 0], 0.1 * np.arange(1, len(record) + 1))


def test_a_film_has_a_frame_before_each_control_and_one_at_the_end():
    episode = run_episode(task, "supervisor", 0, film=True)
    assert len(episode.frames) == len(episode.record) + 1
    assert not np.array_equal(episode.frames[0], episode.frames[-1])


def test_the_environment_is_closed_even_when_the_policy_fails():
    made = []
    with pytest.raises(ZeroDivisionError):
        run_episode(kept(made), Broken([]), 0)
    assert made[0].closed


def test_parallel_episodes_are_the_serial_ones_in_order():
    seeds = [5, 1, 9, 2]
    parallel = list(run_episodes("toy_task:task", "supervisor", seeds, film=2, jobs=2))
    serial = [run_episode(task, "supervisor", seed) for seed in seeds]
    assert [episode.seed for episode in parallel] == seeds
    assert [bool(episode.frames) for episode in parallel] == [True, True, False, False]
    for one, other in zip(parallel, serial, strict=True):
        assert one.outcome == other.outcome
        np.testing.assert_array_equal(one.record.actions, other.record.actions)


# --- how sure one can be ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (1, 1), (0, 20), (20, 20), (13, 50), (199, 200)])
def test_a_rate_has_its_wilson_interval(successes, trials):
    found = rate(successes, trials)
    assert (found.successes, found.trials, found.rate) == (successes, trials, successes / trials)
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    np.testing.assert_allclose(found.interval, [expected.low, expected.high], atol=1e-12)


@pytest.mark.parametrize(
    ("only_ours", "only_theirs", "both"), [(0, 0, 5), (6, 1, 3), (1, 6, 3), (4, 4, 0), (12, 0, 0)]
)
def test_mcnemars_exact_p_value(only_ours, only_theirs, both):
    """Under equal chances the number of wins among the discordant pairs is binomial."""
    ours = [1.0] * only_ours + [0.0] * only_theirs + [1.0] * both + [0.0] * 2
    theirs = [0.0] * only_ours + [1.0] * only_theirs + [1.0] * both + [0.0] * 2
    discordant = only_ours + only_theirs
    found = paired_difference(ours, theirs)
    assert (found.only_ours, found.only_theirs, found.trials) == (only_ours, only_theirs, len(ours))
    expected = stats.binomtest(only_ours, discordant).pvalue if discordant else 1.0
    assert found.p_value == pytest.approx(expected)


def test_a_measure_leaves_out_the_episodes_it_does_not_apply_to():
    errors = {0.5: 1.0, math.nan: 0.0, 1.5: 1.0}
    outcomes = [{"success": success, "error": error} for error, success in errors.items()]
    found = summarize(task, [*outcomes, {"success": 1.0}])
    assert (found["success"].successes, found["success"].trials) == (3, 4)
    assert (found["error"].mean, found["error"].trials) == (1.0, 2)


def test_a_mean_has_students_interval():
    values = [0.5, 1.5, 2.5, 4.0]
    found = summarize(task, [{"error": value} for value in values])["error"]
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    np.testing.assert_allclose(found.interval, [low, high])
    assert found.std == pytest.approx(np.std(values, ddof=1))
    assert summarize(task, [{"error": 0.5}])["error"] == Mean(mean=0.5, std=None, trials=1, interval=None)


def test_a_measure_that_never_applies_is_unknown_and_of_its_own_kind():
    declared = replace(task, measures={"inserted": "rate", "error": "mean"})
    found = summarize(declared, [{"inserted": math.nan, "error": math.nan}] * 3)
    assert found["inserted"] == Rate(successes=0, trials=0, rate=None, interval=None)
    assert found["error"] == Mean(mean=None, std=None, trials=0, interval=None)
