"""Settings of networks: one model for each kind, joined in the tagged union :data:`NetworkSpec`.

The settings are the keyword arguments of the network's class in :mod:`ddco_pyro.model.networks`. Types,
defaults and bounds are declared here alone, so that a spec and its schema are read without importing torch.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, TypeAlias, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
)

from ddco_pyro.errors import nearest
from ddco_pyro.spec.base import Count, Emission, Items, Model, Problems, Share, Text, invalid, tag_of

USER_DEFINED = "module:Class"
_USER_DEFINED_PATTERN = r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"

Sizes = Annotated[
    Items[Count],
    BeforeValidator(
        lambda value: (value,) if type(value) is int else value, json_schema_input_type=Count | Items[Count]
    ),
]
"""Sizes of layers; a bare number is a single layer."""
Pool = Literal["mean", "flatten", "spatial_softmax"]
Activation = Literal["relu", "leaky_relu", "elu", "tanh"]


class Network(Model):
    """The settings that every network has."""

    network: str
    """The kind of network; ``module:Class`` for your own class."""
    inputs: Items[Text] = ()
    """Names of the observations that the network reads; empty: all of them."""
    emits: Items[Emission] = Field(default=(), min_length=1)
    """For policies: what they choose. The lowest level emits ``[control]``. Policies above emit ``options``
    (the default), ``control``, or both, which makes a hybrid policy."""

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the network's class."""
        return {key: getattr(self, key) for key in type(self).model_fields if key not in Network.model_fields}

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the observations that the network and its parts read; empty: all of them."""
        return self.inputs

    @property
    def hidden_sizes(self) -> tuple[int, ...]:
        """Sizes of the hidden layers; empty for networks without."""
        return getattr(self, "hidden", ())

    def problems(self) -> Problems:
        for name in get_args(Emission):
            if self.emits.count(name) > 1:
                yield "emits", f"{name!r} is given twice; keep one"

    @model_serializer(mode="wrap")
    def _without_empty(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        optional = ("inputs", "emits")
        return {key: value for key, value in serialize(self).items() if value or key not in optional}


class LinearSpec(Network):
    """A linear map."""

    network: Literal["linear"]


class ConstantSpec(Network):
    """A bias alone, which reads no observation."""

    network: Literal["constant"]

    def problems(self) -> Problems:
        yield from super().problems()
        if self.inputs:
            yield "inputs", "a constant reads no observation; leave it out"


class LayeredSpec(Network):
    """A network with hidden layers."""

    hidden: Sizes = (64,)
    """Sizes of the hidden or recurrent layers, first layer first; a bare number is a single layer."""


class MlpSpec(LayeredSpec):
    """A multi-layer perceptron."""

    network: Literal["mlp"] = "mlp"
    dropout: Share = 0.0
    """Probability with which a hidden unit is dropped in training."""
    activation: Activation = "relu"
    """Activation after every hidden layer and every convolution. A ``relu`` unit that is 0 for all
    observations gets no gradient and stays 0; ``leaky_relu`` (slope 0.01 below 0), ``elu`` and ``tanh`` keep
    a gradient."""


class PerTimestepSpec(MlpSpec):
    """A perceptron for each time step."""

    network: Literal["per_timestep"]  # type: ignore[assignment]


class ConvolutionLayer(Model):
    """One convolution, followed by the activation of its network."""

    filters: Count
    """Number of filters."""
    kernel: Count
    """Height and width of each filter, pixels."""
    stride: Count = 1
    """Pixels from one position of a filter to the next."""
    padding: int = Field(default=0, ge=0)
    """Zeros added on each side."""


class ConvSpec(MlpSpec):
    """Convolutions followed by a perceptron."""

    network: Literal["conv"]  # type: ignore[assignment]
    layers: Annotated[Items[ConvolutionLayer], Field(min_length=1)] = (
        ConvolutionLayer(filters=64, kernel=5, stride=2, padding=2),
    )
    """The convolutions, first layer first."""
    pool: Pool = "mean"
    """What is read of each map: the ``mean`` of 8 × 8 fields, all of the map (``flatten``), or the place
    where the map is active (``spatial_softmax``)."""
    standardize: bool = False
    """Whether each picture is shifted and scaled to mean 0 and standard deviation 1 over its pixels and
    channels."""


class LstmSpec(LayeredSpec):
    """An LSTM."""

    network: Literal["lstm"]
    over: TrunkSpec | None = None
    """The network whose last hidden layer the LSTM reads; null: the LSTM reads the vector observations."""
    hidden: Annotated[Sizes, Field(min_length=1)] = (64,)
    """Sizes of the recurrent layers, first layer first; a bare number is a single layer."""
    horizon: Count | None = None
    """Number of steps after which the state is reset, counted from a trajectory's first step; null: never."""

    @property
    def reads(self) -> tuple[str, ...]:
        return self.inputs or (self.over.reads if self.over else ())


class BranchesSpec(MlpSpec):
    """Several networks whose last hidden layers are joined by a perceptron."""

    network: Literal["branches"]  # type: ignore[assignment]
    of: dict[str, TrunkSpec] = Field(min_length=1)
    """A network for each observation, by the observation's name. A network under another name lists its
    observations in ``inputs``."""

    @property
    def reads(self) -> tuple[str, ...]:
        names = (name for key, branch in self.of.items() for name in branch.inputs or (key,))
        return self.inputs or tuple(dict.fromkeys(names))


class UserNetworkSpec(Network):
    """A network class of your own."""

    network: Annotated[str, Field(json_schema_extra={"pattern": _USER_DEFINED_PATTERN})]
    """The class, as ``module:Class``."""
    options: dict[str, Any] = Field(default={})
    """Keyword arguments of the class."""

    @property
    def settings(self) -> dict[str, Any]:
        return self.options

    @field_validator("network")
    @classmethod
    def _known(cls, name: str) -> str:
        if name == USER_DEFINED or not re.fullmatch(_USER_DEFINED_PATTERN, name):
            names = [*SETTINGS, USER_DEFINED]
            text = f"no network is called {name!r}{nearest(name, names)}; use one of {', '.join(names)}"
            raise invalid(("", text))
        return name


SETTINGS: dict[str, type[Network]] = {
    "linear": LinearSpec,
    "constant": ConstantSpec,
    "mlp": MlpSpec,
    "per_timestep": PerTimestepSpec,
    "conv": ConvSpec,
    "lstm": LstmSpec,
    "branches": BranchesSpec,
}
"""The built-in networks by name; any other name is a :class:`UserNetworkSpec`."""


def foreign_keys(network: str) -> tuple[str, ...]:
    """The settings of other networks that do not apply to ``network``."""
    kinds: tuple[type[Network], ...] = (*SETTINGS.values(), UserNetworkSpec)
    own = SETTINGS.get(network, UserNetworkSpec).model_fields
    return tuple(dict.fromkeys(key for kind in kinds for key in kind.model_fields if key not in own))


def _tag(value: Any) -> str:
    name = value.get("network", "mlp") if isinstance(value, dict) else getattr(value, "network", "mlp")
    return tag_of(SETTINGS.get(name, UserNetworkSpec) if isinstance(name, str) else UserNetworkSpec)


def _emits_nothing(network: Network) -> Network:
    if network.emits:
        raise invalid(("emits", "is a setting of policies; leave it out"))
    return network


def _has_features(network: Network) -> Network:
    if network.network == "constant":
        raise invalid(("network", "a constant has no features for others to read; use linear or mlp"))
    return network


PolicySpec: TypeAlias = Annotated[
    Annotated[LinearSpec, Tag(tag_of(LinearSpec))]
    | Annotated[ConstantSpec, Tag(tag_of(ConstantSpec))]
    | Annotated[MlpSpec, Tag(tag_of(MlpSpec))]
    | Annotated[PerTimestepSpec, Tag(tag_of(PerTimestepSpec))]
    | Annotated[ConvSpec, Tag(tag_of(ConvSpec))]
    | Annotated[LstmSpec, Tag(tag_of(LstmSpec))]
    | Annotated[BranchesSpec, Tag(tag_of(BranchesSpec))]
    | Annotated[UserNetworkSpec, Tag(tag_of(UserNetworkSpec))],
    Discriminator(_tag),
]
"""A network that is a policy: its setting ``emits`` says what the policy chooses."""

NetworkSpec: TypeAlias = Annotated[PolicySpec, AfterValidator(_emits_nothing)]
"""A network from observations to numbers, such as the parameters of a distribution or features."""

TrunkSpec: TypeAlias = Annotated[NetworkSpec, AfterValidator(_has_features)]
"""A network whose features another network reads."""

LstmSpec.model_rebuild()
BranchesSpec.model_rebuild()
