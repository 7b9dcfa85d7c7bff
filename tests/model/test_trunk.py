"""A network that the whole hierarchy reads, against networks of their own with the same weights."""

import torch
from hierarchies import SHAPES, make_batch
from planted import LINEAR, small_spec

from ddco_pyro.inference import log_likelihood
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.training.stages import plan

SEES = {"network": "mlp", "hidden": [5], "activation": "tanh"}


def spec_of(network, trunk=None, **training):
    """Two levels."""
    level = {"policy": network, "termination": network}
    levels = [level | {"name": "lower", "count": 3}, level | {"name": "upper", "count": 2}]
    return small_spec(hierarchy={"trunk": trunk, "levels": levels, "meta_policy": network}, training=training)


def made(spec):
    torch.manual_seed(0)
    return Hierarchy(spec, Dimensions(SHAPES, 2, 4))


def value_of(hierarchy):
    batch = make_batch(trajectories=3)
    return log_likelihood(hierarchy.tabulate(batch), batch.lengths).sum()


def test_it_is_what_each_would_give_with_these_weights_and_learns_from_all():
    """Networks that begin with a copy of it have the same likelihood; its gradient is their sum."""
    one, many = made(spec_of(LINEAR, SEES)), made(spec_of(SEES))
    shared, firsts = one.trunk.layers[0], [network.layers[0] for network in many.networks().values()]
    with torch.no_grad():
        for layer in firsts:
            layer.weight.copy_(shared.weight.expand_as(layer.weight))
            layer.bias.copy_(shared.bias.expand_as(layer.bias))
        for name, network in many.networks().items():
            network.layers[-1].load_state_dict(one.networks()[name].layers[-1].state_dict())
    found, expected = value_of(one), value_of(many)
    torch.testing.assert_close(found, expected)
    found.backward()
    expected.backward()
    of_all = sum(layer.weight.grad.sum(0) for layer in firsts)
    torch.testing.assert_close(shared.weight.grad[0], of_all, rtol=1e-4, atol=1e-5)


def test_it_is_trained_with_the_lowest_level_and_with_all():
    spec = spec_of(LINEAR, SEES, layerwise=True)
    names = [name for name, _ in made(spec).named_parameters()]
    stages = {stage.name: stage.trained for stage in plan(spec, 2)}
    trained = {stage: [name for name in names if name.startswith(own)] for stage, own in stages.items()}
    with_trunk = [name for name, own in trained.items() if "trunk.layers.0.weight" in own]
    assert with_trunk == ["vq-1", "level-1", "joint"]
    assert trained["joint"] == [name for name in names if not name.startswith(("encoder.", "scaling."))]
