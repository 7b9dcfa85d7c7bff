"""The stacked networks against one separate torch network for each option and step."""

import pytest
import torch
from stacked_networks import (
    COPIES,
    FEATURES,
    LONGEST,
    PIXELS,
    SHAPE,
    answer,
    assert_close,
    make,
    make_inputs,
    random_inputs,
    refused,
    separate,
)
from torch import nn

from ddco_pyro.model.networks import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.conv import POOLED

DEEP = [{"hidden": [8]}, {"hidden": [8, 6], "dropout": 0.5}]


@pytest.mark.parametrize("settings", [{"network": "linear"}, {"network": "constant"}, *DEEP])
def test_stacked_networks_are_separate_networks(settings):
    network, inputs = make(**settings), make_inputs()
    read = inputs.vector[..., :0] if "constant" in settings.values() else inputs.vector
    expected = torch.stack([separate(network.layers, k)(read) for k in range(COPIES)], dim=2)
    assert_close(network(inputs)[0], expected)


CONVOLUTION = [{"filters": 3, "kernel": 5, "stride": 2, "padding": 2}]


def test_a_standardised_picture_is_seen_whatever_its_brightness_and_contrast():
    """As numpy standardises it; half as strong and darker or brighter it gives the same."""
    shape = InputShape({}, {"camera": PIXELS})
    settings = {"network": "conv", "layers": CONVOLUTION, "pool": "flatten"}
    plain, network = make(shape, **settings), make(shape, **settings, standardize=True)
    network.load_state_dict(plain.state_dict())
    picture = 2 * torch.randint(0, 64, (1, 1, *PIXELS), dtype=torch.uint8)
    values = picture[0, 0].numpy() / 255.0
    expected = torch.as_tensor((values - values.mean()) / values.std() * 255)
    for seen in (picture, picture // 2, picture // 2 + 100):
        inputs = Inputs({}, {"camera": seen}, torch.zeros(1))
        of_floats = Inputs({}, {"camera": expected[None, None]}, torch.zeros(1))
        torch.testing.assert_close(network(inputs)[0], plain(of_floats)[0], atol=1e-5, rtol=1e-4)


def test_a_picture_of_one_colour_is_standardised_to_nothing():
    shape = InputShape({}, {"camera": PIXELS})
    network = make(shape, network="conv", layers=CONVOLUTION, pool="flatten", standardize=True)
    grey = torch.full((1, 1, *PIXELS), 100.0, requires_grad=True)
    found = network(Inputs({}, {"camera": grey}, torch.zeros(1)))[0]
    assert_close(found, network(Inputs({}, {"camera": torch.zeros_like(grey)}, torch.zeros(1)))[0])
    (gradient,) = torch.autograd.grad(found.sum(), grey)
    assert gradient.isfinite().all()


# --- per-timestep -------------------------------------------------------------------------------------------


def one_at_a_time(network, inputs):
    """Each step by the separate network of its own time."""
    steps = []
    for position, time in enumerate(inputs.time.tolist()):
        own = min(time, LONGEST - 1)
        nets = [separate(network.layers, own * COPIES + k) for k in range(COPIES)]
        steps.append(torch.stack([net(inputs.vector[:, position]) for net in nets], dim=1))
    return torch.stack(steps, dim=1)


@pytest.mark.parametrize(
    ("steps", "start"),
    [(LONGEST, 0), (3, 0), (1, 0), (1, 2), (1, LONGEST - 1), (2, 2), (1, 40), (4, 3), (LONGEST, 1), (8, 0)],
)
def test_every_step_has_its_own_network(steps, start):
    network, inputs = make(network="per_timestep", hidden=[6]), make_inputs(steps=steps, start=start)
    assert_close(network(inputs)[0], one_at_a_time(network, inputs))


# --- images -------------------------------------------------------------------------------------------------


def separate_conv(network, k, inputs):
    """The k-th convolutional network, image by image, with ordinary torch layers."""
    columns = [inputs.vector.flatten(0, 1)]
    for (stacked,), image in zip(network.convolutions, inputs.images.values(), strict=True):
        own = slice(3 * k, 3 * (k + 1))
        pixels = torch.stack([frame.permute(2, 0, 1) for frame in image.flatten(0, 1)]) / 255
        maps = nn.functional.conv2d(pixels, stacked.weight[own], stacked.bias[own], stride=2, padding=2)
        columns.append(nn.functional.adaptive_avg_pool2d(maps.clamp(min=0), POOLED).flatten(1))
    return separate(network.layers, k)(torch.cat(columns, 1)).unflatten(0, inputs.batch)


@pytest.mark.parametrize("images", [("camera",), ("camera", "wrist")])
def test_conv_networks_are_separate_networks(images):
    shape = InputShape({"state": FEATURES}, dict.fromkeys(images, PIXELS), LONGEST)
    network = make(shape, network="conv", layers=CONVOLUTION, hidden=[8])
    inputs = make_inputs(images=images)
    expected = torch.stack([separate_conv(network, k, inputs) for k in range(COPIES)], dim=2)
    assert_close(network(inputs)[0], expected)


def expected_places(maps):
    """Sum of the places of all pixels, weighted with the softmax over the pixels of each map."""
    height, width = maps.shape[2:]
    weights = torch.softmax(maps.flatten(2), 2).reshape(maps.shape)
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return torch.stack([(weights * place).sum((2, 3)) for place in (rows, columns)], 2).flatten(1)


POOLS = {
    "mean": lambda maps: nn.functional.adaptive_avg_pool2d(maps, POOLED).flatten(1),
    "flatten": lambda maps: maps.flatten(1),
    "spatial_softmax": expected_places,
}


ACTIVATIONS = {"relu": nn.ReLU(), "leaky_relu": nn.LeakyReLU(0.01), "elu": nn.ELU(), "tanh": nn.Tanh()}


POOLED_BY = [("mean", "relu"), ("flatten", "leaky_relu"), ("spatial_softmax", "elu"), ("mean", "tanh")]


@pytest.mark.parametrize(("pool", "activation"), POOLED_BY)
def test_several_convolutions_are_separate_networks(pool, activation):
    """The activation follows every convolution and every hidden layer."""
    layers = [{"filters": 3, "kernel": 4, "stride": 2, "padding": 1}, {"filters": 2, "kernel": 3}]
    shape, follows = InputShape({}, {"camera": PIXELS}), ACTIVATIONS[activation]
    network = make(shape, network="conv", layers=layers, pool=pool, hidden=[8, 5], activation=activation)
    inputs = random_inputs(shape, 2, LONGEST, 0)
    pixels = inputs.images["camera"].flatten(0, 1).permute(0, 3, 1, 2) / 255
    first, second = network.convolutions[0]
    expected = []
    for k in range(COPIES):
        a, b = slice(3 * k, 3 * (k + 1)), slice(2 * k, 2 * (k + 1))
        maps = follows(nn.functional.conv2d(pixels, first.weight[a], first.bias[a], stride=2, padding=1))
        maps = follows(nn.functional.conv2d(maps, second.weight[b], second.bias[b]))
        expected.append(separate(network.layers, k, follows)(POOLS[pool](maps)).unflatten(0, inputs.batch))
    assert_close(network(inputs)[0], torch.stack(expected, dim=2))


def test_branches_read_each_their_own_and_are_joined():
    shape = InputShape({"pose": 2, "goal": 3, "other": 4}, {"camera": PIXELS})
    pair = {"network": "linear", "inputs": ["goal", "pose"]}
    picture = {"network": "conv", "layers": CONVOLUTION, "hidden": [6]}
    of = {"camera": picture, "pair": pair, "goal": {"hidden": [5]}}
    network = make(shape, network="branches", of=of, hidden=[8])
    inputs = random_inputs(shape, 2, LONGEST, 0)
    seen = Inputs({}, inputs.images, inputs.time)
    camera, _, goal = network.of
    for layers in (camera.layers, goal.layers):
        assert isinstance(layers[-2], nn.ReLU)  # what is read are hidden layers
    expected = []
    for k in range(COPIES):
        picture = separate_conv(camera, k, seen)
        vectors = inputs.vectors
        joined = [picture, vectors["goal"], vectors["pose"], separate(goal.layers, k)(vectors["goal"])]
        expected.append(separate(network.layers, k)(torch.cat(joined, -1)))
    assert_close(answer(network, inputs)[0], torch.stack(expected, dim=2))


# --- some of the observations -------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{"network": "linear"}, {"network": "user_networks:Own"}])
def test_a_network_reads_the_observations_that_it_is_to_read(settings):
    shape = InputShape({"pose": 2, "goal": 3}, {"camera": PIXELS})
    inputs = random_inputs(shape, 2, LONGEST, 0)
    network, alone = make(shape, **settings, inputs=("goal",)), make(InputShape({"goal": 3}), **settings)
    assert_close(network(inputs)[0], alone(Inputs({"goal": inputs.vectors["goal"]}, {}, inputs.time))[0])


def test_all_vectors_are_read_in_the_order_of_the_spec():
    shape = InputShape({"b": 1, "a": 2})
    network, inputs = make(shape, network="linear"), random_inputs(shape, 2, LONGEST, 0)
    both = torch.cat([inputs.vectors["b"], inputs.vectors["a"]], -1)
    expected = torch.stack([separate(network.layers, k)(both) for k in range(COPIES)], dim=2)
    assert_close(network(inputs)[0], expected)


# --- a user's own -------------------------------------------------------------------------------------------


def test_a_network_of_ones_own():
    network, inputs = make(network="user_networks:Own", options={"gain": 2.0}), make_inputs()
    assert_close(network(inputs)[0][:, :, 3, 1], 2 * inputs.vector.sum(-1))


def test_another_network_reads_as_many_of_its_numbers_as_its_class_says():
    networks = [{"network": f"user_networks:{name}"} for name in ("Own", "Narrow")]
    over = [make(network="lstm", over=own).over for own in networks]
    assert [network.features for network in over] == [64, 5]


SHOULD = "it has to be a tensor [N, T, copies, outputs], here"
STATE = "has initial_state(N), which has to give a tuple of tensors [N, ...]; each call"
BY_STEPS = "gives other outputs step by step than for a whole trajectory: its state has to hold all"
ALONE = "gives a step alone other outputs than within its trajectory: it depends on earlier steps"
MEMORIES = ["over time", "over trajectories", "differences", "later steps"]
MEMORIES += ["whole trajectory", "whole batch", "chance"]


@pytest.mark.parametrize(
    ("network", "how", "message"),
    [
        ("Wrong", "swapped", f"gives shape [2, 3, 2, 4]; {SHOULD} [2, 3, 4, 2]"),
        ("Wrong", "squeezed", f"gives shape [1, 4, 2]; {SHOULD} [1, 1, 4, 2]"),
        ("Wrong", "time first", f"gives shape [3, 2, 4, 2]; {SHOULD} [2, 3, 4, 2]"),
        ("Wrong", "list", f"gives a list; {SHOULD} [2, 3, 4, 2]"),
        ("Wrong", "fails", "fails for random observations, N = 2, T = 3: "),
        *(("Remembering", how, STATE) for how in ("alone", "list", "without trajectories", "other shape")),
        *(("Remembering", how, BY_STEPS) for how in ("forgets", "looks ahead", "over trajectories")),
        *(("WithMemory", how, ALONE) for how in MEMORIES),
        *(("WithMemoryAndZeros", how, ALONE) for how in MEMORIES),
    ],
)
def test_a_network_of_ones_own_is_tried_when_it_is_made(network, how, message):
    """Its shapes and its state; a step alone and in its trajectory give the same."""
    said = refused(network=f"user_networks:{network}", options={"how": how})
    assert said.startswith(f"network 'user_networks:{network}' {message}")


PICTURE = InputShape({"state": 3}, {"camera": PIXELS})
SMALL = InputShape({}, {"camera": (6, 6, 3)})
LAYERS = [{"filters": 2, "kernel": 5}, {"filters": 2, "kernel": 3}]
OF_NONE = {"network": "branches", "of": {"camera": {"network": "conv"}}}
NO_MODULE = "'no_such_module:Net' cannot be imported: No module named"


@pytest.mark.parametrize(
    ("shape", "settings", "message"),
    [
        (PICTURE, {"network": "linear"}, "reads vectors, but camera are images"),
        (SHAPE, {"network": "conv"}, "needs an image among the observations"),
        (SHAPE, OF_NONE, "^of.camera: inputs: there is no"),
        (SHAPE, {"inputs": ["stat"]}, r"no observation 'stat' \(did you mean 'state'\?\); there is: state"),
        (SMALL, {"network": "conv", "layers": LAYERS}, "camera of 6 × 6 is too small for its layers"),
        (SHAPE, {"network": "no_such_module:Net"}, NO_MODULE),
        (SHAPE, {"network": "user_networks:NotANetwork"}, "is not a torch.nn.Module class"),
        (SHAPE, {"network": "user_networks:Own", "options": {"gain": -1}}, "the gain has to be positive"),
    ],
)
def test_a_network_that_cannot_be_built_says_why(shape, settings, message):
    with pytest.raises(ShapeError, match=message):
        make(shape, **settings)
