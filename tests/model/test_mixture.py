"""A memoryless mixture: the same hierarchy with options that end after every step."""

from functools import partial

import numpy as np
import pytest
import torch
import yaml
from hierarchies import make_batch, make_hierarchy
from oracle import brute_force
from toy_task import SPEC

import ddco_pyro
from ddco_pyro.evaluation.inferred import runs, started
from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.engines import compare_engines
from ddco_pyro.model.tables import always_ends
from ddco_pyro.selection.grid import candidates
from ddco_pyro.spec import parse_spec
from ddco_pyro.statistics import paired, worth
from ddco_pyro.training.networks import (
    Dimensions,
    baseline_spec,
    build_hierarchy,
    model_name,
    named_baselines,
    parameters,
)
from ddco_pyro.training.upper import Constants, fitted


@pytest.mark.parametrize(("counts", "memoryless"), [((2, 2), [1]), ((2, 2), [2]), ((2, 2), [1, 2])])
def test_any_level_can_be_without_memory(counts, memoryless):
    """Against the sum over every path, where ψ is exactly 1, and Pyro's enumeration of the program."""
    hierarchy, batch = make_hierarchy(counts, memoryless=memoryless), make_batch(steps=3)
    outputs = hierarchy(batch.inputs)
    tables = outputs.tables(batch.actions)
    assert [always_ends(table) for table in tables.termination] == [level in memoryless for level in (1, 2)]
    truth = brute_force(tables, 0, 3)
    with torch.no_grad():
        value = float(log_likelihood(tables, batch.lengths)[0])
    assert value == pytest.approx(truth.log_likelihood, abs=1e-6)
    assert compare_engines(outputs, batch.actions, batch.lengths).agrees


def spec_of(**changes):
    return parse_spec(yaml.safe_load(SPEC) | changes)


def test_a_mixture_beside_is_the_spec_with_terminations_always():
    spec = spec_of(compare_with=["flat", "mixture", {"kind": "mixture", "optimizer": {"lr": 0.5}}])
    assert list(named_baselines(spec)) == ["flat", "mixture", "mixture_2"]
    baselines = named_baselines(spec)
    first, second = (baseline_spec(spec, baselines[name], None) for name in ("mixture", "mixture_2"))
    (level,) = first.hierarchy.levels
    assert (level.termination, level.policy, first.training) == (
        "always",
        spec.hierarchy.levels[0].policy,
        spec.training,
    )
    assert first.hierarchy.meta_policy == spec.hierarchy.meta_policy
    assert second.training.optimizer.lr == 0.5
    assert [model_name(own) for own in (spec, first, second)] == ["ddco", "mixture", "mixture"]


TWO = [{"name": "option", "count": 2}, {"name": "phase", "count": 2}]


def test_a_grid_of_models_is_one_line():
    """Flat, mixture, options and two levels, each valid by itself, with the parameters that it has alone."""
    spec = spec_of(selection={"grid": {"model": ["flat", "mixture", "options", TWO]}})
    found = candidates(spec, Dimensions({"offsets": (4,), "visited": (1,)}, 2, 12))
    names = ["model = flat", "model = mixture", "model = options", "model = [2, 2]"]
    assert [one.name for one in found] == names
    assert [model_name(one.spec) for one in found] == ["flat", "mixture", "ddco", "ddco"]
    _, mixture, options, _ = (one.parameters for one in found)
    assert options - mixture == 2 * (4 + 1 + 1)  # two linear terminations of five numbers
    assert found[2].spec.hierarchy == spec.hierarchy
    assert all(one.spec.compare_with == () for one in found)


def test_levels_above_start_from_segments_without_memory_too():
    """ψ of a level whose options end after every step stays exactly 1 in the EM that starts upper levels."""
    hierarchy, batch = make_hierarchy((2, 2), memoryless=[2]), make_batch(4, 6)
    with torch.no_grad():
        pieces = [(hierarchy.tabulate(batch), batch.lengths)]
    constants = fitted(pieces, seed=0)
    assert isinstance(constants, Constants)
    assert constants.termination[0].tolist() == [1.0, 1.0]
    assert all(bool(torch.isfinite(table).all()) for table in constants.selection)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a mixture beside it, and labels of three demonstrations."""
    labels = {"level": "option", "from": "phase"}
    changes = {"compare_with": ["mixture"], "training": {"epochs": 6, "batch_size": 3, "labels": labels}}
    return ddco_pyro.fit(spec_of(**changes), out=tmp_path_factory.mktemp("runs") / "mixture")


def test_a_fit_trains_it_beside_with_the_same_budget(run):
    mixture = run.baselines["mixture"]
    assert run.metrics.comparison["mixture"].training.budget == run.metrics.training.budget
    stages = [[stage.stage for stage in fit.metrics.training.stages] for fit in (run, mixture)]
    assert stages[0] == stages[1]
    assert mixture.metrics.engine_check.value < 1e-6
    assert mixture.spec.training.labels == run.spec.training.labels
    again = ddco_pyro.load(run.folder / "baselines" / "mixture")
    before, after = (one.log_likelihood(run.demonstrations) for one in (mixture, again))
    np.testing.assert_array_equal(after, before)
    whole = build_hierarchy(run.spec, Dimensions.of(run.demonstrations))
    lasting = parameters(whole) - mixture.metrics.parameters
    assert lasting == sum(p.numel() for p in run.hierarchy.levels[0].termination.parameters())


def test_the_worth_of_a_hierarchy_has_two_parts():
    """Hand-made likelihoods of two demonstrations with 2 and 3 steps: the parts add up, in nats per step."""
    values = {"ddco": np.array([6.0, 9.0]), "mixture": np.array([4.0, 8.0]), "flat": np.array([-1.0, -2.0])}
    differ = partial(paired, lengths=np.array([2.0, 3.0]))
    found = worth("ddco", values, differ)
    means = {part: getattr(found, part).nats_per_step for part in ("memory", "experts", "total")}
    assert means == pytest.approx({"memory": 3 / 5, "experts": 15 / 5, "total": 18 / 5})
    assert found.flat == "flat"
    assert worth("ddco", values | {"mixture": values["flat"]}, differ).experts.nats_per_step == 0
    assert worth("mixture", values, differ) is worth("ddco", {"flat": values["flat"]}, differ) is None
    assert worth("ddco", {name: values[name] for name in ("ddco", "mixture")}, differ).total is None


def test_a_run_says_what_lasting_is_worth(run):
    """By the likelihoods of what it held out, computed anew."""
    held_out = run.demonstrations.select(row.name for row in run.metrics.valid)
    ours, mixture = (fit.log_likelihood(held_out).sum() for fit in (run, run.baselines["mixture"]))
    found = run.metrics.worth
    assert found.memory.nats_per_step == pytest.approx((ours - mixture) / sum(held_out.lengths))


def test_its_segments_are_runs_of_one_expert():
    """Every step is a termination, which says nothing: a segment ends where another expert acts."""
    options = np.array([1, 1, 2, 2, 2, 1])
    ended = np.ones(6, int)
    assert runs(options, started(options, ended, lasts=False)) == [(1, 0, 2), (2, 2, 5), (1, 5, 6)]
    assert len(runs(options, started(options, ended, lasts=True))) == 6
