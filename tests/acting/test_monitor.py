"""The live monitor against the model's likelihood and posterior of the same demonstration."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hierarchies import make_hierarchy
from planted import make_spec, make_trainer
from random_demonstrations import of_states

from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.inference import log_likelihood, posterior
from ddco_pyro.model.batch import encode

WINDOWS = {"network": "lstm", "horizon": 4}


@pytest.mark.parametrize(
    ("counts", "network"),
    [((3,), "mlp"), ((2, 2), "mlp"), ((2, 2), "lstm"), pytest.param((2, 2), WINDOWS, id="windows")],
)
def test_what_it_says_at_the_end_is_what_the_demonstration_says(counts, network):
    """Before the last control is known, the belief is the posterior of the demonstration without it.

    An episode that was broken off before is forgotten.
    """
    hierarchy, demo = make_hierarchy(counts, ("options", "control"), network), of_states([6])[0]
    monitor = Monitor(hierarchy)
    for t in [0, 1, 2, *range(6)]:
        if t == 0:
            monitor.reset()
        active = monitor.step({"state": demo.observations["state"][t]}, demo.actions[t - 1] if t else None)
    with torch.no_grad():
        batch = encode(Demonstrations([demo]), hierarchy.encoder, hierarchy.scaling)
        tables = hierarchy.tabulate(batch)
        before = log_likelihood(tables, torch.tensor([5]))
        for table in tables.control:
            table[:, -1] = 0.0
        expected = posterior(tables, batch.lengths)
    assert monitor.log_likelihood == pytest.approx(float(before), rel=1e-6)
    for d, level in enumerate(monitor.belief):
        torch.testing.assert_close(level[0], expected.u[d][0, -1], atol=1e-6, rtol=0)
        assert list(active[f"level-{1 + d}"].values()) == pytest.approx(level[0].tolist())


@pytest.fixture(scope="module")
def watched():
    """A hierarchy of two levels with a recogniser of the upper one, and demonstrations."""
    demos = of_states([9, 7, 8, 9], seed=4)
    labels = [np.where(np.arange(len(demo)) % 4 == 3, -1, np.arange(len(demo)) // 4 % 2) for demo in demos]
    known = (replace(demo, labels={"phase": own}) for demo, own in zip(demos, labels, strict=True))
    demos = Demonstrations(tuple(known))
    own = {"level": "level-2", "from": "phase", "recogniser": {"weight": 0.8}}
    return make_trainer(make_spec((2, 2), labels=own), demos, None).hierarchy.eval(), demos


def beliefs(hierarchy, demo, until=None):
    monitor, found = Monitor(hierarchy), []
    for t in range(until or len(demo)):
        monitor.step({"state": demo.observations["state"][t]}, demo.actions[t - 1] if t else None)
        found.append([level[0].numpy() for level in monitor.belief])
    return found, monitor.log_likelihood


def test_a_recogniser_of_the_past_is_evidence_at_every_step(watched):
    """Against a slow recomputation of everything at every step; the log-likelihood has no evidence."""
    hierarchy, demos = watched
    demo, past = demos[0], hierarchy.recogniser.past
    found, value = beliefs(hierarchy, demo)
    for t, levels in enumerate(found):
        whole = encode(Demonstrations([demo]), hierarchy.encoder, hierarchy.scaling)
        batch = whole.select(torch.tensor([0]), t + 1)
        actions = torch.cat([torch.zeros(1, 1, 2), batch.actions[:, :t]], dim=1)
        x = torch.cat([batch.inputs.vector, actions], dim=-1)[0].double()
        rows = [torch.cat([x[s], *(x[max(s - w, 0) : s + 1].mean(0) for w in (1, 2))]) for s in range(t + 1)]
        logits = (torch.stack(rows) @ past.weight + past.bias).log_softmax(-1)
        ratio = logits.clamp(min=-12) - past.share.log()
        evidence = torch.cat([torch.zeros(t + 1, 1), 0.8 * ratio], dim=1)[None]
        with torch.no_grad():
            tables = hierarchy.tabulate(batch).with_evidence(2, evidence)
        last = torch.arange(t + 1)[:, None] == t  # the control at t is not known yet
        known = tuple(torch.where(last & (table > -torch.inf), 0.0, table) for table in tables.control)
        expected = posterior(replace(tables, control=known), batch.lengths)
        for d, level in enumerate(levels):
            np.testing.assert_allclose(level, expected.u[d][0, -1], atol=1e-6)
    with torch.no_grad():
        alone = log_likelihood(hierarchy.tabulate(batch), torch.tensor([len(demo) - 1]))
    assert value == pytest.approx(float(alone), rel=1e-5)
