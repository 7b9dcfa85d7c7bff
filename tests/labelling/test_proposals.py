"""Proposals given what a person has said: against every path, one by one, and against planted options."""

import itertools

import numpy as np
import pytest
import torch
from oracle import paths
from planted import in_units_of, make_spec, make_truth, plant

import ddco_pyro
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.proposals import Proposals, weight
from ddco_pyro.labelling.refitting import refit
from ddco_pyro.labelling.session import Session

LEVEL = "level-1"


def planted(number, steps, counts=(3,), seed=0, ending=-1.7):
    """A fit that is the truth, its demonstrations, and the true option of each step of the lowest level."""
    spec = make_spec(counts)
    truth = make_truth(spec, ending)
    demos, choices = plant(truth, number, steps, seed)
    options = {demo.name: rows[:, 0].numpy() for demo, rows in zip(demos, choices, strict=True)}
    return Fit(spec, truth), demos, options


def free(demos):
    return {demo.name: np.full(len(demo), -1) for demo in demos}


@pytest.mark.parametrize(("counts", "level"), [((3,), 1), ((2, 2), 1), ((2, 2), 2)])
def test_it_is_the_sum_over_the_paths_that_have_the_labels_with_a_regression_of_named_steps(counts, level):
    fit, demos, _ = planted(4, 4, counts)
    labels = free(demos)
    labels["demo_0"][:] = [1, -1, 2, counts[level - 1]]
    labels["demo_1"][3] = 1
    proposals = Proposals(fit, demos, level, labels, counts[level - 1])
    (piece,), (tables,) = proposals.infer(demos.names, labels), proposals.alone
    ratio = weight(1.0) * proposals.learned.windows.log_ratio(proposals.features[0])
    assert level == 2 or ratio.abs().max() > 0.1  # it says something
    sizes = [1 + count for count in counts]
    for n, demo in enumerate(demos):
        known = labels[demo.name]
        expected, best, whole = np.zeros((4, sizes[level - 1])), (0.0, ()), 0.0
        for path, _, probability in paths(tables, n, 4, sizes):
            own = np.array(path)[:, level - 1]
            said = [(h, label) for h, label in zip(own, known, strict=True) if label >= 0]
            if any(proposals.options[h] != label for h, label in said):
                continue
            p = probability * float(ratio[n, torch.arange(4), torch.as_tensor(own)].sum().exp())
            expected[np.arange(4), own] += p
            whole += p
            best = max(best, (p, tuple(own)))
        np.testing.assert_allclose(piece.posterior.u[level - 1][n, :4].numpy(), expected / whole, atol=1e-6)
        shown = proposals.shown(demo.name, labels[demo.name])
        assert all(label < 0 or option == label for option, label in zip(shown.options, known, strict=True))
        np.testing.assert_array_equal(shown.probability[known > 0], 1.0)
        if len(counts) == 1:  # of several levels the path is of all of them
            np.testing.assert_array_equal(shown.options, proposals.options[list(best[1])])


@pytest.mark.parametrize("order", [*itertools.permutations((1, 2, 3))])
def test_one_named_demonstration_numbers_the_options_of_the_others(order):
    fit, demos, truth = planted(8, 40)
    mine = {name: np.array([0, *order])[own] for name, own in truth.items()}
    named = next(name for name in demos.names if len(np.unique(mine[name])) == 3)
    labels = free(demos) | {named: mine[named]}
    proposals = Proposals(fit, demos, 1, labels, 3)
    others = [name for name in demos.names if name != named]
    right = np.concatenate([proposals.shown(name).options == mine[name] for name in others])
    assert right.mean() > 0.95
    assert proposals.number(free(demos)) == (order != (1, 2, 3))  # undone
    assert proposals.options.tolist() == [0, 1, 2, 3]


def test_another_model_keeps_the_numbers_that_were_shown():
    fit, demos, truth = planted(8, 40)
    before = {name: np.array([0, 3, 1, 2])[own] for name, own in truth.items()}
    proposals = Proposals(fit, demos, 1, free(demos), 3, before)
    assert proposals.options.tolist() == [0, 3, 1, 2]


def test_the_runs_options_get_the_names_of_those_that_they_stand_for(tmp_path):
    _, demos, truth = planted(8, 40)
    path = tmp_path / "demos.hdf5"
    demos.write(path)
    fit = begun(demos, 3, starts=["vq_controls"] * 3)
    named = next(name for name in demos.names if len(np.unique(truth[name])) == 3)
    session = Session(fit, path, tmp_path / "out.hdf5")
    for option, text in ((1, "here"), (3, "there")):
        session.edit({"do": "rename", "option": option, "text": text})
    (segments,) = fit.segment(demos)
    own, true = np.concatenate([*segments]), np.concatenate([*truth.values()])
    stands = [np.bincount(true[own == option]).argmax() for option in (1, 2, 3)]
    mine = np.array([0, *np.roll(stands, 1)])  # numbers that the fit does not have
    assert fit.names[LEVEL][1:] == ("here", "option 2", "there")
    for start in range(40):
        option = int(np.flatnonzero(mine == truth[named][start])[0])
        span = {"demo": demos.names.index(named), "start": start, "stop": start + 1}
        session.edit({"do": "paint", **span, "option": option})
    assert fit.names[LEVEL][1:] == ("option 1", "there", "here")
    session.journal.close()


def test_an_option_that_the_model_lacks_clamps_nothing():
    fit, demos, _ = planted(4, 20)
    labels = free(demos)
    labels["demo_1"][4:9] = 4  # it was new after the proposals were made
    proposals = Proposals(fit, demos, 1, labels, 3)
    shown = proposals.shown("demo_1", labels["demo_1"])
    assert (shown.options[4:9] == 4).all()
    assert not (shown.options[9:] == 4).any()
    (segments,) = fit.segment(demos)
    np.testing.assert_array_equal(proposals.shown("demo_0").options, segments[0])


def test_a_demonstration_that_is_held_out_is_proposed_as_if_nothing_were_said_of_it():
    fit, demos, truth = planted(5, 20)
    said = free(demos) | {name: truth[name] for name in demos.names[:3]}
    proposals = Proposals(fit, demos, 1, said, 3)
    found = proposals.held_out(said, demos.names[:3])
    assert [*found] == [*demos.names[:3]]
    for name, own in found.items():
        other = Proposals(fit, demos, 1, {**said, name: np.full(20, -1)}, 3)
        expected = other.shown(name)
        np.testing.assert_array_equal(own.options, expected.options)
        np.testing.assert_allclose(own.probability, expected.probability)
        assert own.probability.min() < 1  # nothing is clamped
    assert all((proposals.shown(name, said[name]).options == said[name]).all() for name in found)


def begun(demos, count, **training):
    """A first fit by EM, whose options have numbers of their own."""
    training = {"optimizer": {"name": "em"}, "starts": ["vq_controls"], "tune_fraction": 0.0, **training}
    return ddco_pyro.fit(in_units_of(make_spec((count,), epochs=30, **training), demos, 0.1), demos)


def test_an_option_without_labels_yet_keeps_its_steps():
    """One demonstration that lacks an option is named, and no other one."""
    _, demos, truth = planted(12, 30)
    named = next(name for name in demos.names if len(np.unique(truth[name])) == 2)
    said = free(demos) | {named: truth[named]}
    missing = ({1, 2, 3} - set(truth[named])).pop()
    before = Proposals(begun(demos, 3, starts=["vq_controls"] * 3), demos, 1, said, 3)
    shown = {name: before.shown(name, said[name]).options for name in demos.names}
    kept = {name: np.where(np.isin(own, before.waiting(said)), own, -1) for name, own in shown.items()}
    again = Proposals(refit(before.fit, LEVEL, 3, demos, said, kept), demos, 1, said, 3, shown)
    steps = np.concatenate([again.shown(name).options for name in demos.names if name != named])
    wanted = np.concatenate([truth[name] for name in demos.names if name != named])
    assert np.mean(steps[wanted == missing] == missing) > 0.9


def test_a_model_of_several_levels_is_fitted_as_its_spec_says():
    spec = make_spec((2, 2), optimizer={"name": "em"}, tune_fraction=0.0, epochs=8)
    _, demos, truth = planted(6, 12, (2, 2))
    trained = ddco_pyro.fit(spec, demos)
    said = {name: truth[name] if number < 3 else np.full(12, -1) for number, name in enumerate(demos.names)}
    again = refit(trained, LEVEL, 2, demos, said, free(demos))
    assert again.hierarchy.depth == 2
    assert (again.spec.compare_with, again.spec.demonstrations.validates) == ((), False)
    assert again.metrics.trained_labels.level == LEVEL


def test_a_refit_by_gradient_steps_is_tuned_by_demonstrations_without_labels():
    _, demos, truth = planted(5, 6)
    trained = begun(demos, 3, optimizer={"lr": 0.03}, tune_fraction=0.4)
    for chosen in demos.names:
        said = free(demos) | {chosen: truth[chosen]}
        again = refit(trained, LEVEL, 3, demos, said, free(demos))
        assert again.metrics.trained_labels.level == LEVEL
