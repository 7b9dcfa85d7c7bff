"""The networks that a spec can name, the settings of each, and the policies made of them.

The settings of a network are the keyword arguments of its class in :mod:`ddco_pyro.model.networks`. Their types,
defaults and bounds stand here and nowhere else: reading a spec, or its schema, is to do without importing torch.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from ddco_pyro.errors import nearest
from ddco_pyro.spec.messages import invalid
from ddco_pyro.spec.types import Count, Emission, Items, Model, NetworkName, Share, Text

USER_DEFINED = "module:Class"
_USER_DEFINED_PATTERN = r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"

Sizes = Annotated[
    Items[Count],
    BeforeValidator(
        lambda value: (value,) if type(value) is int else value, json_schema_input_type=Count | Items[Count]
    ),
]
"""Sizes of layers; a bare number is a single one."""
Pool = Literal["mean", "flatten", "spatial_softmax"]
Activation = Literal["relu", "leaky_relu", "elu", "tanh"]


class Network(Model):
    """The settings that every network has."""

    network: NetworkName = "mlp"
    """The kind of network; ``module:Class`` for a network of your own."""
    inputs: Items[Text] = ()
    """Names of the observations that it reads; all of them where none is named."""
    shared: bool = False
    """Whether all options have this network in common, with the same weights; for a trunk, and for networks in ``of``
    and ``over``, of which every option makes its own."""


class Perceptron(Network):
    """Settings of a multi-layer perceptron."""

    hidden: Sizes = Field(default=(64,), validate_default=True)
    """Sizes of the hidden layers, first one first; a bare number is a single layer. Those of ``lstm`` remember."""
    dropout: Share = 0.0
    """Probability with which a unit is dropped while training."""
    activation: Activation = "relu"
    """What follows every hidden layer and every convolution. A unit of ``relu`` that is 0 for all that is observed has
    no gradient any more and stays so; those of ``leaky_relu`` (slope 0.01 below 0), ``elu`` and ``tanh`` keep one."""


class ConvolutionLayer(Model):
    """One convolution, with the activation of its network after it."""

    filters: Count
    """Number of filters."""
    kernel: Count
    """Height and width of each filter."""
    stride: Count = 1
    """Rows and columns from one place of a filter to the next."""
    padding: int = Field(default=0, ge=0)
    """Zeros added on each side."""


class Convolution(Perceptron):
    """Settings of convolutions followed by a perceptron."""

    filters: Count = 64
    """Number of filters of a single convolution with stride 2."""
    kernel: Count = 5
    """Height and width in pixels of each filter of a single convolution."""
    layers: Items[ConvolutionLayer] = ()
    """Several convolutions, first one first, in place of ``filters`` and ``kernel``."""
    pool: Pool = "mean"
    """What is read of each map: ``mean`` of ``pooled`` × ``pooled`` fields, ``flatten`` for all of it, or the place
    where it is active, ``spatial_softmax``."""
    pooled: Count = 8
    """Fields by side."""
    standardize: bool = False
    """Whether each picture is shifted and scaled to mean 0 and standard deviation 1 over its own pixels and colours."""


class Recurrent(Network):
    """Settings of an LSTM."""

    over: NetworkSpec | None = None
    """The network whose last hidden layer it reads; null: it reads the observed vectors."""
    hidden: Sizes = (64,)
    horizon: Count | None = None
    """The memory starts anew every so many steps of a trajectory, counted from its first; null: never."""


class Branched(Perceptron):
    """Settings of several networks whose last hidden layers are joined by a perceptron."""

    of: dict[str, NetworkSpec] = Field(default={})
    """A network for each observation, by the observation's name; under another name one that says what it reads in
    ``inputs``."""


class UserDefined(Network):
    """Settings of a user's class."""

    options: dict[str, Any] = Field(default={})
    """Keyword arguments of the class."""
    features: Count = 64
    """Outputs of each copy where another network reads them."""


SETTINGS: dict[str, type[Network]] = {
    "linear": Network,
    "mlp": Perceptron,
    "per_timestep": Perceptron,
    "conv": Convolution,
    "lstm": Recurrent,
    "branches": Branched,
}
"""The built-in networks by name; every other name is a user's ``module:Class``."""
LAYERED = ("lstm", "branches")
"""Those that need a hidden layer."""


def foreign_keys(network: Any) -> tuple[str, ...]:
    """The settings that do not apply to a network of this kind."""
    kind = SETTINGS.get(network, UserDefined) if isinstance(network, str) else Network
    return tuple(key for key in NetworkSpec.model_fields if key not in kind.model_fields)


def _describe_kinds(schema: dict[str, Any]) -> None:
    """Adds to a JSON Schema which networks there are, and which of them have each setting."""
    properties = schema["properties"]
    del properties["network"]["type"]
    properties["network"]["anyOf"] = [{"enum": list(SETTINGS)}, {"type": "string", "pattern": _USER_DEFINED_PATTERN}]
    kinds: dict[str, type[Network]] = {**SETTINGS, USER_DEFINED: UserDefined}
    for key in NetworkSpec.model_fields.keys() - Network.model_fields.keys():
        names = ", ".join(f"``{name}``" for name, kind in kinds.items() if key in kind.model_fields)
        properties[key]["description"] += f" For {names}."


class NetworkSpec(UserDefined, Convolution, Recurrent, Branched):
    """A network from observations to the parameters of a distribution. Settings of other networks are refused."""

    model_config = ConfigDict(json_schema_extra=_describe_kinds)

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the network's class."""
        if self.network not in SETTINGS:
            return self.options
        kind = SETTINGS[self.network]
        return {key: getattr(self, key) for key in kind.model_fields if key not in Network.model_fields}

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the observations that it reads, itself or through others; all of them where there is none."""
        if self.inputs:
            return self.inputs
        if self.over is not None:
            return self.over.reads
        branches = (branch.inputs or (name,) for name, branch in self.of.items())
        return tuple(dict.fromkeys(name for names in branches for name in names))

    @field_validator("network")
    @classmethod
    def _known_network(cls, name: str) -> str:
        if name not in SETTINGS and (name == USER_DEFINED or not re.fullmatch(_USER_DEFINED_PATTERN, name)):
            names = [*SETTINGS, USER_DEFINED]
            raise invalid(("", f"no network is called {name!r}{nearest(name, names)}; use one of {', '.join(names)}"))
        return name

    @field_validator("hidden")
    @classmethod
    def _hidden_layers(cls, hidden: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        return () if "hidden" in foreign_keys(info.data.get("network")) else hidden

    @model_validator(mode="after")
    def _settings_apply(self) -> NetworkSpec:
        given = [key for key in foreign_keys(self.network) if key in self.model_fields_set]
        if given:
            raise invalid(*((key, f"does not apply to network {self.network!r}; leave it out") for key in given))
        if self.network in LAYERED and not self.hidden:
            raise invalid(("hidden", f"{self.network} has one layer at least; give its size"))
        if self.network == "branches" and not self.of:
            raise invalid(("of", "missing; name an observation and its network, such as {state: {network: mlp}}"))
        twice = [key for key in ("filters", "kernel") if self.layers and key in self.model_fields_set]
        if twice:
            raise invalid(*((key, "stands beside layers, which say it of each; leave it out") for key in twice))
        return self

    @model_serializer(mode="wrap")
    def _without_foreign_keys(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = serialize(self)
        unused = (*foreign_keys(self.network), *(key for key in ("inputs", "shared") if not getattr(self, key)))
        unused += ("filters", "kernel") if self.layers else ("layers",)
        return {key: value for key, value in fields.items() if key not in unused}


Recurrent.model_rebuild()
Branched.model_rebuild()


class PolicySpec(NetworkSpec):
    """The policy of a level: it emits the control (lowest level) or selects from the level below."""

    emits: Items[Emission] = Field(default=(), min_length=1)
    """What the policy chooses: ``[control]`` at the lowest level (filled in), above it ``options`` (the default),
    ``control``, or both for a hybrid policy."""

    @field_validator("emits")
    @classmethod
    def _distinct(cls, emits: tuple[Emission, ...]) -> tuple[Emission, ...]:
        for name, times in Counter(emits).items():
            if times > 1:
                raise invalid(("", f"{name!r} is given twice; keep one"))
        return emits


class MetaPolicySpec(PolicySpec):
    """The policy at the top, η: it selects from the highest level."""

    emits: Items[Emission] = Field(default=("options",), min_length=1)
    """What the meta-policy chooses: ``options``, ``control``, or both for a hybrid policy."""
