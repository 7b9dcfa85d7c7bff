"""What a spec gives a user's network, checked against the signature of its class."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from inspect import Parameter
from typing import Any

from pydantic import PydanticUserError, TypeAdapter, ValidationError
from pydantic_core import to_json
from torch import nn

from ddco_pyro.errors import nearest
from ddco_pyro.spec import SpecError
from ddco_pyro.spec.base import in_words, show

POSITIONAL = 3
"""Shape, outputs and copies come first in the constructor of every network; what follows are its options."""


def checked_options(network: type[nn.Module], options: Mapping[str, Any]) -> dict[str, Any]:
    """The options for ``network(shape, outputs, copies, **options)``, of the types that it is annotated with: a list
    becomes a tuple where that is one.

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
    named = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    accepted = {parameter.name: parameter for parameter in parameters[POSITIONAL:] if parameter.kind in named}
    return accepted, any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters)


def _annotation(network: type[nn.Module], parameter: Parameter) -> Any:
    """The type that a parameter is annotated with; Any where there is none, or its name means nothing at run time."""
    if parameter.annotation is Parameter.empty:
        return Any
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    try:
        return eval(parameter.annotation, inspect.unwrap(network.__init__).__globals__)  # type: ignore[attr-defined]
    except Exception:  # such as a name that is imported for type checkers alone
        return Any


def _typed(value: Any, annotation: Any) -> Any:
    """The value as this type. Read as JSON, because strict types take a list for a tuple there alone."""
    if annotation is Any:
        return value
    try:
        adapter = TypeAdapter(annotation)
    except (PydanticUserError, NameError):  # a class that pydantic cannot make, or an unknown name within the type
        return value
    return adapter.validate_json(to_json(value, inf_nan_mode="constants"), strict=True)


def _mistyped(place: str, value: Any, annotation: Any, error: ValidationError) -> str:
    """Where and what is wrong in one line; a union has several errors, and is named itself."""
    details = error.errors()
    if len(details) > 1:
        return f"{place}: must be {inspect.formatannotation(annotation)}, got {show(value)}"
    return f"{'.'.join([place, *map(str, details[0]['loc'])])}: {in_words(details[0])}"
