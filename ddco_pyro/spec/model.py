"""The model that a spec declares: a hierarchy of options, or a baseline without options that last."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer

from ddco_pyro.spec.base import Count, Emission, Items, Model, Problems, bare, nested
from ddco_pyro.spec.networks import LinearSpec, MlpSpec, Network, NetworkSpec, PolicySpec, TrunkSpec
from ddco_pyro.spec.settings import LearnedStd
from ddco_pyro.spec.training import OptimizerSpec

PERCEPTRONS = ("linear", "mlp")
HEADS = (*PERCEPTRONS, "constant")
"""The networks that can stand above a trunk."""

Termination = Annotated[
    NetworkSpec | Literal["always"],
    nested((Mapping, Network), NetworkSpec, "a network, such as {network: linear}, or always"),
]


class LevelSpec(Model):
    """One level of options."""

    name: str = Field(default="option", pattern=r"^[A-Za-z][\w-]*$")
    """Name of the level in reports and files: a letter, then letters, digits, ``_`` and ``-``."""
    count: Count
    """Number of options, k."""
    policy: PolicySpec = MlpSpec()
    """The options' policies, π: one network for each option."""
    termination: Termination = LinearSpec(network="linear")
    """The options' termination conditions, ψ: one network for each option. ``always``: ψ = 1, every option
    ends after every step; a single such level is a memoryless mixture of experts, with the meta-policy as its
    gate."""

    @property
    def lasts(self) -> bool:
        """Whether options can be active for more than one step."""
        return self.termination != "always"

    @property
    def networks(self) -> dict[str, Network]:
        """The networks of its options by key."""
        networks = {"policy": self.policy, "termination": self.termination}
        return {key: network for key, network in networks.items() if isinstance(network, Network)}


class HierarchySpec(Model):
    """Levels of options below a meta-policy."""

    trunk: TrunkSpec | None = None
    """A single network whose last hidden layer replaces the observations for all other networks, which then
    are ``linear``, ``mlp`` or ``constant``. Null: every network reads the observations."""
    levels: Items[LevelSpec] = Field(min_length=1)
    """The levels, lowest first."""
    meta_policy: PolicySpec = MlpSpec(emits=("options",))
    """The policy that selects from the highest level, η."""

    @property
    def networks(self) -> dict[str, Network]:
        """The networks above the trunk, or the observations, by key path."""
        levels = enumerate(self.levels)
        of_levels = {f"levels.{n}.{key}": one for n, level in levels for key, one in level.networks.items()}
        return {"meta_policy": self.meta_policy} | of_levels

    def read_by(self, level: int) -> tuple[str, ...]:
        """Names of the observations that the policies of a level read; empty: all of them.

        :param level: 1 for the lowest.
        """
        return (self.trunk or self.levels[level - 1].policy).reads

    @field_validator("levels")
    @classmethod
    def _selecting_below(cls, levels: tuple[LevelSpec, ...]) -> tuple[LevelSpec, ...]:
        policies = [_emitting(level.policy, "options" if n else "control") for n, level in enumerate(levels)]
        pairs = zip(levels, policies, strict=True)
        return tuple(level.model_copy(update={"policy": policy}) for level, policy in pairs)

    @field_validator("meta_policy")
    @classmethod
    def _selecting(cls, policy: PolicySpec) -> PolicySpec:
        return _emitting(policy, "options")

    def problems(self) -> Problems:
        first: dict[str, int] = {}
        for index, level in enumerate(self.levels):
            if first.setdefault(level.name, index) < index:
                other = first[level.name]
                text = f"{level.name!r} is also the name of level {other}; give each level its own"
                yield f"levels.{index}.name", text
        if self.levels[0].policy.emits != ("control",):
            yield "levels.0.policy.emits", "the lowest level emits the control and nothing else; leave it out"
        for place, head in self.networks.items() if self.trunk else ():
            if head.network not in HEADS:
                text = f"reads the trunk: use one of {', '.join(HEADS)}, got {head.network!r}"
                yield f"{place}.network", text
            elif head.inputs:
                yield f"{place}.inputs", "the trunk reads the observations; give inputs there"


def _emitting(policy: PolicySpec, default: Emission) -> PolicySpec:
    return policy if policy.emits else policy.model_copy(update={"emits": (default,)})


Kind = Literal["flat", "flat_equal", "per_timestep", "mixture"]


class BaselineSpec(Model):
    """A model to compare a hierarchy with: without options, or with options that do not last."""

    kind: Kind
    """``flat``: one policy for all time steps. ``flat_equal``: a flat policy whose hidden layers are scaled
    by one factor until the policy has as many parameters as the hierarchy. ``per_timestep``: one perceptron
    for each time step, with the settings in ``policy``. ``mixture``, in ``compare_with``: the hierarchy with
    all its networks except the terminations, so that every option ends after every step (ψ = 1)."""
    policy: NetworkSpec = MlpSpec()
    """The policy's network, π; a ``mixture`` has those of the hierarchy."""
    optimizer: OptimizerSpec | None = None
    """In ``compare_with``: settings that differ from ``training.optimizer`` for this baseline; null: none."""
    std: LearnedStd | None = None
    """In ``compare_with``: the σ of this baseline wherever σ is learned in ``control.std`` and
    ``control.parts``. Null: as in ``control``. The floor stays unless ``floor`` is given. With ``{learn:
    true, per_state: true}`` the σ of a flat policy depends on the state, as σ differs between options."""

    def problems(self) -> Problems:
        network = self.policy.network
        if self.kind == "flat_equal" and not self.policy.hidden_sizes:
            text = f"flat_equal widens hidden layers, and network {network!r} has none; give it some"
            yield "policy", f"{text}, such as {{network: mlp, hidden: [64]}}"
        if self.kind == "per_timestep" and network not in (*PERCEPTRONS, "per_timestep"):
            text = f"per_timestep has a perceptron for each step: use one of {', '.join(PERCEPTRONS)}"
            yield "policy.network", f"{text}, got {network!r}, or say kind: flat"
        if self.kind == "mixture" and "policy" in self.model_fields_set:
            yield "policy", "a mixture has the networks of the hierarchy; leave it out"

    @model_serializer(mode="wrap")
    def _without_foreign_keys(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        foreign = ("policy",) if self.kind == "mixture" else ()
        return {key: value for key, value in serialize(self).items() if key not in foreign}


Baseline = Annotated[BaselineSpec, bare("kind", Kind | BaselineSpec)]
