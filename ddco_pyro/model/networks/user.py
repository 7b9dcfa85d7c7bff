"""A user's network, ``module:Class``: imported, made with checked options, tried, and adapted to the built-in ones."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from inspect import Parameter
from pkgutil import resolve_name
from typing import Any, Self

from pydantic import PydanticUserError, TypeAdapter, ValidationError
from pydantic_core import to_json
from torch import Tensor, nn

from ddco_pyro.errors import nearest
from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.perceptrons import Network, State
from ddco_pyro.model.networks.probe import try_network
from ddco_pyro.spec import SpecError
from ddco_pyro.spec.base import in_words, show

POSITIONAL = 3
"""A user's class is made as ``Class(shape, outputs, copies, **options)``: the first three are no options."""


class UserNetwork(Network):
    """A user's module as a :class:`Network`.

    The module maps :class:`Inputs` to [N, T, copies, outputs]. One with ``initial_state(N)`` is called with inputs and
    a state, and gives outputs and the state after them.
    """

    def __init__(self, module: nn.Module, outputs: int, copies: int) -> None:
        super().__init__()
        self.module, self.copies, self.outputs = module, copies, outputs
        self.remembers = hasattr(module, "initial_state")

    @classmethod
    def made(cls, name: str, shape: InputShape, outputs: int, copies: int, options: Mapping[str, Any]) -> Self:
        """The network of the class ``name``, tried on random observations.

        :raises ShapeError: the class cannot be imported or made, or its network is refused by :func:`try_network`.
        :raises SpecError: the options do not fit the signature of the class.
        """
        network_class = _imported(name)
        checked = checked_options(network_class, options)
        try:
            module = network_class(shape, outputs, copies, **checked)
        except Exception as error:  # whatever the user's code raises
            raise ShapeError(f"network {name!r} cannot be made with options {options}: {error}") from error
        network = cls(module, outputs, copies)
        try_network(name, network, shape)
        return network

    @property
    def features(self) -> int:
        """The outputs."""
        return self.outputs

    def initial_state(self, trajectories: int) -> State:
        """The module's own state."""
        return self.module.initial_state(trajectories) if self.remembers else ()  # type: ignore[operator, no-any-return]

    def forward(self, inputs: Inputs, state: State = ()) -> tuple[Tensor, State]:
        """What the module gives, and its state."""
        return self.module(inputs, state) if self.remembers else (self.module(inputs), state)

    def begin_at(self, outputs: int, value: float = 0.0) -> None:
        """Nothing: a user's outputs start where the module's own weights put them."""


def _imported(name: str) -> type[nn.Module]:
    try:
        network_class: Any = resolve_name(name)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {name!r} cannot be imported: {error}") from error
    if not (isinstance(network_class, type) and issubclass(network_class, nn.Module)):
        raise ShapeError(f"network {name!r} is not a torch.nn.Module class")
    return network_class


def checked_options(network: type[nn.Module], options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a user's class, as the types of its annotations; a list becomes a tuple where that is one.

    :raises SpecError: options are missing, unknown or of another type; a line for each, such as ``options.gain: ...``.
    """
    accepted, takes_any = _accepted(network)
    values, problems = dict(options), []
    for name, value in options.items():
        if name in accepted:
            annotation = _annotation(network, accepted[name])
            try:
                values[name] = _typed(value, annotation)
            except ValidationError as error:
                problems.append(_mistyped(f"options.{name}", value, annotation, error))
        elif not takes_any:
            known = ", ".join(accepted) or "none"
            problems.append(f"options.{name}: unknown option{nearest(name, accepted)}; the class takes: {known}")
    for name, parameter in accepted.items():
        if name not in options and parameter.default is Parameter.empty:
            problems.append(f"options.{name}: missing; it has to be given")
    if problems:
        raise SpecError(*problems)
    return values


def _accepted(network: type[nn.Module]) -> tuple[dict[str, Parameter], bool]:
    """The options that the class names, and whether it takes others too."""
    parameters = list(inspect.signature(network).parameters.values())
    by_name = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    accepted = {parameter.name: parameter for parameter in parameters[POSITIONAL:] if parameter.kind in by_name}
    return accepted, any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters)


def _annotation(network: type[nn.Module], parameter: Parameter) -> Any:
    """The type of a parameter; Any without an annotation, or where its name means nothing at run time."""
    if parameter.annotation is Parameter.empty:
        return Any
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    try:
        return eval(parameter.annotation, inspect.unwrap(network.__init__).__globals__)  # type: ignore[attr-defined]
    except Exception:  # such as a name that is imported for type checkers alone
        return Any


def _typed(value: Any, annotation: Any) -> Any:
    """The value as this type. It is read as JSON, because only there strict types take a list for a tuple."""
    if annotation is Any:
        return value
    try:
        adapter = TypeAdapter(annotation)
    except (PydanticUserError, NameError):  # a class that pydantic cannot make, or an unknown name within the type
        return value
    return adapter.validate_json(to_json(value, inf_nan_mode="constants"), strict=True)


def _mistyped(place: str, value: Any, annotation: Any, error: ValidationError) -> str:
    """The place and the problem in one line; the several errors of a union become one."""
    details = error.errors()
    if len(details) > 1:
        return f"{place}: must be {inspect.formatannotation(annotation)}, got {show(value)}"
    return f"{'.'.join([place, *map(str, details[0]['loc'])])}: {in_words(details[0])}"
