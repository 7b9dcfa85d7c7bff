"""Specs in YAML files, the JSON Schema of such files, and the user code that a spec names."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import yaml

from ddco_pyro.errors import path_of
from ddco_pyro.spec.base import TASKS, SpecError, show
from ddco_pyro.spec.spec import Spec, parse_spec, plain


class _Loader(yaml.SafeLoader):
    """Reads ``1e-3``, ``010`` (ten) and ``1:30`` (text) as YAML 1.2 does, and refuses duplicate keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                text = f"key {key.value!r} is given twice"
                raise yaml.constructor.ConstructorError(None, None, text, key.start_mark)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """Quotes text that :class:`_Loader` would read as a number, and writes no anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_WHOLE = re.compile(r"[-+]?(?:0x[0-9a-fA-F]+|[0-9][0-9_]*)$")
_NUMBER = re.compile(
    r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?$|[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+$"
    r"|[-+]?\.(?:inf|Inf|INF)$|\.(?:nan|NaN|NAN)$"
)
for _yaml in (_Loader, _Dumper):
    _yaml.yaml_implicit_resolvers = {  # in YAML 1.1, 010 is eight and 1:30 is ninety
        first: [(tag, pattern) for tag, pattern in known if tag not in (_INT, _FLOAT)]
        for first, known in _yaml.yaml_implicit_resolvers.items()
    }
    _yaml.add_implicit_resolver(_INT, _WHOLE, list("-+0123456789"))
    _yaml.add_implicit_resolver(_FLOAT, _NUMBER, list("-+.0123456789"))


def _whole(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    return int(text, 16 if "x" in text else 10)


_Loader.add_constructor(_INT, _whole)


def load_spec(path: str | Path, overrides: Iterable[str] = (), allow_code: bool = False) -> Spec:
    """The spec in a YAML file, after ``overrides`` such as ``"hierarchy.levels.0.count=3"``, a YAML value.

    Code that the spec names is not imported.

    >>> spec = ddco_pyro.load_spec("mine.yaml", ["hierarchy.levels.0.count=3"])
    >>> spec.hierarchy.levels[0].count, spec.training.batch_size
    (3, 16)

    :param allow_code: whether the spec may name user code (``module:name``), which its later use imports.
    :raises SpecError: the file cannot be read, is not YAML, is not a valid spec, or names code that is not
        allowed; one line for each problem.
    """
    data = read_mapping(path_of(path, "spec"), "spec")
    try:
        spec = parse_spec(data, dict(_parse_override(text) for text in overrides))
    except SpecError as error:
        raise SpecError(*(f"{path}: {problem}" for problem in error.problems)) from None
    if not allow_code:
        _refuse_user_code(spec, path)
    return spec


def read_mapping(path: str | Path, kind: str) -> dict[str, Any]:
    """The mapping in a YAML file.

    :param kind: what the file has to hold, for messages, such as ``spec``.
    :raises SpecError: the file cannot be read, is not YAML, or holds something else.
    """
    try:
        about = Path(path).stat()
        if not stat.S_ISREG(about.st_mode) or about.st_size > MOST_BYTES:
            raise SpecError(f"is no file of at most {MOST_BYTES // 1024} kB; a {kind} is a YAML file")
        data = read_yaml(Path(path).read_bytes())
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    except SpecError as error:
        raise SpecError(*(f"{path}: {problem}" for problem in error.problems)) from None
    if not isinstance(data, dict):
        raise SpecError(f"{path}: holds {show(data)}, not a mapping (key: value), as a {kind} is")
    return data


def dump_spec(spec: Spec) -> str:
    """The spec as YAML with all defaults written out; reading the YAML gives an equal spec."""
    return dump_yaml(spec.model_dump())


def dump_yaml(data: Any) -> str:
    """Plain data as YAML that :func:`read_yaml` reads back."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120
    )


def spec_schema() -> dict[str, Any]:
    """The JSON Schema of a spec file, for editors."""
    schema = Spec.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ddco-pyro spec"}


def read_yaml(content: bytes | str) -> Any:
    """Plain data in YAML text.

    :raises SpecError: the text is not YAML.
    """
    try:
        return plain(yaml.load(content, _Loader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise SpecError(f"{where}not valid YAML: {error.problem or error.context}") from None
    except RecursionError:
        raise SpecError("not valid YAML: nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not text, or a date or number out of range
        raise SpecError(f"not valid YAML: {' '.join(str(error).split())}") from None


MOST_BYTES = 256 * 1024
"""Largest spec file; an ordinary one has a few thousand bytes. Reading the largest takes seconds."""


def _parse_override(text: str) -> tuple[str, Any]:
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise SpecError(f"override {text!r}: write it as key.path=value")
    try:
        return path.strip(), read_yaml(value)
    except SpecError as error:
        raise SpecError(f"override {text!r}: {error}") from None


# --- user code ----------------------------------------------------------------------------------------------


def user_code(spec: Spec) -> dict[str, str]:
    """Key path to ``module:name`` of the code that using the spec imports: tasks and networks, not the grid.

    Tasks registered by installed packages are not user code.
    """
    return dict(_code_in(spec.model_dump(exclude={"selection"}), ""))


def _code_in(data: Any, place: str) -> Iterator[tuple[str, str]]:
    """Key paths, and the names there, of code in plain data at a key path of a spec."""
    if isinstance(data, Mapping | list | tuple):
        for key, below in data.items() if isinstance(data, Mapping) else enumerate(data):
            yield from _code_in(below, f"{place}.{key}" if place else str(key))
    elif place.rpartition(".")[2] in ("task", "network") and ":" in str(data) and not _is_registered(data):
        yield place, data


def _is_registered(name: str) -> bool:
    return name in entry_points(group=TASKS).names


def _refuse_user_code(spec: Spec, path: str | Path) -> None:
    """Refuse a spec that names user code, in its grid included."""
    tried = ((key, value) for key, values in spec.selection.grid.items() for value in values)
    grid = {f"selection.grid.{key}": name for key, value in tried for _, name in _code_in(value, key)}
    if places := user_code(spec) | grid:
        trust = "pass --allow-code if you trust it (in Python: allow_code=True)"
        named = [f"{place}: would import user code ({name})" for place, name in places.items()]
        raise SpecError(*(f"{path}: {problem}; {trust}" for problem in named))
