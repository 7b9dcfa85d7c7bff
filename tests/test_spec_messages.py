"""What the spec refuses, and in which words."""

from __future__ import annotations

from typing import Any

import pytest

from ddco_pyro.spec import SpecError, parse_spec

SMALL = {"task": "needle", "observations": ["pose"], "hierarchy": {"levels": [{"count": 5}]}}


def refusal(overrides: dict[str, Any]) -> str:
    with pytest.raises(SpecError) as caught:
        parse_spec(SMALL, overrides)
    return str(caught.value)


REFUSED: list[tuple[dict[str, Any], str]] = [
    *(
        (
            {"compare_with": ["flat", {"kind": "per_timestep", "policy": {"network": name, **settings}}]},
            "compare_with.1.policy.network: per_timestep has a perceptron for each step: use one of linear, mlp, "
            f"got {name!r}, or say kind: flat",
        )
        for name, settings in {"lstm": {}, "conv": {}, "branches": {"of": {"pose": {}}}, "module:Net": {}}.items()
    ),
    ({"hierarchy.levels.0.count": "5"}, "hierarchy.levels.0.count: must be a whole number, got '5'"),
    ({"hierarchy.levels.0.count": True}, "hierarchy.levels.0.count: must be a whole number, got true"),
    ({"hierarchy.levels": {"count": 3}}, "hierarchy.levels: must be a list, got {'count': 3}"),
    ({"hierarchy.levels.0.cuont": 5}, "hierarchy.levels.0.cuont: unknown key; did you mean hierarchy.levels.0.count?"),
    ({"sed": 3}, "sed: unknown key; did you mean seed?"),
    ({"inference.xyz": 3}, "inference.xyz: unknown key; valid here: engine"),
    ({"hierarchy.levels": [{"count": 1}, {"count": 2}]}, "hierarchy.levels.1.name: 'option' is also the name of"),
    ({"hierarchy.levels.0.name": "a b"}, "hierarchy.levels.0.name: must be letters, digits, '_' or '-'"),
    ({"hierarchy.levels.0.policy.emits": ["options", "control"]}, "hierarchy.levels.0.policy.emits: the lowest level"),
    ({"hierarchy.meta_policy.emits": ["option"]}, "hierarchy.meta_policy.emits.0: must be options or control"),
    ({"hierarchy.meta_policy.emits": ["options", "options"]}, "hierarchy.meta_policy.emits: 'options' is given twice"),
    ({"hierarchy.meta_policy.network": "mpl"}, "hierarchy.meta_policy.network: no network is called 'mpl'"),
    ({"hierarchy.meta_policy": {"network": "linear", "hidden": [8]}}, "hierarchy.meta_policy.hidden: does not apply"),
    ({"control.parts": [{"name": "arm", "dims": [0, 1], "scale": [1.0]}]}, "control.parts.0.scale: has 1 numbers"),
    (
        {"control.parts": [{"name": "jaw", "dims": [0], "kind": "binary", "scale": [1.0]}]},
        "control.parts.0.scale: does not apply to kind: binary; leave it out",
    ),
    ({"training.optimizer": {"name": "adam", "momentum": 0.5}}, "training.optimizer.momentum: is for name: momentum"),
    ({"observations": ["step"]}, "observations: step alone says nothing about the state"),
    ({"observations": ["state", {"key": "step", "differences": True}]}, "observations.1.differences: step grows by"),
    (
        {"hierarchy.meta_policy": {"network": "conv", "kernel": 3, "layers": [{"filters": 2, "kernel": 3}]}},
        "hierarchy.meta_policy.kernel: each of layers has its own; leave it out",
    ),
    ({"hierarchy.meta_policy": {"network": "branches"}}, "hierarchy.meta_policy.of: missing; it has to be given"),
    (
        {"hierarchy.levels.0.trunk": {"network": "mlp"}, "hierarchy.levels.0.policy": {"network": "lstm"}},
        "hierarchy.levels.0.policy.network: reads the trunk: use one of linear, mlp, got 'lstm'",
    ),
    ({"hierarchy.meta_policy.dropout": 1}, "hierarchy.meta_policy.dropout: must be less than 1, got 1"),
    ({"hierarchy": None}, "hierarchy: missing; declare a hierarchy, or a baseline in its place"),
    ({"baseline": "flat"}, "baseline: stands beside hierarchy; keep one of the two"),
    ({"compare_with": ["flt"]}, "compare_with.0.kind: must be flat or flat_equal or per_timestep or mixture"),
    (
        {"compare_with": ["flat", {"kind": "flat_equal", "policy": {"network": "linear"}}]},
        "compare_with.1.policy: flat_equal widens hidden layers, and network 'linear' has none; give it some, such as "
        "{network: mlp, hidden: [64]}",
    ),
    ({"hierarchy": None, "baseline": "flat_equal"}, "baseline: flat_equal takes its size from a hierarchy"),
    ({"training.epochs": None, "training.patience": None}, "training.epochs: epochs and training.patience are both"),
    ({"training.labels": {"level": "optoin", "from": "phase"}}, "training.labels.level: there is no level 'optoin'"),
    ({"training.labels": {"level": "option", "form": "phase"}}, "training.labels.from: missing; it has to be"),
    (
        {"hierarchy.meta_policy.emits": ["control"], "training.labels": {"level": "option", "from": "phase"}},
        "training.labels.level: no policy selects the options of 'option'; let the policies above emit options",
    ),
    (
        {"training": {"initialize": "random", "labels": {"level": "option", "from": "phase", "hold": False}}},
        "training.labels.hold: false uses labels in initialisation alone, and that is random; say vq there",
    ),
    ({"training.initialize": "clusters"}, "training.initialize: must be one of 'vq', 'vq_controls', 'equal_parts'"),
    ({"training.initialize": ["vq", "cuts"]}, "training.initialize: has 2 kinds, but training.restarts is 1"),
    ({"training": {"initialize": "mixture", "lower_levels": "frozen"}}, "training.lower_levels: mixture trains all"),
    ({"training.duration.mean": [20, 2]}, "training.duration.mean: has 2 numbers, but the number of levels is 1"),
    ({"hierarchy": None, "baseline": "flat", "training.duration.mean": 20}, "training.duration: there are no options"),
    ({"task": None}, "task: missing; name a task, or give a file in demonstrations.path"),
    ({"observations": ["a", "a"]}, "observations.1.key: 'a' is given twice; keep one"),
    ({"observations": ["hand_pos", "goal"], "report.trajectory": "hand_po"}, "report.trajectory: there is no"),
    ({"control.std": -0.1}, "control.std: must be a positive number or {learn: true}, got -0.1"),
    ({"control.scale": "standardise"}, "control.scale: must be standardize, none, or a list of positive numbers"),
    ({"control.scale": [1.0, 0.0]}, "control.scale.1: must be greater than 0, got 0.0"),
    ({"training.optimizer.lr": float("inf")}, "training.optimizer.lr: must be a finite number, got inf"),
    ({"training.layerwise": "yes"}, "training.layerwise: must be true or false, got 'yes'"),
    ({"training": None}, "training: must be a mapping (key: value), got null"),
    ({"seed": 2**32}, "seed: must be at most 4294967295, got 4294967296"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED, ids=[message.partition(",")[0] for _, message in REFUSED])
def test_refused_with_the_key_path_and_one_line(overrides: dict[str, Any], message: str) -> None:
    assert refusal(overrides).startswith(message)


def test_every_problem_has_its_line() -> None:
    message = refusal({"seed": "a", "hierarchy.levels.0.count": 0, "traning": {}})
    assert message.splitlines() == [
        "hierarchy.levels.0.count: must be at least 1, got 0",
        "seed: must be a whole number, got 'a'",
        "traning: unknown key; did you mean training?",
    ]


def test_keys_that_are_not_text_are_refused() -> None:
    with pytest.raises(SpecError, match=r"^selection\.grid\.3: a key must be text"):
        parse_spec({**SMALL, "selection": {"grid": {3: [1]}}})
    with pytest.raises(SpecError, match=r"^3: a key must be text"):
        parse_spec({**SMALL, 3: 4})  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (
            {"hierarchy.levels.0.count": [1, 0]},
            "selection.grid.hierarchy.levels.0.count: value 0: hierarchy.levels.0.count: must be at least 1, got 0",
        ),
        (
            {"hierarchy.levels.0.cuont": [1]},
            "selection.grid.hierarchy.levels.0.cuont: value 1: hierarchy.levels.0.cuont: unknown key; "
            "did you mean hierarchy.levels.0.count?",
        ),
        (
            {"hierarchy.levels.1.count": [1]},
            "selection.grid.hierarchy.levels.1.count: value 1: hierarchy.levels.1.count: "
            "'1' is not the number of one of the 1 items there (the first is 0)",
        ),
        (
            {"selection.folds": [3]},
            "selection.grid.selection.folds: the selection cannot be part of its own grid; remove it",
        ),
        ({"seed": 3}, "selection.grid.seed: must be a list, got 3"),
    ],
)
def test_every_value_of_a_grid_has_to_be_valid_in_place(grid: dict[str, Any], message: str) -> None:
    assert refusal({"selection.grid": grid}) == message
