"""The networks that a spec can name, and the policies made of them."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from ddco_pyro.spec.messages import invalid, nearest
from ddco_pyro.spec.types import Count, Emission, Items, Model, NetworkName, Share

CUSTOM = "module:Class"
NETWORK_KEYS: dict[str, tuple[str, ...]] = {
    "linear": (),
    "mlp": ("hidden", "dropout"),
    "per_timestep": ("hidden", "dropout"),
    "conv": ("hidden", "dropout", "filters", "kernel"),
    CUSTOM: ("options",),
}
_SETTINGS = ("hidden", "dropout", "filters", "kernel", "options")


def foreign_keys(network: Any) -> tuple[str, ...]:
    """The settings that do not apply to a network of this kind."""
    known = NETWORK_KEYS.get(network, NETWORK_KEYS[CUSTOM]) if isinstance(network, str) else _SETTINGS
    return tuple(key for key in _SETTINGS if key not in known)


class NetworkSpec(Model):
    """A network from observations to the parameters of a distribution. Settings of other networks are refused."""

    network: NetworkName = "mlp"
    """``linear``, ``mlp``, ``per_timestep``, ``conv``, or ``module:Class`` for a network of your own."""
    hidden: Items[Count] = Field(
        default_factory=lambda data: () if "hidden" in foreign_keys(data.get("network")) else (64,)
    )
    """Sizes of the hidden layers, first one first (``mlp``, ``per_timestep`` and ``conv``; default [64])."""
    dropout: Share = 0.0
    """Probability with which a unit is dropped while training."""
    filters: Count = 64
    """Number of filters of each convolution (``conv``)."""
    kernel: Count = 5
    """Height and width of each filter in pixels (``conv``)."""
    options: dict[str, Any] = Field(default={})
    """Keyword arguments of the class (``module:Class``)."""

    @field_validator("network")
    @classmethod
    def _known_network(cls, name: str) -> str:
        if name == CUSTOM or (name not in NETWORK_KEYS and not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", name)):
            names = ", ".join(NETWORK_KEYS)
            raise invalid(("", f"no network is called {name!r}{nearest(name, NETWORK_KEYS)}; use one of {names}"))
        return name

    @model_validator(mode="after")
    def _settings_apply(self) -> NetworkSpec:
        given = [key for key in foreign_keys(self.network) if key in self.model_fields_set]
        if given:
            raise invalid(*((key, f"does not apply to network {self.network!r}; leave it out") for key in given))
        return self

    @model_serializer(mode="wrap")
    def _without_foreign_keys(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = serialize(self)
        return {key: value for key, value in fields.items() if key not in foreign_keys(self.network)}


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
