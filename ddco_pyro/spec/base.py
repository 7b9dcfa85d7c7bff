"""The base of every part of the spec: the strict model, types of values, and errors in words."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from ddco_pyro.errors import BadInput, nearest

# --- types --------------------------------------------------------------------------------------------------

T = TypeVar("T")
Items = Annotated[tuple[T, ...], Field(strict=False)]  # strict would refuse the lists that YAML gives
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Positive = Annotated[float, Field(gt=0, le=1e30)]  # networks are float32, which ends at 3e38
Fraction = Annotated[float, Field(gt=0, lt=1)]
Share = Annotated[float, Field(ge=0, lt=1)]
Text = Annotated[str, Field(min_length=1)]
Emission = Literal["options", "control"]
TASKS = "ddco_pyro.tasks"
"""The entry-point group in which installed packages register tasks."""


Problems = Iterable[tuple[str, str]]
"""Pairs of a key path, relative to a part of the spec, and the problem there."""


class Model(BaseModel):
    """A part of the spec: frozen, without unknown keys, with strict types."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def problems(self) -> Problems:
        """The settings that do not go together."""
        return ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if problems := tuple(self.problems()):
            raise invalid(*problems)
        return self


def bare(key: str, allowed: Any) -> BeforeValidator:
    """A validator that reads a bare string as ``{key: string}``; the JSON Schema has the type ``allowed``."""

    def read(value: Any) -> Any:
        return {key: value} if isinstance(value, str) else value

    return BeforeValidator(read, json_schema_input_type=allowed)


def nested(kinds: tuple[type, ...], inner: Any, text: str, names: tuple[str, ...] = ()) -> WrapValidator:
    """A validator for a union of a simple type and ``inner``.

    Values of ``kinds`` are validated as ``inner`` alone, so that an error names the key inside. Of other
    invalid values the error says that they must be ``text``, and suggests the nearest of ``names``.
    """
    config = None if isinstance(inner, type) else Model.model_config
    adapter: TypeAdapter[Any] = TypeAdapter(inner, config=config)

    def choose(value: Any, validate_simple: ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, kinds):
            return adapter.validate_python(value)
        try:
            return validate_simple(value)
        except ValidationError:
            raise invalid(("", f"must be {text}, got {show(value)}{nearest(value, names)}")) from None

    return WrapValidator(choose)


# --- errors -------------------------------------------------------------------------------------------------


class SpecError(BadInput):
    """A spec that cannot be used. The message has one line for each of ``problems``."""

    __module__ = "ddco_pyro.spec"  # the public name, which tracebacks show

    def __init__(self, *problems: str) -> None:
        super().__init__(*problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


def invalid(*problems: tuple[str, str]) -> PydanticCustomError:
    """A validator's error about keys below its own: pairs of a relative key path and the problem."""
    return PydanticCustomError("spec", "the spec has problems", {"problems": problems})


_MESSAGES = {
    "literal_error": "must be {names}",
    "missing": "missing; it has to be given",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "string_type": "must be text",
    "bool_type": "must be true or false",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping (key: value)",
    "model_type": "must be a mapping (key: value)",
    "invalid_key": "a key must be text; put it in quotes",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "too_short": "must have at least {min_length} item(s)",
    "string_too_short": "must not be empty",
    "string_pattern_mismatch": "must be letters, digits, '_' or '-', a letter first",
}


def lines(error: ValidationError, model: type[BaseModel]) -> Iterator[str]:
    """One line with its key path for each problem that pydantic found in data for ``model``."""
    errors = error.errors()
    for detail in errors:
        depth = len(detail["loc"])
        below = any(other["loc"][:depth] == detail["loc"] and len(other["loc"]) > depth for other in errors)
        if detail["type"] == "too_short" and below:
            continue  # follows from another problem: invalid items also make a list too short
        path = _path(detail["loc"])
        if detail["type"] == "spec":
            for key, text in detail["ctx"]["problems"]:
                yield f"{'.'.join(filter(None, [path, key]))}: {text}"
        elif detail["type"] == "extra_forbidden":
            yield f"{path}: {_unknown(detail['loc'], model)}"
        else:
            yield f"{path or 'spec'}: {in_words(detail)}"


def tag_of(model: type[BaseModel]) -> str:
    """The tag of a model in a tagged union, which pydantic puts into key paths."""
    return f"[{model.__name__}]"


def _is_tag(part: int | str) -> bool:
    return isinstance(part, str) and part.startswith("[")  # "[key]" is pydantic's own


def _path(location: Sequence[int | str]) -> str:
    return ".".join(str(part) for part in location if not _is_tag(part))


def in_words(error: ErrorDetails) -> str:
    """The problem with a value, without its key path."""
    kind = "invalid_key" if "[key]" in error["loc"] else error["type"]
    given = error.get("ctx", {})
    context = {key: f"{value:.15g}" if isinstance(value, float) else value for key, value in given.items()}
    names = re.findall(r"'([^']*)'", context.get("expected", ""))
    context["names"] = " or ".join(names) or "true"
    expected = _MESSAGES.get(kind, error["msg"]).format(**context)
    got = f", got {show(error['input'])}{nearest(error['input'], names)}"
    return expected if kind == "missing" else expected + got


def show(value: Any) -> str:
    words = {None: "null", True: "true", False: "false"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _unknown(location: Sequence[int | str], whole: type[BaseModel]) -> str:
    """The problem with an unknown key; suggests the nearest valid key beside it, or lists all valid keys."""
    *above, wrong = location
    valid = [key for model in _models_at(above, whole) for key in _fields(model)]
    close = difflib.get_close_matches(str(wrong), valid, n=1)
    hint = f"did you mean {_path([*above, *close])}?" if close else f"valid here: {', '.join(valid)}"
    return f"unknown key; {hint}"


def _models_at(location: Sequence[int | str], whole: type[BaseModel]) -> list[type[BaseModel]]:
    models = [whole]
    for part in location:
        if _is_tag(part):
            models = [model for model in models if part == tag_of(model)] or models
        elif fields := [fields[str(part)] for fields in map(_fields, models) if part in fields]:
            models = [inner for field in fields for inner in _models_in(field.annotation)]
    return models


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in a type such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
