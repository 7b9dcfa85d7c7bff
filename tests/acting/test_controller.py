"""The controller against hand-set weights, the model's own means, and marginals of latents by enumeration."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hierarchies import make_hierarchy
from oracle import brute_force
from scipy import stats

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.model.batch import encode

STATE = {"state": np.array([0.5, -1.0, 2.0])}
STD = 0.3
SELDOM = -100.0  # a logit, which the hierarchy bounds
P_VALUE = 1e-3
make = partial(make_hierarchy, network="linear", std=STD)


def fix(network, values):
    """Make a linear network say ``values`` [K, outputs] whatever it sees."""
    with torch.no_grad():
        network.layers[0].weight.zero_()
        network.layers[0].bias.copy_(torch.tensor(np.array(values), dtype=torch.float32).unsqueeze(1))


def by_hand(means, psi, eta, emits=("options",)):
    """One level: option means, termination logits and the meta-policy's outputs, the same in every state."""
    hierarchy = make((len(means),), emits)
    fix(hierarchy.levels[0].policy.network, means)
    fix(hierarchy.levels[0].termination, [[value] for value in psi])
    fix(hierarchy.meta_policy.network, [eta])
    return hierarchy


def logit(probability):
    return float(np.log(probability / (1 - probability)))


MEANS = [[1.0, -1.0], [2.0, -2.0], [3.0, -3.0]]


def play(controller, steps):
    """Choices of the lowest level and controls over some steps in one state."""
    played = [(controller.act(STATE), controller.choices[0]) for _ in range(steps)]
    return [choice for _, choice in played], np.array([control for control, _ in played])


def without_controls(hierarchy, states):
    """What enumeration of all paths says of the latents where no control is seen."""
    demos = Demonstrations((Demonstration("demo_0", {"state": states}, np.zeros((len(states), 2))),))
    with torch.no_grad():
        tables = hierarchy.tabulate(encode(demos, hierarchy.encoder, hierarchy.scaling))
    unseen = tuple(torch.where(density.isfinite(), 0.0, density) for density in tables.control)
    return brute_force(replace(tables, control=unseen), 0, len(states))


@pytest.mark.parametrize("seed", range(5))
def test_an_option_that_does_not_end_stays(seed):
    choices, controls = play(Controller(by_hand(MEANS, [SELDOM] * 3, [0, 0, 0]), seed=seed), 30)
    assert len(set(choices)) == 1
    np.testing.assert_allclose(controls, [MEANS[choices[0] - 1]] * 30)


def test_most_likely_takes_the_mode_of_every_choice():
    """η prefers option 2 in the beginning; an option ends where ψ is above one half."""
    staying = by_hand(MEANS, [logit(0.49)] * 3, [0.0, 0.1, 0.05])
    assert set(play(Controller(staying, options="most_likely"), 20)[0]) == {2}
    controller = Controller(staying, options="most_likely")
    play(controller, 1)
    fix(staying.meta_policy.network, [[1.0, 0.0, 0.0]])
    assert play(controller, 2)[0] == [2, 2]
    fix(staying.levels[0].termination, [[logit(0.51)]] * 3)
    assert play(controller, 2)[0] == [1, 1]


@pytest.mark.parametrize("seed", range(4))
def test_marginal_takes_the_choice_that_is_likeliest_given_all_observations(seed):
    hierarchy = make((4,), ("options", "control"), seed=seed)
    states = 2 * torch.randn(4, 3, generator=torch.Generator().manual_seed(seed)).numpy()
    controller = Controller(hierarchy, options="marginal")
    for steps in range(1, 5):
        controller.act({"state": states[steps - 1]})
        truth = without_controls(hierarchy, states[:steps])
        assert controller.choices == (truth.u[0][steps - 1].argmax(),)


def test_marginal_adds_up_over_steps_how_likely_it_is_that_an_option_has_ended():
    """Option 2 is begun with, ends with a probability of 0.3 a step, and only option 1 is selected then."""
    hierarchy = by_hand(MEANS, [SELDOM, logit(0.3), SELDOM], [0.0, 50.0, 0.0])
    controllers = [Controller(hierarchy, options=options) for options in ("most_likely", "marginal")]
    played = [play(controller, 1)[0] for controller in controllers]
    fix(hierarchy.meta_policy.network, [[50.0, 0.0, 0.0]])
    expected = [[2, 2, 2, 2], [2, 2, 1, 1]]  # 0.7, then 0.49
    pairs = zip(played, controllers, strict=True)
    assert [first + play(controller, 3)[0] for first, controller in pairs] == expected


ONE = ((2,), ("options",))


@pytest.mark.parametrize(
    ("counts", "emits", "network"),
    [(*ONE, "linear"), ((2, 2), ("options", "control"), "linear"), (*ONE, "lstm")],
)
def test_choices_follow_the_models_latents(counts, emits, network):
    """Over many episodes of three different states, p(h_t) is that of the AHMM without any control seen."""
    hierarchy = make(counts, emits, network=network, seed=3)
    states = torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).numpy()
    truth = without_controls(hierarchy, states)
    controller, episodes = Controller(hierarchy), 200
    last = []
    for seed in range(episodes):
        controller.reset(seed)
        for state in states:
            controller.act({"state": state})
        last.append(controller.choices)
    for level, row in enumerate(truth.u):
        possible = row[2] > 0
        observed = np.bincount([choices[level] for choices in last], minlength=len(possible))
        assert not observed[~possible].any()
        assert stats.chisquare(observed[possible], episodes * row[2][possible]).pvalue > P_VALUE


def test_choice_0_executes_the_meta_policys_mean():
    hierarchy = by_hand(MEANS, [SELDOM] * 3, [100.0, 0, 0, 0, 7.0, 8.0], emits=("options", "control"))
    controller = Controller(hierarchy)
    choices, controls = play(controller, 10)
    assert set(choices) == {0}
    np.testing.assert_allclose(controls, [[7.0, 8.0]] * 10)
    fix(hierarchy.meta_policy.network, [[-100.0, 0, 0, 100, 7.0, 8.0]])  # control lasts one step
    choices, controls = play(controller, 2)
    assert choices == [3, 3]
    np.testing.assert_allclose(controls, [MEANS[2]] * 2)


@pytest.mark.parametrize(
    ("top", "middle", "choices", "control"),
    [
        ([-100, 0, 100, 50, 50], [-100, 100, 0, 40, 40], (1, 2), [1, -1]),
        ([-100, 0, 100, 50, 50], [100, 0, 0, 40, 40], (0, 2), [40, 40]),
        ([100, 0, 0, 50, 50], [-100, 100, 0, 40, 40], (0, 0), [50, 50]),
    ],
)
def test_the_lowest_option_acts(top, middle, choices, control):
    hierarchy = make((2, 2), ("options", "control"))
    fix(hierarchy.levels[0].policy.network, MEANS[:2])
    fix(hierarchy.levels[1].policy.network, [[100, 0, 0, 30, 30], middle])
    fix(hierarchy.meta_policy.network, [top])
    controller = Controller(hierarchy)
    np.testing.assert_allclose(controller.act(STATE), control)
    assert controller.choices == choices


def test_a_sample_has_the_models_deviation():
    hierarchy = by_hand([[1.0, -1.0]], [SELDOM], [0])
    hierarchy.scaling.scale.copy_(torch.tensor([10.0, 0.1]))
    _, controls = play(Controller(hierarchy, control="sample"), 400)
    standard = (controls / [10.0, 0.1] - [1.0, -1.0]) / STD
    for dimension in standard.T:
        assert stats.kstest(dimension, "norm").pvalue > P_VALUE
    assert abs(np.corrcoef(standard.T)[0, 1]) < 0.2


def test_equal_seeds_give_equal_episodes_and_leave_the_global_randomness_alone():
    hierarchy = by_hand(MEANS, [0.0] * 3, [0, 0, 0])
    torch.manual_seed(0)
    before = torch.get_rng_state()
    controller = Controller(hierarchy, control="sample", seed=4)
    choices, controls = play(controller, 15)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(1)
    controller.reset(5)
    assert not np.array_equal(play(controller, 15)[1], controls)
    controller.reset(4)
    again = play(controller, 15)
    assert again[0] == choices
    np.testing.assert_array_equal(again[1], controls)


def test_what_the_networks_do_not_see_is_ignored():
    one, other = Controller(make()), Controller(make())
    np.testing.assert_array_equal(one.act(STATE), other.act(STATE | {"noise": np.array([np.nan])}))
