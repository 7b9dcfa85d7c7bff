"""Every setting is used by a spec, a study, a notebook, or what ``init`` writes, and there are at most so many."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import replace
from inspect import get_annotations
from pathlib import Path
from typing import Any, get_args, get_origin

import h5py
import numpy as np
import pytest
import yaml
from four_tasks import four_tasks
from random_demonstrations import numbered
from targets import targets, velocities

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.data.starting import Decided, starting_spec
from ddco_pyro.spec import BaselineSpec, HierarchySpec, Spec
from ddco_pyro.spec.base import Model
from ddco_pyro.spec.networks import SETTINGS, Network, UserNetworkSpec
from ddco_pyro.spec.spec import MODEL

ROOT = Path(__file__).parents[2]
MOST = 110
"""104, and those of tasks and libraries: ``where``, ``minus``, ``library`` with ``run``, ``ridge`` and ``spread``."""
PATH = re.compile(r"([a-z_]+(?:\.[a-z_0-9{}]+)*)(?:=(.*))?", re.DOTALL)
"""A key path, or ``path=value`` of ``--set``."""


def models_in(annotation: Any) -> Iterator[type[Model]]:
    """The models in a type such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, Model):
        yield annotation
    for argument in get_args(getattr(annotation, "__value__", annotation)):
        yield from models_in(argument)


def fields(model: type[Model]) -> dict[str, Any]:
    return {field.alias or name: field for name, field in model.model_fields.items()}


def setting(model: type[Model], key: str) -> str:
    """``Class.key``, of the class that declares the key first."""
    name = next(name for name, field in model.model_fields.items() if key in (field.alias, name))
    declaring = [one for one in model.__mro__ if name in get_annotations(one)]
    return f"{declaring[-1].__name__}.{key}"


def reachable(model: type[Model], found: dict[type[Model], None]) -> dict[type[Model], None]:
    if model not in found:
        found[model] = None
        for field in model.model_fields.values():
            for inner in models_in(field.annotation):
                reachable(inner, found)
    return found


MODELS = list(reachable(Spec, {}))
ALL = sorted({setting(model, key) for model in MODELS for key in fields(model)})


def meant(models: list[type[Model]], data: dict[str, Any]) -> list[type[Model]]:
    """Of these models, the one that a mapping is of: of networks the one that it names."""
    if any(issubclass(model, Network) for model in models):
        return [SETTINGS.get(str(data.get("network", "mlp")), UserNetworkSpec)]
    return models


def said(data: Any, models: list[type[Model]]) -> Iterator[str]:
    """The settings that plain data for one of these models gives."""
    if isinstance(data, list | tuple):
        for item in data:
            yield from said(item, models)
    elif isinstance(data, dict):
        for model in meant(models, data):
            known = fields(model)
            for key, value in data.items():
                if key in known:
                    yield setting(model, key)
                    named = get_origin(known[key].annotation) is dict and isinstance(value, dict)
                    yield from said([*value.values()] if named else value, list(models_in(known[key].annotation)))


def said_at(path: str, value: Any) -> Iterator[str]:
    """The settings that a key path with a value gives."""
    if path == MODEL:
        yield from said(value, [BaselineSpec if isinstance(value, dict) and "kind" in value else HierarchySpec])
        return
    models: list[type[Model]] = [Spec]
    for part in path.split("."):
        if part.isdecimal() or part.startswith("{"):
            continue
        owners = [model for model in models if part in fields(model)]
        if not owners:
            return
        yield from (setting(model, part) for model in owners[:1])
        models = [inner for model in owners for inner in models_in(fields(model)[part].annotation)]
    yield from said(value, models)


# --- where settings are given -----------------------------------------------------------------------------------------


def of_specs() -> Iterator[tuple[str, str]]:
    for path in [*sorted((ROOT / "specs").glob("*.yaml")), *sorted((ROOT / "tasks").glob("*/demo.yaml"))]:
        for one in said(yaml.safe_load(path.read_text()), [Spec]):
            yield one, f"{path.parent.name}/{path.name}"


def of_studies() -> Iterator[tuple[str, str]]:
    """What declarations say of the spec: a method of the world itself has settings of its own."""
    for path in sorted((ROOT / "studies").glob("*.yaml")):
        declared = yaml.safe_load(path.read_text())
        changes = list((declared.get("overrides") or {}).items())
        for method in (own or {} for own in declared["methods"].values()):
            if "by" not in method:
                changes += [*method.get("overrides", {}).items()]
                changes += [(key, value) for key, values in method.get("grid", {}).items() for value in values]
                baseline = method.get("baseline")
                changes += [(MODEL, baseline)] if isinstance(baseline, dict) else []
        for key, value in changes:
            for one in said_at(key, value):
                yield one, f"studies/{path.name}"


def literal(node: ast.AST) -> Any:
    """Plain data of a mapping or a text: what is computed is 0."""
    if isinstance(node, ast.Dict):
        pairs = zip(node.keys, node.values, strict=True)
        return {key.value: literal(value) for key, value in pairs if isinstance(key, ast.Constant)}
    if isinstance(node, ast.JoinedStr):
        return "".join(str(literal(part)) for part in node.values)
    return node.value if isinstance(node, ast.Constant) else 0


def of_scripts() -> Iterator[tuple[str, str]]:
    """Key paths, their values, mappings whose keys one part of a spec alone has, and whole specs."""
    for path in sorted(path for folder in ("notebooks", "studies") for path in (ROOT / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            data, found = literal(node), []
            if isinstance(data, dict):
                having = [model for model in MODELS if data and data.keys() <= fields(model).keys()]
                found += said(data, having) if len(having) == 1 else []
                found += [one for item in data.items() if "." in "".join(data) for one in said_at(*item)]
            elif isinstance(node, ast.JoinedStr) and "\nobservations:" in data:
                found += said(yaml.safe_load(data), [Spec])
            elif match := PATH.fullmatch(str(data)):
                found += said_at(match[1], None) if "." in match[1] else []
            for one in found:
                yield one, path.relative_to(ROOT).as_posix()


def of_init(folder: Path) -> Iterator[tuple[str, str]]:
    """What ``init`` writes for vectors with angles and quaternions, labels, few demonstrations, targets."""
    random, steps = np.random.default_rng(0), 30
    turns = []
    for _ in range(12):
        quaternions = np.cumsum(random.normal(size=(steps, 4)), axis=0)
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        angles = np.angle(np.exp(1j * np.cumsum(random.uniform(0, 1, size=(steps, 1)), axis=0)))
        turns.append(({"turn": quaternions, "angle": angles}, random.normal(size=(steps, 2))))
    operators = (replace(demo, attributes={"operator": n % 3}) for n, demo in enumerate(pick_and_place(12)))
    files = {
        "vectors": numbered(turns),
        "few demonstrations": pick_and_place(4),
        "labels": Demonstrations(tuple(operators)),
        "targets": targets(velocities(4)),
        "tasks": four_tasks(4),
    }
    for name, demos in files.items():
        path = folder / f"{name}.hdf5"
        demos.write(path)
        if name == "labels":
            with h5py.File(path, "r+") as file:
                file["data/demo_3/actions"][2] = np.nan
            texts = [starting_spec(inspect(path), path, "operator", Decided(0.05, True, 5, "", (0, 1))).text]
        else:
            texts = [starting_spec(inspect(path), path).text]
        for one in (one for text in texts for one in said(yaml.safe_load(text), [Spec])):
            yield one, f"init ({name})"


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The first place where each setting is used."""
    found: dict[str, str] = {}
    init = of_init(tmp_path_factory.mktemp("init"))
    for given in (of_specs(), init, of_studies(), of_scripts()):
        for one, place in given:
            found.setdefault(one, place)
    return found


def test_every_setting_is_used(places: dict[str, str]) -> None:
    """And no more than these. A setting is a key that a spec can have, counted once for the class that declares it
    first. So a network, or a σ, is the same wherever it stands; ``network`` is one setting of all networks, and
    ``hidden`` of those with layers; ``kind`` and ``std`` of a part are those of the control.
    """
    print(*(f"{one:40} {places.get(one, 'nowhere')}" for one in ALL), sep="\n")
    assert [one for one in ALL if one not in places] == []
    assert len(ALL) <= MOST, f"{len(ALL)} settings"
