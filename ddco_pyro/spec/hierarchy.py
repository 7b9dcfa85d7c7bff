"""The model that a spec declares: levels of options below a meta-policy, or a policy without options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from ddco_pyro.spec.messages import invalid
from ddco_pyro.spec.networks import MetaPolicySpec, NetworkSpec, PolicySpec
from ddco_pyro.spec.settings import LearnedStd
from ddco_pyro.spec.training import OptimizerSpec
from ddco_pyro.spec.types import Count, Emission, Items, Model, Text, bare, nested

HEADS = ("linear", "mlp")
"""The networks that can read a trunk."""

Reader = tuple[str, NetworkSpec]
"""Where a network stands, and its spec."""

ALWAYS: Literal["always"] = "always"
"""The termination of options that end after every step, ψ = 1."""

Termination = Annotated[
    NetworkSpec | Literal["always"],
    nested((Mapping, NetworkSpec), NetworkSpec.model_validate, "a network, such as {network: linear}, or always"),
]


class LevelSpec(Model):
    """One level of options."""

    name: str = Field(default="option", pattern=r"^[A-Za-z][\w-]*$")
    """Name of the level in reports and files; letters, digits, ``_`` and ``-``, a letter first."""
    count: Count
    """Number of options, k."""
    trunk: NetworkSpec | None = None
    """A network for each option whose last hidden layer is read by both ``policy`` and ``termination``, which then are
    ``linear`` or ``mlp``; null: each of them reads the observations."""
    policy: PolicySpec = PolicySpec()
    """The options' policies, π: one network for each option."""
    termination: Termination = NetworkSpec(network="linear")
    """The options' termination conditions, ψ: one network for each option; ``always``: ψ = 1, every option ends after
    every step. One such level is a memoryless mixture of experts, with the meta-policy as its gate."""

    @model_validator(mode="after")
    def _heads(self) -> LevelSpec:
        if self.trunk is not None:
            _check_readers(*self._own)
        return self

    @property
    def lasts(self) -> bool:
        """Whether options can be active for more than one step."""
        return self.termination != ALWAYS

    @property
    def readers(self) -> tuple[Reader, ...]:
        """The networks that read the observations, or the hierarchy's trunk."""
        return self._own if self.trunk is None else (("trunk", self.trunk),)

    @property
    def _own(self) -> tuple[Reader, ...]:
        """Policy and termination, where that is a network."""
        policy: Reader = ("policy", self.policy)
        return (policy,) if self.termination == ALWAYS else (policy, ("termination", self.termination))


def _check_readers(*heads: Reader) -> None:
    """See that networks can read a trunk."""
    for place, head in heads:
        if head.network not in HEADS:
            text = f"reads the trunk: use one of {', '.join(HEADS)}, got {head.network!r}"
            raise invalid((f"{place}.network", text))
        if head.inputs:
            raise invalid((f"{place}.inputs", "the trunk reads the observations; say it there"))


class HierarchySpec(Model):
    """Levels of options below a meta-policy."""

    trunk: NetworkSpec | None = None
    """A single network whose last hidden layer all others of the hierarchy read in place of the observations: trunks of
    the levels, policies and terminations without one, and the meta-policy, which then are ``linear`` or ``mlp``; null:
    each of them reads the observations."""
    levels: Items[LevelSpec] = Field(min_length=1)
    """The levels, lowest first."""
    meta_policy: MetaPolicySpec = MetaPolicySpec()
    """The policy that selects from the highest level, η."""

    def read_by(self, level: int) -> tuple[str, ...]:
        """Names of the observations that the policies of a level, 1 for the lowest, read; all of them where none is."""
        own = self.levels[level - 1]
        return (self.trunk or own.trunk or own.policy).reads

    @field_validator("levels")
    @classmethod
    def _consistent(cls, levels: tuple[LevelSpec, ...]) -> tuple[LevelSpec, ...]:
        problems = []
        first: dict[str, int] = {}
        for index, level in enumerate(levels):
            if level.name in first:
                text = f"{level.name!r} is also the name of level {first[level.name]}; give each level its own"
                problems.append((f"{index}.name", text))
            first.setdefault(level.name, index)
        if levels[0].policy.emits not in ((), ("control",)):
            problems.append(("0.policy.emits", "the lowest level emits the control and nothing else; leave it out"))
        if problems:
            raise invalid(*problems)
        return tuple(_with_emission(level, "options" if index else "control") for index, level in enumerate(levels))

    @model_validator(mode="after")
    def _heads(self) -> HierarchySpec:
        if self.trunk is not None:
            levels = (level.readers for level in self.levels)
            named = ((f"levels.{index}.{at}", head) for index, own in enumerate(levels) for at, head in own)
            _check_readers(*named, ("meta_policy", self.meta_policy))
            for index, level in enumerate(self.levels):
                if level.trunk is not None and level.trunk.shared:
                    text = "the hierarchy's trunk is what all options share; put these layers there"
                    raise invalid((f"levels.{index}.trunk.shared", text))
        return self


def _with_emission(level: LevelSpec, default: Emission) -> LevelSpec:
    emits = level.policy.emits or (default,)
    return level.model_copy(update={"policy": level.policy.model_copy(update={"emits": emits})})


Kind = Literal["flat", "flat_equal", "per_timestep", "mixture"]


_OF_A_MIXTURE = ("levels", "count", "meta_policy")


class BaselineSpec(Model):
    """A policy to compare a hierarchy with: one without options, or one whose options do not last."""

    kind: Kind
    """``flat``: one policy for all times; ``flat_equal``: the same with its hidden layers widened or narrowed, all by
    one factor, until it has as many parameters as the hierarchy; ``per_timestep``: one policy for each time step, a
    perceptron of the settings in ``policy``; ``mixture``: several policies of which the meta-policy chooses anew at
    every step (ψ = 1). In ``compare_with`` a mixture is the hierarchy with all its networks but the terminations."""
    policy: NetworkSpec = NetworkSpec()
    """The policy's network, π; of a ``mixture`` that stands alone that of each expert."""
    levels: Items[Text] = ()
    """Of a ``mixture`` in ``compare_with``: names of the levels whose options end after every step; empty: all."""
    count: Count | None = None
    """Of a ``mixture`` that stands alone: the number of experts."""
    meta_policy: MetaPolicySpec | None = None
    """Of a ``mixture`` that stands alone: the gate, which chooses the expert; null: the default network."""
    optimizer: OptimizerSpec | None = None
    """In ``compare_with``: what of ``training.optimizer`` is otherwise for this baseline, so that each model can have
    what suits it; null: nothing."""
    std: LearnedStd | None = None
    """In ``compare_with``: the σ of this baseline wherever σ is learned, in ``control.std`` and ``control.parts``. The
    floor stays unless it is given; null: as in ``control``. With ``{learn: true, per_state: true}`` a flat policy has a
    σ that depends on the state, as options that each have their own do."""

    @property
    def name(self) -> str:
        """What it is called in tables, if it is the only one of its kind."""
        return "_".join((self.kind, *self.levels))

    @property
    def as_hierarchy(self) -> HierarchySpec:
        """The hierarchy of a ``mixture`` that stands alone: one level, whose options end after every step."""
        assert self.count is not None  # it is asked for where this is read
        expert = LevelSpec(name="expert", count=self.count, policy=_policy(self.policy), termination=ALWAYS)
        return HierarchySpec(levels=(expert,), meta_policy=self.meta_policy or MetaPolicySpec())

    @model_validator(mode="after")
    def _can_be_widened(self) -> BaselineSpec:
        if self.kind == "flat_equal" and not self.policy.hidden:
            text = f"flat_equal widens hidden layers, and network {self.policy.network!r} has none; give it some"
            raise invalid(("policy", f"{text}, such as {{network: mlp, hidden: [64]}}"))
        return self

    @model_validator(mode="after")
    def _can_be_repeated(self) -> BaselineSpec:
        if self.kind == "per_timestep" and self.policy.network not in (*HEADS, "per_timestep"):
            text = f"per_timestep has a perceptron for each step: use one of {', '.join(HEADS)}"
            raise invalid(("policy.network", f"{text}, got {self.policy.network!r}, or say kind: flat"))
        return self

    @model_validator(mode="after")
    def _settings_apply(self) -> BaselineSpec:
        given = [key for key in _OF_A_MIXTURE if key in self.model_fields_set]
        if given and self.kind != "mixture":
            raise invalid(*((key, f"is a setting of mixture, not of {self.kind}; leave it out") for key in given))
        return self

    @model_serializer(mode="wrap")
    def _without_foreign_keys(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A mixture beside a hierarchy has the networks of that, and other kinds nothing of a mixture's."""
        foreign = ("policy", *_OF_A_MIXTURE[1:]) if self.kind == "mixture" else _OF_A_MIXTURE
        return {key: value for key, value in serialize(self).items() if key not in foreign}


def _policy(network: NetworkSpec) -> PolicySpec:
    return PolicySpec.model_validate(network.model_dump(exclude_unset=True))


Baseline = Annotated[BaselineSpec, bare("kind", Kind | BaselineSpec)]
