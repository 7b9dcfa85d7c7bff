"""Key paths such as ``hierarchy.levels.0.count``, in the plain data that YAML gives."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

from ddco_pyro.spec.messages import SpecError, show
from ddco_pyro.spec.networks import foreign_keys

_GRID = "selection.grid."
MODEL = "model"
"""As a key path it stands for the whole model, see :func:`_set_model`."""

OPTIONS = "options"
"""As a value of it: the hierarchy as it is."""

_BARE = {"observations": "key", "baseline": "kind", "compare_with": "kind"}


def edited(data: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain data with other values at some key paths.

    Another ``network`` drops the settings beside it that do not apply to it, unless ``values`` has them too.

    The key path ``model`` puts another model in the place of the whole: a baseline as in ``compare_with``, a list of
    levels, or a hierarchy; ``options`` stands for the hierarchy as it is.

    :raises SpecError: a key path leads nowhere.
    """
    copy: dict[str, Any] = plain(data)
    for path, value in values.items():
        if path == MODEL:
            _set_model(copy, plain(value))
            continue
        _set(copy, path, value)
        if path.endswith(".network"):
            _drop_foreign_keys(copy, path, keep=values)
    return copy


def _set_model(data: dict[str, Any], value: Any) -> None:
    """Another model in plain data; labels and durations stay where the model has options that they can be about."""
    if value == OPTIONS:
        return
    hierarchy = data.get("hierarchy") or {}
    if isinstance(value, list):
        data["hierarchy"] = {**hierarchy, "levels": value}
    elif isinstance(value, dict) and "kind" not in value:
        data["hierarchy"] = value
    elif not isinstance(value, str | dict):
        what = "options, a baseline such as flat or mixture, a list of levels, or a hierarchy"
        raise SpecError(f"{MODEL}: must be {what}, got {show(value)}")
    else:
        baseline = {"kind": value} if isinstance(value, str) else value
        data["compare_with"] = []
        levels = hierarchy.get("levels") or []
        if baseline["kind"] == "mixture" and levels and "count" not in baseline:
            named = baseline.get("levels") or [level.get("name", "option") for level in levels]
            for level in levels:
                if level.get("name", "option") in named:
                    level["termination"] = "always"
            gone = ["duration"] if all(level.get("termination") == "always" for level in levels) else []
        else:
            data |= {"hierarchy": None, "baseline": baseline}
            gone = ["duration", "labels"]
        for key in gone:
            (data.get("training") or {}).pop(key, None)


def plain(data: Any) -> Any:
    """A copy of plain data whose mappings and sequences can be edited."""
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    return [plain(value) for value in data] if isinstance(data, list | tuple) else data


def _set(data: dict[str, Any], path: str, value: Any) -> None:
    """Sets the value at a key path of plain data; mappings that are missing on the way are made."""
    node, last = _find(data, path)
    node[last] = value


def _drop_foreign_keys(data: dict[str, Any], path: str, keep: Container[str]) -> None:
    """Removes the settings beside the network at ``path`` that belong to another kind of network."""
    node, last = _find(data, path)
    for key in foreign_keys(node[last]):
        if path.removesuffix(last) + key not in keep:
            node.pop(key, None)


def _find(data: dict[str, Any], path: str) -> tuple[Any, Any]:
    """The mapping or list that holds what a key path leads to, and its key there."""
    parts = path.split(".")
    if path.startswith(_GRID):  # the keys of the grid have dots themselves
        parts = [*_GRID.split(".")[:-1], path.removeprefix(_GRID)]
    node: Any = data
    for depth, part in enumerate(parts[:-1]):
        key = _key(node, part, path)
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        if isinstance(node[key], str) and parts[0] in _BARE:
            node[key] = {_BARE[parts[0]]: node[key]}
        if not isinstance(node[key], dict | list):
            parent = ".".join(parts[: depth + 1])
            raise SpecError(f"{path}: cannot be set, because {parent} is {show(node[key])}; set the whole of {parent}")
        node = node[key]
    return node, _key(node, parts[-1], path)


def _key(node: Any, part: str, path: str) -> Any:
    """The key ``part`` of a mapping, or the index ``part`` of a list."""
    if isinstance(node, dict):
        return part
    if part.isdecimal() and int(part) < len(node):
        return int(part)
    raise SpecError(f"{path}: {part!r} is not the number of one of the {len(node)} items there (the first is 0)")
