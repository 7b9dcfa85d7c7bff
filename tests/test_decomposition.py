"""The parts of a log-likelihood against sums over every latent path in plain Python, and against the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import paths
from scipy import stats

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.posteriors import decompose
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import parse_spec
from ddco_pyro.training.networks import Dimensions

LENGTHS = (3, 2)


def make_demonstrations() -> Demonstrations:
    """Two demonstrations of three control dimensions, the second of them constant."""
    random = np.random.default_rng(0)
    return Demonstrations(
        tuple(
            Demonstration(
                f"demo_{number}",
                {"pose": random.normal(size=(steps, 2))},
                np.stack([random.normal(5, 3, steps), np.full(steps, 0.5), random.normal(0, 0.1, steps)], axis=1),
            )
            for number, steps in enumerate(LENGTHS)
        )
    )


DEMOS = make_demonstrations()


def make(counts: tuple[int, ...], emits: tuple[str, ...]) -> Hierarchy:
    """Random networks that differ between options; σ of each level is its own."""
    levels = [
        {"name": f"level-{d}", "count": k, "policy": {"network": "linear"} | ({"emits": list(emits)} if d else {})}
        for d, k in enumerate(counts)
    ]
    model = {"hierarchy": {"levels": levels, "meta_policy": {"network": "linear", "emits": list(emits)}}}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["pose"],
            "control": {"std": {"learn": True}},
            **(model if counts else {"baseline": {"kind": "flat", "policy": {"network": "linear"}}}),
        }
    )
    torch.manual_seed(1)
    size = Dimensions.of(DEMOS)
    hierarchy = Hierarchy(spec, size.shapes, size.control_size, size.steps, size.constant)
    hierarchy.encoder.fit(DEMOS)
    hierarchy.scaling.fit(DEMOS)
    with torch.no_grad():
        for parameter in hierarchy.parameters():
            parameter.add_(torch.randn_like(parameter))
    return hierarchy.eval()


def exact(hierarchy: Hierarchy) -> tuple[Outputs, Batch]:
    """What the networks say, in float64, and the batch."""
    batch = encode(DEMOS, hierarchy.encoder, hierarchy.scaling)
    with torch.no_grad():
        outputs = hierarchy(batch.inputs)
    return outputs.map(torch.Tensor.double), batch


@pytest.mark.parametrize(
    ("counts", "emits"),
    [((), ("control",)), ((3,), ("options",)), ((2,), ("options", "control")), ((2, 2), ("options", "control"))],
    ids=["flat", "options", "hybrid", "two hybrid levels"],
)
def test_parts_are_those_of_every_path(counts: tuple[int, ...], emits: tuple[str, ...]) -> None:
    hierarchy = make(counts, emits)
    outputs, batch = exact(hierarchy)
    found = decompose(outputs, batch)
    assert found.dimensions.shape == (2, 2)
    tables = outputs.tables(batch.actions.double())
    for n, length in enumerate(LENGTHS):
        densities = _densities(hierarchy, outputs, batch, n)
        every = [(path, joint) for path, _, joint in paths(tables, n, length, [1 + k for k in counts])]
        total = sum(joint for _, joint in every)
        dimensions, options = np.zeros(2), 0.0
        for path, joint in every:
            given = np.sum([densities[_actor(choices)][t] for t, choices in enumerate(path)], axis=0)  # [A']
            posterior, log_prior = joint / total, math.log(joint) - given.sum()
            dimensions += posterior * given
            options += posterior * (log_prior - math.log(posterior))
        np.testing.assert_allclose(found.dimensions[n], dimensions, rtol=1e-9)
        np.testing.assert_allclose(found.options[n], options, rtol=1e-9, atol=1e-12)


def _actor(choices: tuple[int, ...]) -> tuple[int, int]:
    """Level and option of who emits the control: the lowest choice that is not 0, else the meta-policy."""
    return next(((level, choice - 1) for level, choice in enumerate(choices) if choice), (len(choices), 0))


def _densities(hierarchy: Hierarchy, outputs: Outputs, batch: Batch, n: int) -> dict[tuple[int, int], np.ndarray]:
    """log N(a_td; μ_d, σ_d²) of each caller, [T, A'], with scipy and in the control's own units."""
    shift, scale = hierarchy.scaling.shift.numpy(), hierarchy.scaling.scale.numpy()

    def units(scaled: torch.Tensor) -> np.ndarray:
        return scaled.detach().double().numpy() * scale + shift

    actions = units(batch.actions[n, : LENGTHS[n]])
    return {
        (level, option): stats.norm.logpdf(
            actions, units(emission.mean[n, : LENGTHS[n], option]), emission.std.detach().numpy() * scale
        )
        for level, emission in enumerate(outputs.emissions)
        if emission is not None
        for option in range(emission.mean.shape[2])
    }


@pytest.mark.parametrize("counts", [(), (3,), (2, 2)])
def test_parts_sum_to_the_log_likelihood(counts: tuple[int, ...]) -> None:
    hierarchy = make(counts, ("options", "control") if counts else ("control",))
    outputs, batch = exact(hierarchy)
    found = decompose(outputs, batch)
    whole = hierarchy.tabulate(batch)
    np.testing.assert_allclose(
        found.dimensions.sum(1) + found.options, log_likelihood(whole, batch.lengths).detach(), rtol=1e-6
    )
    assert (found.options <= 0).all()
    assert bool((found.options == 0).all()) == (not counts)
