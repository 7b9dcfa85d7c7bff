"""Controls that the Pyro program draws, against the numbers of the networks that it draws them from."""

from __future__ import annotations

import pyro
import pytest
import torch
from hierarchies import make_batch, make_hierarchy
from pyro.infer import Predictive

from ddco_pyro.inference import enumeration, total_log_likelihood
from ddco_pyro.model.ahmm import ahmm
from ddco_pyro.model.emissions import Acting
from ddco_pyro.model.tables import complete

DRAWS = 4000


def said(counts, emits=("options", "control")):
    """What random networks say of a batch of demonstrations, the batch, and the chain without its controls."""
    hierarchy, batch = make_hierarchy(counts, emits), make_batch()
    with torch.no_grad():
        outputs = hierarchy(batch.inputs)
    return outputs, batch, complete(outputs.tables(), batch.lengths)


def actor(choices):
    """The level and the option of who acts; the meta-policy is the option 0 of the last level."""
    return next(((level, h - 1) for level, h in enumerate(choices) if h), (len(choices), 0))


@pytest.mark.parametrize("counts", [(3,), (2, 2)])
def test_controls_are_drawn_from_who_acts(counts):
    """Of all draws in which the same caller acts: mean and deviation, within five standard errors."""
    outputs, batch, chain = said(counts)
    pyro.set_rng_seed(0)
    draws = [pyro.poutine.trace(ahmm).get_trace(chain, outputs.emissions).nodes for _ in range(DRAWS // len(batch))]
    t, of_actor = 1, {}
    for nodes in draws:
        for n in range(len(batch)):
            choices = [int(nodes[f"h_{d}_{t}"]["value"][n]) for d in range(1, 1 + len(counts))]
            of_actor.setdefault((n, *actor(choices)), []).append(nodes[f"a_{t}"]["value"][n])
    checked = 0
    for (n, level, option), values in of_actor.items():
        if len(values) > 50:
            emission, controls = outputs.emissions[level], torch.stack(values)
            apart = (controls.mean(0) - emission.mean[n, t, option]) / emission.std
            assert (apart.abs() < 5 / len(values) ** 0.5).all()
            assert (controls.std(0) / emission.std - 1).abs().max() < 5 / (2 * len(values)) ** 0.5
            checked += 1
    assert checked > len(batch)


def test_predictive_draws_whole_demonstrations():
    outputs, _, chain = said((3,))
    pyro.set_rng_seed(0)
    draws = Predictive(ahmm, num_samples=50)(chain, outputs.emissions)
    number, steps, _, size = outputs.emissions[0].shape
    assert all(draws[f"a_{t}"].shape == (50, number, size) for t in range(steps))
    nearest = (draws["a_0"].unsqueeze(-2) - outputs.emissions[0].mean[:, 0]).abs() / outputs.emissions[0].std
    assert nearest.amax(-1).amin(-1).median() < 3


def test_a_control_can_be_conditioned_on():
    """With every control given the program has the likelihood of the tables; with one changed, that of the changed."""
    outputs, batch, chain = said((2,), ("options",))
    actions = batch.actions.clone()
    actions[:, 1] += 0.5
    given = {f"a_{t}": control for t, control in enumerate(actions.unbind(1))}
    elbo = pyro.infer.TraceEnum_ELBO(max_plate_nesting=1, strict_enumeration_warning=False)
    conditioned = pyro.condition(ahmm, data=given)
    value = -elbo.loss(conditioned, lambda *_: None, chain, outputs.emissions)
    assert value == pytest.approx(float(total_log_likelihood(outputs.tables(actions), batch.lengths)), rel=1e-5)


@pytest.mark.parametrize("counts", [(), (3,), (2, 2)])
def test_the_program_scores_what_the_tables_hold(counts):
    outputs, batch, _ = said(counts, ("options", "control") if counts else ("control",))
    outputs, actions = outputs.map(torch.Tensor.double), batch.actions.double()
    tables = outputs.tables(actions)
    by_emissions = enumeration.program_log_likelihood(tables, batch.lengths, outputs.emissions, actions)
    torch.testing.assert_close(
        by_emissions, enumeration.total_log_likelihood(tables, batch.lengths), rtol=1e-12, atol=0
    )


def test_who_cannot_be_does_not_act():
    """Below a choice 0 there is nothing but choice 0."""
    outputs, batch, _ = said((2, 2))
    steps = tuple(emission.steps()[0] for emission in outputs.emissions)
    choices = (torch.ones(len(batch), dtype=torch.int64), torch.zeros(len(batch), dtype=torch.int64))
    assert (Acting(steps, choices).log_prob(batch.actions[:, 0]) == -torch.inf).all()
