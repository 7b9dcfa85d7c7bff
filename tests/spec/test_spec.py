"""The spec: what it accepts, overrides, and files that hold none."""

import re
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from ddco_pyro.spec import (
    HierarchySpec,
    Spec,
    SpecError,
    dump_spec,
    load_spec,
    parse_spec,
    spec_schema,
    with_overrides,
)
from ddco_pyro.spec.spec import edited
from ddco_pyro.spec.yaml import read_yaml

EXAMPLE = """\
task: needle
demonstrations: {count: 100, seed: 0}
observations: [gripper_pose, needle_ellipse]
control: {std: 0.1}
hierarchy:
  levels:
    - name: option
      count: 5
      policy: {network: mlp, hidden: [64], dropout: 0.0}
      termination: {network: linear}
  meta_policy: {network: mlp, hidden: [64], emits: [options]}
training:
  starts: [vq]
  layerwise: true
  optimizer: {name: adam, lr: 1.0e-3}
  epochs: 200
  batch_size: 16
inference: fused
selection: {folds: 10, grid: {hierarchy.levels.0.count: [1, 2, 3, 4, 5, 6, 7, 8]}}
rollout: {episodes: 50}
seed: 0
"""

SMALL = {"task": "needle", "observations": ["pose"], "hierarchy": {"levels": [{"count": 5}]}}


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "spec.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


VALIDATOR = jsonschema.Draft202012Validator(spec_schema())
jsonschema.Draft202012Validator.check_schema(VALIDATOR.schema)


# --- what it accepts ----------------------------------------------------------------------------------------


def test_higher_levels_select_from_below_unless_told_otherwise() -> None:
    both = {"policy": {"emits": ["options", "control"]}}
    levels = [{"count": 2}, {"name": "b", "count": 2}, {"name": "c", "count": 2, **both}]
    spec = parse_spec(SMALL, {"hierarchy.levels": levels})
    emits = [level.policy.emits for level in spec.hierarchy.levels]
    assert emits == [("control",), ("options",), ("options", "control")]


OVER = {"network": "branches", "of": {"a": {"network": "conv"}}}


@pytest.mark.parametrize(
    ("level", "read"),
    [
        ({}, ()),
        ({"policy": {"inputs": ["a", "b"]}, "termination": {"inputs": ["b", "c"]}}, ("a", "b")),
        ({"policy": {"network": "branches", "of": {"a": {}, "x": {"inputs": ["c", "a"]}}}}, ("a", "c")),
        ({"policy": {"network": "lstm", "over": OVER}}, ("a",)),
        ({"policy": {"network": "lstm", "inputs": ["b"]}}, ("b",)),
    ],
)
def test_what_the_policies_of_a_level_read(level: dict[str, object], read: tuple[str, ...]) -> None:
    hierarchy = HierarchySpec.model_validate({"levels": [{"count": 2, **level}]})
    assert hierarchy.read_by(1) == read
    trunk = HierarchySpec.model_validate({"levels": [{"count": 2}], "trunk": {"inputs": ["c"]}})
    assert trunk.read_by(1) == ("c",)


# --- files --------------------------------------------------------------------------------------------------


DEEP = "not valid YAML: nested too deeply"


UNCLOSED = "line 3, column 1: not valid YAML: expected ',' or ']', but got '<stream end>'"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds null, not a mapping (key: value), as a spec is"),
        ("- a\n- b\n", "holds ['a', 'b'], not a mapping (key: value), as a spec is"),
        ("seed: 1\ntask: [a\n", UNCLOSED),
        ("seed: 1\ntask: a\nseed: 2\n", "line 3, column 1: not valid YAML: key 'seed' is given twice"),
        ("a: *b\n", "line 1, column 4: not valid YAML: found undefined alias 'b'"),
        pytest.param("[" * 1000, DEEP, id="opened"),
        ("a: &a [1, *a]", DEEP),
        ("seed: !!python/name:os.system\n", "could not determine a constructor for the tag"),
        (b"\x89HDF\r\n\x1a\n\x00\x00", "not valid YAML: "),
        ("seed: 2024-13-45\n", "not valid YAML: "),
    ],
)
def test_files_that_hold_no_spec(tmp_path: Path, text: str | bytes, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(SpecError) as caught:
        load_spec(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- overrides ----------------------------------------------------------------------------------------------


def test_overrides_are_applied_to_the_file(tmp_path: Path) -> None:
    overrides = ["hierarchy.levels.0.count=3", "training.optimizer.lr=1e-2"]
    overrides.append("observations.1.differences=true")
    spec = load_spec(write(tmp_path, EXAMPLE), [*overrides, "rollout={episodes: 2, policies: [open_loop]}"])
    assert spec.hierarchy.levels[0].count == 3
    assert spec.training.optimizer.lr == 0.01
    assert (spec.observations[1].key, spec.observations[1].differences) == ("needle_ellipse", True)
    assert (spec.rollout.episodes, spec.rollout.policies) == (2, ("open_loop",))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed", "override 'seed': write it as key.path=value"),
        ("seed=[1", "override 'seed=[1': line 1, column 3: not valid YAML"),
        ("control.std.learn=true", "control.std.learn: cannot be set, because control.std is 0.1"),
        ("observations.x.key=a", "observations.x.key: 'x' is not the number of one of the 2 items there"),
    ],
)
def test_overrides_that_cannot_be_applied(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(SpecError, match=re.escape(message)):
        load_spec(write(tmp_path, EXAMPLE), [override])


def test_with_overrides_leaves_the_original_alone(tmp_path: Path) -> None:
    spec = load_spec(write(tmp_path, EXAMPLE))
    before = dump_spec(spec)
    changes = {"hierarchy.levels.0.count": 2, "selection.grid.hierarchy.levels.0.count": [2, 3]}
    other = with_overrides(spec, changes)
    assert other.hierarchy.levels[0].count == 2
    assert other.selection.grid == {"hierarchy.levels.0.count": (2, 3)}
    assert dump_spec(spec) == before
    assert with_overrides(spec, {}) == spec


def test_another_network_drops_the_settings_of_the_old_one() -> None:
    data = {**SMALL, "hierarchy": {"levels": [{"count": 5, "policy": {"hidden": [8, 8]}}]}}
    path = "hierarchy.levels.0.policy"
    linear = with_overrides(parse_spec(data), {f"{path}.network": "linear"})
    assert linear.hierarchy.levels[0].policy.hidden_sizes == ()
    with pytest.raises(SpecError, match="hidden: unknown key; valid here: network, inputs, emits"):
        with_overrides(parse_spec(data), {f"{path}.hidden": [3], f"{path}.network": "linear"})


def test_a_grid_over_networks_survives_writing() -> None:
    grid = {"hierarchy.levels.0.policy.network": ["linear", "mlp", "conv"]}
    spec = parse_spec(SMALL, {"selection.grid": grid})
    assert parse_spec(yaml.safe_load(dump_spec(spec))) == spec


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),  # YAML 1.1 has eight
        ("09", 9),
        ("1:30", "1:30"),  # and ninety
        ("1:30.5", "1:30.5"),
        ("0o10", "0o10"),
        ("1e-3", 0.001),
        ("+.5e2", 50.0),
    ],
)
def test_a_number_is_what_its_decimal_text_says(text: str, value: object) -> None:
    found = read_yaml(f"seed: {text}")["seed"]
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize("name", ["010", "1:30", "1e3", "yes"])
def test_a_name_that_looks_like_a_number_stays_a_name(name: str) -> None:
    text = dump_spec(parse_spec({**SMALL, "observations": [name]}))
    assert parse_spec(read_yaml(text)).observed == [name]


# --- specs that are written, and the schema -----------------------------------------------------------------


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "specs").glob("*.yaml")), ids=lambda path: path.stem
)
def test_what_is_written_is_read_as_it_was(tmp_path: Path, path: Path) -> None:
    spec = load_spec(path, allow_code=True)
    (tmp_path / "spec.yaml").write_text(dump_spec(spec), encoding="utf-8")
    assert load_spec(tmp_path / "spec.yaml", allow_code=True) == spec
    for short_or_whole in (path.read_text(), dump_spec(spec)):
        VALIDATOR.validate(yaml.safe_load(short_or_whole))


def test_all_defaults_are_written() -> None:
    written = yaml.safe_load(dump_spec(parse_spec(SMALL)))
    assert written["hierarchy"]["levels"][0]["termination"] == {"network": "linear"}
    assert written["training"]["optimizer"]["ridge"].keys() == {"policy", "gate", "cross_validated"}
    assert set(written) == set(Spec.model_fields)


NO_LAYERS = {"network": "conv", "layers": []}
WRONG_NETWORKS = ({"network": "mpl"}, {"hidden": [0]}, {"hiden": [3]}, {"dropout": 1}, NO_LAYERS)
WRONG = [{"hierarchy.levels.0.policy": network} for network in WRONG_NETWORKS]


@pytest.mark.parametrize(
    "values", [*WRONG, {"hierarchy.levels.0.count": 0}, {"observation": ["pose"]}], ids=str
)
def test_the_schema_refuses_what_is_refused(values: dict[str, Any]) -> None:
    VALIDATOR.validate(SMALL)
    wrong = edited(SMALL, values)
    with pytest.raises(SpecError):
        parse_spec(wrong)
    assert not VALIDATOR.is_valid(wrong)


def test_the_schema_describes_every_key_and_requires_observations_alone() -> None:
    schema = spec_schema()
    VALIDATOR.validate(yaml.safe_load(EXAMPLE))
    assert schema["required"] == ["observations"]
    fields = [item for model in (schema, *schema["$defs"].values()) for item in model["properties"].items()]
    assert [name for name, field in fields if not {"description", "$ref", "const"} & set(field)] == []


# --- what is refused, and in which words --------------------------------------------------------------------


def refusal(overrides: dict[str, Any]) -> str:
    with pytest.raises(SpecError) as caught:
        parse_spec(SMALL, overrides)
    return str(caught.value)


OF_STATE = {"learn": True, "per_state": True}
TWO_LEVELS = [{"count": 2}, {"name": "above", "count": 2, "policy": {"emits": ["control"]}}]
SEGMENTS = {"training.layerwise": "segments"}
LEVEL, META, TRUNK = "hierarchy.levels.0", "hierarchy.meta_policy", "hierarchy.trunk"
LABELS, TRAJECTORY, STD = "training.labels", "report.trajectory", "control.std"
HELD_OUT_TWICE = {"path": "a", "hold_out_by": "b", "valid_fraction": 0}
JAW, DIFFERENCES = {"name": "jaw", "dims": [0]}, {"key": "step", "differences": True}
ENDLESS = {"training.epochs": None, "training.patience": None}
OF_FLAT = {"hierarchy": None, "baseline": "flat", "compare_with": ["mixture"]}
REFUSED: list[tuple[dict[str, Any], str]] = [
    (
        {"compare_with": [{"kind": "per_timestep", "policy": {"network": "lstm"}}]},
        "compare_with.0.policy.network: per_",
    ),
    ({"hierarchy.levels.0.count": "5"}, "hierarchy.levels.0.count: must be a whole number, got '5'"),
    ({f"{LEVEL}.cuont": 5}, f"{LEVEL}.cuont: unknown key; did you mean {LEVEL}.count?"),
    ({"inference": "exact"}, "inference: must be fused or enumerate"),
    ({"hierarchy.levels": [{"count": 1}, {"count": 2}]}, "hierarchy.levels.1.name: 'option' is also the"),
    ({"hierarchy.levels.0.name": "a b"}, "hierarchy.levels.0.name: must be letters, digits, '_' or '-'"),
    ({f"{LEVEL}.policy.emits": ["options", "control"]}, f"{LEVEL}.policy.emits: the lowest level"),
    ({f"{META}.emits": ["options", "options"]}, f"{META}.emits: 'options' is given twice"),
    ({"hierarchy.meta_policy.network": "mpl"}, "hierarchy.meta_policy.network: no network is called 'mpl'"),
    ({"demonstrations": HELD_OUT_TWICE}, "demonstrations.hold_out_by: holds"),
    ({TRUNK: {"network": "constant"}}, f"{TRUNK}.network: a constant has no features for others"),
    ({META: {"network": "constant", "inputs": ["a"]}}, f"{META}.inputs: a constant"),
    ({META: {"network": "linear", "hidden": [8]}}, f"{META}.hidden: unknown key"),
    ({"control.parts": [{**JAW, "kind": "binary", "std": 1}]}, "control.parts.0.std: does"),
    ({"observations": ["state", DIFFERENCES]}, "observations.1.differences: does not apply"),
    (
        {"hierarchy.trunk": {"network": "mlp"}, "hierarchy.levels.0.policy": {"network": "lstm"}},
        "hierarchy.levels.0.policy.network: reads the trunk: use one of linear, mlp, constant, got 'lstm'",
    ),
    ({"hierarchy": None}, "hierarchy: missing; declare a hierarchy, or a baseline in its place"),
    ({"baseline": "flat"}, "baseline: stands beside hierarchy; keep one of the two"),
    ({"compare_with": ["flt"]}, "compare_with.0.kind: must be flat or flat_equal or per_timestep or mixture"),
    (
        {"compare_with": [{"kind": "flat_equal", "policy": {"network": "linear"}}]},
        "compare_with.0.policy: flat_equal w",
    ),
    ({"hierarchy": None, "baseline": "flat_equal"}, "baseline: flat_equal takes its size from a hierarchy"),
    (ENDLESS, "training.epochs: epochs and training.patience are both"),
    ({LABELS: {"level": "optoin", "from": "phase"}}, f"{LABELS}.level: there is no level 'optoin'"),
    ({LABELS: {"level": "option", "form": "phase"}}, f"{LABELS}.from: missing; it has to be"),
    (
        {"hierarchy.meta_policy.emits": ["control"], "training.labels": {"level": "option", "from": "phase"}},
        "training.labels.level: no policy selects the options of 'option'; let the policies above emit "
        "option",
    ),
    ({"training.starts": ["clusters"]}, "training.starts.0: must be vq or vq_controls or windows or equal_"),
    ({"task": None}, "task: missing; name a task, or give a file in demonstrations.path"),
    ({"observations": ["a", "a"]}, "observations.1.key: 'a' is given twice; keep one"),
    ({"observations": ["hand_pos", "goal"], TRAJECTORY: "hand_po"}, f"{TRAJECTORY}: there is no"),
    ({TRAJECTORY: ["pose", "grip", 3]}, f"{TRAJECTORY}: must be KEY or [KEY, slice], such as [pose, 3:6]"),
    ({"report.trajectory": ["pose", "3-6"]}, "report.trajectory: there is no observation '3-6'"),
    ({"control.std": -0.1}, "control.std: must be a positive number or {learn: true}, got -0.1"),
    ({"training.optimizer.lr": float("inf")}, "training.optimizer.lr: must be a finite number, got inf"),
    ({"training.layerwise": "yes"}, "training.layerwise: must be true, false, or segments, got 'yes'"),
    ({"seed": 2**32}, "seed: must be at most 4294967295, got 4294967296"),
    ({"model": 3}, "model: must be options, a baseline such as flat or mixture, a list of levels, or a"),
    ({"hierarchy": None, "baseline": "mixture"}, "baseline: mixture takes its experts from"),
    (OF_FLAT, "compare_with.0: mixture takes its experts"),
    ({"compare_with": [{"kind": "mixture", "policy": {}}]}, "compare_with.0.policy: a mixture has the netw"),
    ({f"{LEVEL}.termination": "always", "compare_with": ["mixture"]}, "compare_with.0: the hierarchy is a"),
    ({f"{LEVEL}.termination": "alway"}, f"{LEVEL}.termination: must be a network, such as"),
    ({STD: {**OF_STATE, "per_option": True}}, f"{STD}.per_option: per_state gives each option its own"),
    ({"hierarchy": None, "baseline": {"kind": "flat", "std": OF_STATE}}, "baseline.std: is for baselines in"),
    ({"compare_with": [{"kind": "flat", "std": OF_STATE}]}, "compare_with.0.std: no σ in control is learned"),
    ({TRUNK: {}, META: {"inputs": ["pose"]}}, f"{META}.inputs: the trunk"),
    ({"hierarchy.levels": TWO_LEVELS, **SEGMENTS}, "hierarchy.levels.1.policy.emits: training.layerwise: s"),
    ({f"{META}.emits": ["control"], **SEGMENTS}, f"{META}.emits: training.layerwise: segm"),
]


@pytest.mark.parametrize(
    ("overrides", "message"), REFUSED, ids=[message.partition(",")[0] for _, message in REFUSED]
)
def test_refused_with_the_key_path_and_one_line(overrides: dict[str, Any], message: str) -> None:
    assert refusal(overrides).startswith(message)


def test_every_problem_has_its_line() -> None:
    changes = {"training.average": 0.9, "training.optimizer": {"name": "em", "schedule": "cosine"}}
    message = refusal({"seed": "a", "hierarchy.levels.0.count": 0, "traning": {}, **changes})
    assert message.splitlines() == [
        "hierarchy.levels.0.count: must be at least 1, got 0",
        "training.average: em takes no gradient steps and would not use it; leave it out",
        "training.optimizer.schedule: em takes no gradient steps and would not use it; leave it out",
        "seed: must be a whole number, got 'a'",
        "traning: unknown key; did you mean training?",
    ]


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Every part of plain data, as what holds it and its key there."""
    for key in list(node) if isinstance(node, dict) else range(len(node)):
        yield node, key
        if isinstance(node[key], dict | list):
            yield from places(node[key])


ODD_NUMBERS = (None, True, -1, 10**40, 1e-320, float("nan"))
ODD = (*ODD_NUMBERS, "", "x" * 9999, "a:b:c", "\0", [], [[]], [None], {}, {"a": {}})


def test_an_odd_value_anywhere_is_read_or_refused_in_lines() -> None:
    """Never a traceback; the value is written into each place of the example in turn."""
    problems: list[str] = []
    example = yaml.safe_load(EXAMPLE)
    for number in range(len([*places(example)])):
        for value in ODD:
            data = deepcopy(example)
            node, key = [*places(data)][number]
            node[key] = value
            try:
                parse_spec(data)
            except SpecError as error:
                problems += error.problems
    assert len(problems) > 300
    assert not [problem for problem in problems if "\n" in problem]


LEVELS = "hierarchy.levels"


NO_ITEM = "value 1: KEY: '1' is not the number of one of the 1 items there (the first is 0)"


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        (f"{LEVELS}.0.count", [1, 0], "value 0: KEY: must be at least 1, got 0"),
        (f"{LEVELS}.0.cuont", [1], f"value 1: KEY: unknown key; did you mean {LEVELS}.0.count?"),
        (f"{LEVELS}.1.count", [1], NO_ITEM),
        ("selection.folds", [3], "the selection cannot be part of its own grid; remove it"),
        ("seed", 3, "must be a list, got 3"),
    ],
)
def test_every_value_of_a_grid_has_to_be_valid_in_place(key: str, values: object, message: str) -> None:
    said = f"selection.grid.{key}: {message.replace('KEY', key)}"
    assert refusal({"selection.grid": {key: values}}) == said
