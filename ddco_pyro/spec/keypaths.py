"""Key paths such as ``hierarchy.levels.0.count``, in the plain data that YAML gives."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

from ddco_pyro.spec.messages import SpecError, show
from ddco_pyro.spec.networks import foreign_keys

_GRID = "selection.grid."
_BARE = {"observations": "key", "baseline": "kind", "compare_with": "kind"}


def edited(data: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of plain data with other values at some key paths.

    Another ``network`` drops the settings beside it that do not apply to it, unless ``values`` has them too.

    :raises SpecError: a key path leads nowhere.
    """
    copy: dict[str, Any] = plain(data)
    for path, value in values.items():
        _set(copy, path, value)
        if path.endswith(".network"):
            _drop_foreign_keys(copy, path, keep=values)
    return copy


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
