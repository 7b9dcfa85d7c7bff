"""What every part of the spec is made of: the strict and frozen base of the models, and the types of their values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, WrapValidator

from ddco_pyro.errors import nearest
from ddco_pyro.spec.messages import invalid, show

T = TypeVar("T")
Items = Annotated[tuple[T, ...], Field(strict=False)]  # strict would refuse the lists that YAML gives
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Positive = Annotated[float, Field(gt=0, le=1e30)]  # networks are float32, which ends at 3e38
Fraction = Annotated[float, Field(gt=0, lt=1)]
Share = Annotated[float, Field(ge=0, lt=1)]
Text = Annotated[str, Field(min_length=1)]
TASKS = "ddco_pyro.tasks"
"""The entry-point group under which installed packages register their tasks."""


@dataclass(frozen=True)
class Importable:
    """Marks text that can name code to import, ``module:name``, or what is registered in a group of entry points."""

    entry_points: str | None = None


TaskName = Annotated[Text, Importable(TASKS)]
NetworkName = Annotated[str, Importable()]
Emission = Literal["options", "control"]


class Model(BaseModel):
    """A part of the spec: nothing else than its keys, in the types they have, and frozen."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def bare(key: str, allowed: Any) -> BeforeValidator:
    """Reads a bare string as ``{key: that}``; ``allowed`` is the type that the JSON Schema shows."""
    return BeforeValidator(
        lambda value: {key: value} if isinstance(value, str) else value, json_schema_input_type=allowed
    )


def nested(kinds: tuple[type, ...], validate: Callable[[Any], Any], text: str, names: tuple[str, ...] = ()) -> Any:
    """For a union of something simple and something nested: values of these ``kinds`` are validated as the nested one
    alone, so that an error names the key in it; of others that are not valid ``text`` says what they must be.

    :param names: the names among what is simple, the nearest of which is suggested.
    """

    def choose(value: Any, validate_simple: Callable[[Any], Any]) -> Any:
        if isinstance(value, kinds):
            return validate(value)
        try:
            return validate_simple(value)
        except ValidationError:
            raise invalid(("", f"must be {text}, got {show(value)}{nearest(value, names)}")) from None

    return WrapValidator(choose)
