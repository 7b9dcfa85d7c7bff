"""What a spec may say of a network is what the network's class takes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import pytest
import torch
from pydantic import Field
from torch import nn

from ddco_pyro.model.networks import CLASSES, InputShape, build
from ddco_pyro.spec import SpecError, network_spec, parse_spec
from ddco_pyro.spec.networks import SETTINGS
from ddco_pyro.training.networks import Dimensions, check_models

if TYPE_CHECKING:
    from collections.abc import Hashable

SHAPE = InputShape({"state": 3}, {}, 5)


# --- built-in ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CLASSES)
def test_the_settings_of_a_spec_reach_the_network(name):
    other = {"hidden": [7, 9], "dropout": 0.25, "activation": "elu", "filters": 2, "kernel": 3}
    given = {key: value for key, value in other.items() if key in SETTINGS[name].model_fields}
    shape = InputShape({"state": 3}, {"camera": (6, 6, 3)} if name == "conv" else {}, 5)
    if name == "branches":
        given["of"] = {"state": network_spec(network="linear")}
    network = build(network_spec(network=name, **given), shape, 2, 4)
    if name == "lstm":
        assert [layer.recurrent.shape for layer in network.memory] == [(4, 7, 28), (4, 9, 36)]
        return
    sizes = [layer.weight.shape[1] for layer in network.layers if hasattr(layer, "weight")]
    read = {"constant": 0, "conv": 3 + 2 * 64}.get(name, 3)
    assert sizes == [read, *given.get("hidden", [])]
    assert {layer.p for layer in network.layers if isinstance(layer, nn.Dropout)} == (
        {0.25} if "dropout" in given else set()
    )
    assert sum(isinstance(layer, nn.ELU) for layer in network.layers) == len(given.get("hidden", []))
    if name == "conv":
        assert network.convolutions[0][0].weight.shape == (2 * 4, 3, 3, 3)


# --- a user's ---------------------------------------------------------------------------------------------------------


class Typed(nn.Module):
    """A network of one's own, every option of another type."""

    def __init__(
        self,
        shape,
        outputs,
        copies,
        width: int,
        sizes: tuple[int, ...] = (3,),
        gain: Annotated[float, Field(gt=0)] = 1.0,
        kind: Literal["plain", "gated"] = "plain",
        mixed: int | str = 0,
        module: nn.Module | None = None,
        unknown: Hashable = None,
        *,
        anything=None,
    ):
        super().__init__()
        self.given = {"width": width, "sizes": sizes, "gain": gain, "kind": kind, "mixed": mixed, "anything": anything}
        self.size = (copies, outputs)

    def forward(self, inputs):
        return torch.zeros(*inputs.batch, *self.size)


def made(options, name="Typed"):
    return build(network_spec(network=f"{__name__}:{name}", options=options), SHAPE, 2, 4).module


def test_options_are_of_the_types_that_the_class_says():
    options = {"width": 3, "sizes": [4, 5], "gain": 2, "kind": "gated", "mixed": "a", "anything": [1]}
    given = made(options).given
    assert given == {**options, "sizes": (4, 5)}
    assert isinstance(given["gain"], float)
    assert made({"width": 3, "module": 4, "unknown": [5]}).given["sizes"] == (3,)  # what cannot be checked is passed on


WRONG = [
    ({}, "options.width: missing; it has to be given"),
    ({"width": 1, "sizse": [1]}, "options.sizse: unknown option (did you mean 'sizes'?); the class takes: width"),
    ({"width": 1, "shape": [3]}, "options.shape: unknown option; the class takes: width, sizes, gain, kind, mixed, "),
    ({"width": "3"}, "options.width: must be a whole number, got '3'"),
    ({"width": 1, "sizes": [3, "a"]}, "options.sizes.1: must be a whole number, got 'a'"),
    ({"width": 1, "gain": 0}, "options.gain: must be greater than 0, got 0"),
    ({"width": 1, "kind": "gatde"}, "options.kind: must be plain or gated, got 'gatde' (did you mean 'gated'?)"),
    ({"width": 1, "mixed": [1.5]}, "options.mixed: must be int | str, got [1.5]"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_options_that_the_class_does_not_take_are_one_line_each(options, message):
    with pytest.raises(SpecError) as caught:
        made(options)
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].startswith(message)


WRONG_OPTIONS = {"network": f"{__name__}:Typed", "options": {"width": "a", "gian": 1}}


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        ({"hierarchy.levels.0.termination": WRONG_OPTIONS}, "hierarchy.levels.0.termination"),
        ({"compare_with": ["flat", {"kind": "flat", "policy": WRONG_OPTIONS}]}, "compare_with.1.policy"),
    ],
)
def test_what_is_wrong_with_options_is_said_with_their_place_in_the_spec(wrong, place):
    spec = parse_spec({"task": "toy", "observations": ["pose"], "hierarchy": {"levels": [{"count": 2}]}}, wrong)
    with pytest.raises(SpecError) as caught:
        check_models(spec, Dimensions({"pose": (3,)}, control_size=2, steps=5))
    width, gian = caught.value.problems
    assert width == f"{place}.options.width: must be a whole number, got 'a'"
    assert gian.startswith(f"{place}.options.gian: unknown option (did you mean 'gain'?); the class takes: width, ")
