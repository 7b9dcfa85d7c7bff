"""Every setting is used by a spec, study, notebook, or what ``init`` writes; there are at most this many."""

import re
from collections.abc import Iterator
from inspect import get_annotations
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
import yaml

from ddco_pyro.spec import Spec
from ddco_pyro.spec.base import Model
from ddco_pyro.spec.networks import SETTINGS, Network, UserNetworkSpec

ROOT = Path(__file__).parents[2]
MOST = 110
"""104, and those of tasks and libraries: ``where``, ``minus``, ``library`` with ``run``, ``ridge`` and
``spread``.
"""


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
                    inner = [*value.values()] if named else value
                    yield from said(inner, list(models_in(known[key].annotation)))


ELSEWHERE = {
    "ddco_pyro/data/starting.yaml.j2": (
        "BaselineSpec.std",
        "ControlSpec.relative_to",
        "DemonstrationsSpec.exclude",
        "DemonstrationsSpec.hold_out_by",
        "LearnedStd.per_state",
        "ObservationSpec.angles",
        "ObservationSpec.quaternions",
    ),
    "notebooks/02_how_many_options.py": ("Spec.selection", "SelectionSpec.folds", "SelectionSpec.grid"),
    "notebooks/09_bayesian_options.py": ("Spec.inference",),
    "studies/arena.yaml": ("RidgeSpec.gate", "RidgeSpec.policy"),
    "studies/cells.py": ("Spec.seed", "TrainingSpec.seed"),
    "studies/library.yaml": (
        "LibrarySpec.ridge",
        "LibrarySpec.run",
        "LibrarySpec.spread",
        "TrainingSpec.library",
    ),
    "studies/people.py": ("LabelsSpec.recogniser", "RecogniserSpec.ridge", "RecogniserSpec.weight"),
}
"""What no spec uses, but a study, a notebook, or what ``init`` writes."""


@pytest.fixture(scope="module")
def places() -> dict[str, str]:
    """The first place where each setting is used."""
    found: dict[str, str] = {}
    for path in [*sorted((ROOT / "specs").glob("*.yaml")), *sorted((ROOT / "tasks").glob("*/demo.yaml"))]:
        for one in said(yaml.safe_load(path.read_text()), [Spec]):
            found.setdefault(one, f"{path.parent.name}/{path.name}")
    for place, used in ELSEWHERE.items():
        text = (ROOT / place).read_text()
        for one in used:
            assert re.search(rf'["\.\s{{]{one.rpartition(".")[2]}["=:.]', text), f"{one} is not in {place}"
            assert found.setdefault(one, place) == place, f"{one} is in a spec"
    return found


def test_every_setting_is_used(places: dict[str, str]) -> None:
    """And no more than these. A setting is a key that a spec can have, counted once for the class that
    declares it first. So a network, or a σ, is the same wherever it stands; ``network`` is one setting of all
    networks, and ``hidden`` of those with layers; ``kind`` and ``std`` of a part are those of the control.
    """
    print(*(f"{one:40} {places.get(one, 'nowhere')}" for one in ALL), sep="\n")
    assert [one for one in ALL if one not in places] == []
    assert len(ALL) <= MOST, f"{len(ALL)} settings"
