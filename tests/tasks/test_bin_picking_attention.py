"""What options attend to, on linear ones: there it is how far each input spreads, times its weight."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from bin_picking_options import _shared, attention

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.spec import parse_spec

SHAPES = {"grasp": (2,), "kin": (1,)}
STEPS = 30
LINEAR = {"network": "linear"}


@pytest.fixture
def hierarchy() -> Hierarchy:
    """Two options and a meta-policy, all of them linear."""
    spec = {
        "demonstrations": {"path": "unused.hdf5"},
        "observations": [*SHAPES],
        "hierarchy": {"levels": [{"count": 2, "policy": LINEAR, "termination": LINEAR}], "meta_policy": LINEAR},
    }
    torch.manual_seed(0)
    return Hierarchy(parse_spec(spec), SHAPES, 1, steps=STEPS).eval()


@pytest.fixture
def demos() -> Demonstrations:
    """Two demonstrations; both numbers of ``grasp`` vary together, and ``kin`` varies little."""
    random = np.random.default_rng(0)
    found = []
    for number in range(2):
        together = 2.0 * random.standard_normal((STEPS, 1))
        observations = {"grasp": together @ [[1.0, -1.0]], "kin": 0.5 * random.standard_normal((STEPS, 1))}
        found.append(Demonstration(f"demo_{number}", observations, random.standard_normal((STEPS, 1))))
    return Demonstrations(tuple(found))


def weights(hierarchy: Hierarchy, option: int, what: str) -> dict[str, np.ndarray]:
    """Of an option's control, or the logit of its termination: what it changes by with each input's numbers."""

    def said(grasp: list[float], kin: float) -> float:
        vectors = {"grasp": torch.tensor([[grasp]]), "kin": torch.tensor([[[kin]]])}
        outputs = hierarchy(Inputs(vectors, {}, torch.tensor([0])))
        numbers = outputs.callers[0].numbers
        assert numbers is not None
        values = numbers[0, 0, option - 1, 0] if what == "control" else outputs.termination_logits[0][0, 0]
        return (values if what == "control" else values[option - 1]).item()

    still = said([0.0, 0.0], 0.0)
    grasp = np.array([said([1.0, 0.0], 0.0), said([0.0, 1.0], 0.0)]) - still
    return {"grasp": grasp, "kin": np.array([said([0.0, 0.0], 1.0) - still])}


@pytest.mark.parametrize("what", ["control", "termination"])
def test_an_option_attends_to_what_spreads_times_its_weight(
    hierarchy: Hierarchy, demos: Demonstrations, what: str
) -> None:
    options = np.repeat([[1, 2], [2, 1]], STEPS // 2, axis=1)
    found = attention(hierarchy, demos, options)
    for option in (1, 2):
        own = weights(hierarchy, option, what)
        spread = {key: np.concatenate([demo.observations[key] @ own[key] for demo in demos]).std() for key in own}
        share = found[f"{what}, option {option}"]
        assert share["grasp"] == pytest.approx(spread["grasp"] / (spread["grasp"] + spread["kin"]), rel=1e-4)
        assert share["grasp"] + share["kin"] == pytest.approx(1.0)


def test_what_nothing_moves_does_not_count() -> None:
    """A choice that is certain in float32 has no slope at all."""
    spread = {"image": np.array([[1.0, 0.0], [0.0, 3.0]]), "grasp": np.array([[3.0, 0.0], [0.0, 1.0]])}
    shared = _shared(spread, np.array([True, True]), slice(None))
    assert shared == {"image": pytest.approx(0.5), "grasp": pytest.approx(0.5)}
