"""User code: what a spec names as ``module:name``, which using the spec would import and so execute."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_args

from ddco_pyro.spec.messages import SpecError
from ddco_pyro.spec.types import Importable, Model
from ddco_pyro.spec.whole import Spec, with_overrides


def user_code(spec: Spec) -> dict[str, str]:
    """Key path to ``module:name`` of all code that the spec's model and data would import, its grid left aside.

    What an installed package has registered is not a user's.
    """
    return dict(_named(spec, ""))


def refuse_user_code(spec: Spec, path: str | Path) -> None:
    """See that the spec names no user code, in its grid neither.

    :param path: the spec's file, for the message.
    :raises SpecError: it does; one line for each place.
    """
    places = dict(_named(spec, "")) | dict(_in_grid(spec))
    if places:
        raise SpecError(
            *(
                f"{path}: {place}: would import user code ({name}); pass --allow-code if you trust it "
                "(in Python: allow_code=True)"
                for place, name in places.items()
            )
        )


def _in_grid(spec: Spec) -> Iterator[tuple[str, str]]:
    """What the values of a selection's grid would import."""
    for path, values in spec.selection.grid.items():
        for value in values:
            candidate = with_overrides(spec, {"selection.grid": {}, path: value})
            yield from ((f"selection.grid.{path}", name) for name in dict(_named(candidate, "")).values())


def _named(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Key paths and names of user code below a part of the spec."""
    if isinstance(value, Model):
        for key, field in type(value).model_fields.items():
            below, part = f"{place}.{key}" if place else key, getattr(value, key)
            marks = [*field.metadata, *_metadata(field.annotation)]
            for mark in (mark for mark in marks if isinstance(mark, Importable)):
                if isinstance(part, str) and ":" in part and part not in _registered(mark):
                    yield below, part
            yield from _named(part, below)
    elif isinstance(value, tuple | Mapping):
        items = value.items() if isinstance(value, Mapping) else enumerate(value)
        for name, part in items:
            yield from _named(part, f"{place}.{name}")


def _registered(mark: Importable) -> set[str]:
    return {point.name for point in entry_points(group=mark.entry_points)} if mark.entry_points else set()


def _metadata(annotation: Any) -> Iterator[Any]:
    """What annotates a type such as ``Annotated[str, mark] | None``."""
    yield from getattr(annotation, "__metadata__", ())
    for argument in get_args(annotation):
        yield from _metadata(argument)
