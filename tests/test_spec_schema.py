"""Writing and reading a spec changes nothing, and the schema accepts what is accepted."""

from __future__ import annotations

from typing import Any

import jsonschema
import pytest
import yaml
from example_specs import EXAMPLE, SMALL
from hypothesis import given, settings
from hypothesis import strategies as st

from ddco_pyro.spec import (
    Spec,
    SpecError,
    dump_spec,
    load_spec,
    parse_spec,
    spec_schema,
)
from ddco_pyro.spec.spec import edited

counts = st.integers(1, 10**6)
positive = st.floats(1e-300, 1e30)
shares = st.floats(0, 1, exclude_max=True)
texts = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8
) | st.sampled_from(["1e-3", ".5", "null", "yes", "1", "a: b", "- c", "~", "#", "2020-01-01"])
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)
perceptrons = st.fixed_dictionaries({}, optional={"hidden": counts | st.lists(counts, max_size=3), "dropout": shares})
networks = st.one_of(
    perceptrons,
    st.fixed_dictionaries(
        {"network": st.just("branches"), "of": st.dictionaries(texts, perceptrons, min_size=1, max_size=2)}
    ),
    st.fixed_dictionaries(
        {"network": st.just("lstm")},
        optional={
            "over": st.none() | perceptrons,
            "hidden": st.lists(counts, min_size=1),
            "horizon": st.none() | counts,
            "inputs": st.lists(texts),
        },
    ),
    st.fixed_dictionaries({"network": st.just("linear")}),
    st.fixed_dictionaries(
        {}, optional={"network": st.just("per_timestep"), "hidden": st.lists(counts, max_size=3), "dropout": shares}
    ),
    st.fixed_dictionaries(
        {"network": st.just("conv")}, optional={"filters": counts, "kernel": counts, "hidden": st.lists(counts)}
    ),
    st.fixed_dictionaries(
        {"network": st.just("a.b:C")}, optional={"options": st.dictionaries(texts, values, max_size=3)}
    ),
)
emissions = st.lists(st.sampled_from(["options", "control"]), min_size=1, unique=True)


@st.composite
def hierarchies(draw: st.DrawFn) -> dict[str, Any]:
    levels = []
    for index in range(draw(st.integers(1, 3))):
        policy = dict(draw(networks))
        if index:
            policy["emits"] = draw(emissions)
        level = {"name": f"level-{index}", "count": draw(counts), "policy": policy, "termination": draw(networks)}
        if draw(st.booleans()):
            heads = {"policy": policy | draw(perceptrons), "termination": {"network": "linear"}}
            level |= heads | {"trunk": draw(networks)} if set(policy) <= {"emits", "hidden", "dropout"} else {}
        levels.append(level)
    return {"levels": levels, "meta_policy": {**draw(networks), "emits": draw(emissions)}}


@st.composite
def specs(draw: st.DrawFn) -> dict[str, Any]:
    baselines = st.sampled_from(["flat", "per_timestep"]) | st.fixed_dictionaries(
        {"kind": st.just("flat"), "policy": networks}
    )
    equal = st.just("flat_equal") | st.fixed_dictionaries(
        {
            "kind": st.just("flat_equal"),
            "policy": st.fixed_dictionaries({"hidden": st.lists(counts, min_size=1, max_size=3)}),
        }
    )
    observation = texts | st.fixed_dictionaries({"key": texts}, optional={"differences": st.booleans()})
    names = st.lists(observation, min_size=1, max_size=3, unique_by=lambda o: o if isinstance(o, str) else o["key"])
    std = positive | st.fixed_dictionaries({"learn": st.just(True)}, optional={"floor": positive})
    scale = st.sampled_from(["standardize", "none"]) | st.lists(positive, min_size=1, max_size=3)
    model = {"hierarchy": draw(hierarchies())} if draw(st.booleans()) else {"baseline": draw(baselines)}
    return {
        "demonstrations": {"path": draw(texts), "valid_fraction": draw(st.floats(0.01, 0.99))},
        "observations": draw(names),
        "control": {"std": draw(std), "scale": draw(scale)},
        **model,
        "compare_with": draw(st.lists(baselines | equal, max_size=2)),
        "training": {
            "epochs": draw(counts),
            "patience": draw(st.none() | counts),
            "clip_gradient": draw(st.none() | positive),
            "average": draw(st.none() | st.floats(0.01, 0.99)),
        },
        "selection": {"grid": draw(st.sampled_from([{}, {"seed": [1, 2]}, {"control.std": [0.1, {"learn": True}]}]))},
        "rollout": {"policies": draw(st.lists(texts, max_size=2))},
        "seed": draw(st.integers(0, 2**32 - 1)),
    }


@settings(max_examples=20)
@given(specs())
def test_what_is_written_is_read_as_it_was(tmp_path_factory: pytest.TempPathFactory, data: dict[str, Any]) -> None:
    spec = parse_spec(data)
    path = tmp_path_factory.mktemp("spec") / "spec.yaml"
    path.write_text(dump_spec(spec), encoding="utf-8")
    assert load_spec(path, allow_code=True) == spec


def test_all_defaults_are_written() -> None:
    written = yaml.safe_load(dump_spec(parse_spec(SMALL)))
    assert written["training"]["optimizer"] == {
        "name": "adam", "ridge": {"policy": 1.0, "gate": 1.0, "termination": 1.0}, "lr": 1e-3, "schedule": "constant",
        "warmup": 0, "momentum": 0.9, "weight_decay": 0.0,
    }  # fmt: skip
    assert written["hierarchy"]["levels"][0]["termination"] == {"network": "linear"}
    assert set(written) == set(Spec.model_fields)


VALIDATOR = jsonschema.Draft202012Validator(spec_schema())


@settings(max_examples=50)
@given(specs())
def test_the_schema_accepts_what_is_accepted(data: dict[str, Any]) -> None:
    VALIDATOR.validate(data)


@pytest.mark.parametrize(
    "network", [{"network": "mpl"}, {"hidden": [0]}, {"hiden": [3]}, {"dropout": 1}, {"network": "conv", "kernel": 1.5}]
)
def test_the_schema_refuses_networks_that_are_refused(network: dict[str, Any]) -> None:
    VALIDATOR.validate(SMALL)
    wrong = edited(SMALL, {"hierarchy.levels.0.policy": network})
    with pytest.raises(SpecError):
        parse_spec(wrong)
    assert not VALIDATOR.is_valid(wrong)


def described(schema: dict[str, Any]) -> list[str]:
    """The names of the properties without a description."""
    models = [schema, *schema["$defs"].values()]
    fields = [(name, field) for model in models for name, field in model["properties"].items()]
    return [name for name, field in fields if not {"description", "$ref", "const"} & set(field)]


def test_the_schema_knows_the_keys_of_the_example() -> None:
    schema = spec_schema()
    example = yaml.safe_load(EXAMPLE)
    assert set(example) <= set(schema["properties"])
    assert set(example["training"]) <= set(schema["$defs"]["TrainingSpec"]["properties"])
    assert {*example["hierarchy"]["levels"][0], "trunk"} == set(schema["$defs"]["LevelSpec"]["properties"])
    assert schema["required"] == ["observations"]
    assert schema["additionalProperties"] is False
    assert schema["$defs"]["LevelSpec"]["properties"]["count"]["minimum"] == 1
    assert described(schema) == []
