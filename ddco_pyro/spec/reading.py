"""YAML in and out, and the JSON Schema of it. Nothing else reads YAML."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from ddco_pyro.spec.keypaths import plain
from ddco_pyro.spec.messages import SpecError, show
from ddco_pyro.spec.whole import Spec, parse_spec


class _Loader(yaml.SafeLoader):
    """Reads ``1e-3`` as a number, as YAML 1.2 does, and refuses a key given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key.value!r} is given twice", key.start_mark)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """Quotes the text that :class:`_Loader` would read as a number; repeats what is shared rather than use anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$|[-+]?\.[0-9]+$")
for _yaml in (_Loader, _Dumper):
    _yaml.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def load_spec(path: str | Path, overrides: Iterable[str] = ()) -> Spec:
    """The spec in a YAML file, after ``overrides`` such as ``"hierarchy.levels.0.count=3"`` (the value is YAML).

    :raises SpecError: the file cannot be read, is not YAML, or is not a valid spec; one line for each problem.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    try:
        data = read_yaml(content)
        if data is None:
            raise SpecError("the file is empty; it has to hold a spec")
        if not isinstance(data, dict):
            raise SpecError(f"the file holds {show(data)}, not a mapping (key: value)")
        return parse_spec(data, dict(_parse_override(text) for text in overrides))
    except SpecError as error:
        raise SpecError(*(f"{path}: {problem}" for problem in error.problems)) from None


def dump_spec(spec: Spec) -> str:
    """The spec as YAML with every default written out. Reading it again gives an equal spec."""
    return yaml.dump(
        spec.model_dump(), Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120
    )


def spec_schema() -> dict[str, Any]:
    """The JSON Schema of a spec file, for editors."""
    schema = Spec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ddco-pyro spec"}


def read_yaml(content: bytes | str) -> Any:
    """Plain data in YAML text.

    :raises SpecError: it is not YAML.
    """
    try:
        return plain(yaml.load(content, Loader=_Loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise SpecError(f"{where}not valid YAML: {error.problem or error.context}") from None
    except RecursionError:
        raise SpecError("not valid YAML: nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # not text, or a date or number that Python cannot hold
        raise SpecError(f"not valid YAML: {' '.join(str(error).split())}") from None


def _parse_override(text: str) -> tuple[str, Any]:
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise SpecError(f"override {text!r}: write it as key.path=value")
    try:
        return path.strip(), read_yaml(value)
    except SpecError as error:
        raise SpecError(f"override {text!r}: {error}") from None
