"""What is wrong with a spec, in words: one line for each problem, with the key path where it is."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from ddco_pyro.errors import BadInput, nearest


class SpecError(BadInput):
    """A spec that cannot be used. The message has one line for each problem; ``problems`` has them apart."""

    __module__ = "ddco_pyro.spec"  # where it is imported from, and what a traceback shows

    def __init__(self, *problems: str) -> None:
        super().__init__(*problems)
        self.problems = problems

    def __str__(self) -> str:
        return "\n".join(self.problems)


def invalid(*problems: tuple[str, str]) -> PydanticCustomError:
    """An error for keys below the one that a validator validates: ``(key path from there, what is wrong)``."""
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
    """One line for each problem that pydantic found in data for ``model``, the whole of which suggests other keys."""
    errors = error.errors()
    for detail in errors:
        if not _follows_from_another(detail, errors):
            yield from _lines_of(detail, model)


def _follows_from_another(error: ErrorDetails, errors: list[ErrorDetails]) -> bool:
    """A list is "too short" also when its items are not valid; a default may depend on a value that is not valid."""
    depth = len(error["loc"])
    below = any(other["loc"][:depth] == error["loc"] and len(other["loc"]) > depth for other in errors)
    return error["type"] == "default_factory_not_called" or (error["type"] == "too_short" and below)


def _lines_of(error: ErrorDetails, model: type[BaseModel]) -> Iterator[str]:
    parts = [str(part) for part in error["loc"] if part != "[key]"]
    path = ".".join(parts)
    if error["type"] == "spec":
        for below, text in error["ctx"]["problems"]:
            yield f"{'.'.join(filter(None, [path, below]))}: {text}"
    elif error["type"] == "extra_forbidden":
        yield f"{path}: unknown key; {_suggestion(parts, model)}"
    else:
        yield f"{path or 'spec'}: {in_words(error)}"


def in_words(error: ErrorDetails) -> str:
    """What is wrong with a value, without saying where it is."""
    kind = "invalid_key" if "[key]" in error["loc"] else error["type"]
    context = {
        key: f"{value:.15g}" if isinstance(value, float) else value for key, value in error.get("ctx", {}).items()
    }
    names = re.findall(r"'([^']*)'", context.get("expected", ""))
    context["names"] = " or ".join(names) or "true"
    expected = _MESSAGES.get(kind, error["msg"]).format(**context)
    return expected if kind == "missing" else f"{expected}, got {show(error['input'])}{nearest(error['input'], names)}"


def show(value: Any) -> str:
    """A value as the user may have written it, cut short."""
    text = {None: "null", True: "true", False: "false"}.get(value) if value is None or isinstance(value, bool) else None
    text = text or repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _suggestion(parts: list[str], whole: type[BaseModel]) -> str:
    """The valid key nearest to an unknown one: beside it, or of the same name elsewhere; else all that are valid."""
    *above, wrong = parts
    valid = [key for model in _models_at(above, whole) for key in _fields(model)]
    close = difflib.get_close_matches(wrong, valid, n=1)
    if close:
        return f"did you mean {'.'.join([*above, close[0]])}?"
    elsewhere = [path for path in _all_paths(whole) if path.rpartition(".")[2] == wrong]
    if elsewhere:
        return f"did you mean {elsewhere[0]}?"
    return f"valid here: {', '.join(valid)}"


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields by their keys."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _models_at(parts: list[str], whole: type[BaseModel]) -> list[type[BaseModel]]:
    """The models that a key path leads to."""
    models = [whole]
    for part in parts:
        if not part.isdecimal():
            fields = [fields[part] for fields in map(_fields, models) if part in fields]
            if fields:  # else it is a name in a mapping of models
                models = [inner for field in fields for inner in _models_in(field.annotation)]
    return models


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in a type such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _all_paths(model: type[BaseModel], prefix: str = "", above: tuple[type[BaseModel], ...] = ()) -> Iterator[str]:
    """Every key path below a model, with 0 for the place in a list; networks within networks are left out."""
    for name, field in _fields(model).items():
        yield prefix + name
        place = ".0" if get_origin(field.annotation) is tuple else ""
        for inner in _models_in(field.annotation):
            if not any(issubclass(outer, inner) for outer in (*above, model)):
                yield from _all_paths(inner, f"{prefix}{name}{place}.", (*above, model))
