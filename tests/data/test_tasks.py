"""Tasks of demonstrations: how they are named, listed, asked for, divided, pooled, and seen by networks."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import call, done, refused
from planted import LINEAR, small_spec
from random_demonstrations import demonstrations, numbered
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.labels import label_names
from ddco_pyro.evaluation.agreement import agreement, of_equal_lengths
from ddco_pyro.exporting import TOLERANCE, export, runner
from ddco_pyro.spec import Spec, dump_spec, load_spec
from ddco_pyro.training.data import demonstrations as read
from ddco_pyro.training.data import train_and_valid, tuning_split
from ddco_pyro.training.networks import Dimensions

TASKS = ("close", "open", "press", "push")
OPTIONS = 3
"""Of each task."""

STATE, NOISE = 0.2, 0.05
"""Standard deviations of the state and of the control."""


def four_tasks(number: int = 10, seed: int = 0) -> Demonstrations:
    """Four planted tasks with three options of their own each: in each, phases are numbers from 0 to 2.

    Each option has its own place on a circle, and the control is the way there from a state that wanders.

    A demonstration has three segments of 6 to 9 steps, one of each option of its task.
    """
    random, demos = np.random.default_rng(seed), []
    angles = 2 * np.pi * np.arange(OPTIONS * len(TASKS)) / (OPTIONS * len(TASKS))
    places = np.column_stack([np.cos(angles), np.sin(angles)])
    for task, name in enumerate(TASKS):
        for _ in range(number):
            phases = np.repeat(np.arange(OPTIONS), random.integers(6, 10, OPTIONS))
            states = random.normal(0, STATE, (len(phases), 2))
            controls = places[task + len(TASKS) * phases] - states + random.normal(0, NOISE, states.shape)
            about = {"task": name}
            own = ({"state": states}, controls, {"phase": phases}, about)
            demos.append(Demonstration(f"demo_{len(demos)}", *own))
    return Demonstrations(tuple(demos))


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("tasks") / "four.hdf5"
    four_tasks().write(found)
    return found


@pytest.fixture(scope="module")
def spec(path: Path) -> Spec:
    """What ``init`` writes."""
    done("init", path, "--out", path.with_suffix(".yaml"))
    return load_spec(path.with_suffix(".yaml"))


@pytest.fixture(scope="module")
def run(spec: Spec, path: Path) -> ddco_pyro.Fit:
    return ddco_pyro.fit(spec, out=path.with_name("run"), jobs=1)


# --- read, listed, asked for --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("attributes", "task"),
    [
        ({"task": "open", "language_instruction": "open the drawer"}, "open"),
        ({"language_instruction": "open the drawer"}, "open the drawer"),
        ({"task_description": "open"}, "open"),
        ({"seed": 3}, ""),
    ],
)
def test_attributes_name_the_task(attributes: dict[str, object], task: str, tmp_path: Path) -> None:
    Demonstrations((replace(demonstrations(1)[0], attributes=attributes),)).write(tmp_path / "one.hdf5")
    assert Demonstrations.read(tmp_path / "one.hdf5").tasks == (task,)


def test_inspect_lists_tasks_with_what_only_some_have(path: Path, tmp_path: Path) -> None:
    four_tasks(3).write(tmp_path / "four.hdf5")
    with h5py.File(tmp_path / "four.hdf5", "r+") as file:
        for group in file["data"].values():
            if group.attrs["task"] != "push":
                group["obs/lid"] = np.zeros((len(group["actions"]), 1))
    rows = [line.split("│") for line in call("inspect", tmp_path / "four.hdf5").out.splitlines()]
    lengths = {task: [] for task in TASKS}
    for demo in four_tasks(3):
        lengths[demo.attributes["task"]].append(len(demo))
    for task, steps in lengths.items():
        (row,) = [[cell.strip() for cell in row] for row in rows if row[0].strip() == task]
        span = f"{min(steps)} to {max(steps)}"
        assert row == [task, "3", span, f"{np.median(steps):g}", "obs/lid" * (task != "push")]
    whole = json.loads(call("inspect", tmp_path / "four.hdf5", "--json").out)
    assert {task: len(names) for task, names in whole["tasks"].items()} == dict.fromkeys(TASKS, 3)


def test_where_asks_for_tasks(path: Path, run: ddco_pyro.Fit, tmp_path: Path) -> None:
    assert [*inspect(path, where={"task": ["open", "push"]}).tasks] == ["open", "push"]
    assert {*Demonstrations.read(path, where={"task": ["press"]}).tasks} == {"press"}
    one = ["--where", "task=close"]
    done("segment", run.folder, path, "--csv", tmp_path / "a.csv", *one)
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert rows[0].startswith("demonstration,task,step,")
    assert {row.split(",")[1] for row in rows[1:]} == {"close"}
    done("import", path, "--out", tmp_path / "close.hdf5", *one)
    assert len(Demonstrations.read(tmp_path / "close.hdf5")) == 10
    done("init", path, "--out", tmp_path / "close.yaml", *one)
    alone = load_spec(tmp_path / "close.yaml")
    assert (alone.demonstrations.where, alone.hierarchy.levels[0].count) == ({"task": ("close",)}, OPTIONS)
    assert {*read(alone).tasks} == {"close"}
    short = ["--set", "training.epochs=2", "--set", "compare_with=[]", "--set", "observations=[state]"]
    short += ["--set", "hierarchy.levels.0.policy={network: linear}", "--where", "task=push"]
    done("fit", path.with_suffix(".yaml"), "--out", tmp_path / "run", "--jobs", 1, *short)
    assert {*ddco_pyro.load(tmp_path / "run").demonstrations.tasks} == {"push"}


NO_TASK = "no demonstration has task=opem (did you mean 'open'?); there is: close, open, press, push"


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("task=opem", NO_TASK),
        ("operator=A", "demo_0 has no attribute 'operator'; there is: task"),
        ("task", "--where task: write ATTRIBUTE=VALUE, such as task=reach"),
    ],
)
def test_what_is_not_there_is_one_line(where: str, says: str, path: Path, tmp_path: Path) -> None:
    for command in (["inspect", path], *([one, path, "--out", tmp_path / "x"] for one in ("init", "import"))):
        refused(says, *command, "--where", where)


# --- division -----------------------------------------------------------------------------------------------


def test_demonstrations_are_drawn_within_tasks(spec: Spec) -> None:
    for seed in range(5):
        parts = train_and_valid(spec.model_copy(update={"seed": seed}), read(spec))
        fitted, tune = tuning_split(spec, Dimensions.of(parts["train"]), parts["train"])
        for part, number in ((parts["valid"], 2), (tune, 1), (fitted, 7)):
            assert sorted(part.tasks) == sorted(TASKS * number)


def test_instructions_of_one_demonstration_each_are_drawn_together() -> None:
    each = tuple(replace(one, attributes={"instruction": one.name}) for one in demonstrations(10))
    train, valid = Demonstrations(each).split(0.3, 0)
    assert (len(train), len(valid)) == (7, 3)
    assert [one.name for one in valid] == [one.name for one in demonstrations(10).split(0.3, 0)[1]]


# --- pooled -------------------------------------------------------------------------------------------------


def test_a_damaged_one_of_several_files_is_named(tmp_path: Path) -> None:
    for name in ("open", "push"):
        demonstrations(3).write(tmp_path / f"{name}.hdf5")
    with h5py.File(tmp_path / "open.hdf5", "r+") as file:
        del file["data/demo_1/actions"]
    ended = call("import", tmp_path / "open.hdf5", tmp_path / "push.hdf5", "--out", tmp_path / "pooled.hdf5")
    assert (ended.status, ended.out) == (2, "")
    assert f"{tmp_path / 'open.hdf5'}: demo_1: actions is missing; " in ended.err


def test_files_are_pooled_with_the_keys_that_all_have(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    for name, size in (("open", 4), ("push", 7)):
        seen = {key: np.ones((5, width)) for key, width in {"pose": 2, f"of_{name}": 1, "size": size}.items()}
        labels = {"phase": [0, 0, 1, 1, 2], name: [1] * 5}
        demos = numbered((seen, random.normal(size=(5, 2)), labels) for _ in range(2))
        demos.write(tmp_path / f"{name}.hdf5")
    with h5py.File(tmp_path / "push.hdf5", "r+") as file:
        file.attrs["label_names"] = json.dumps({"phase": ["near", "touch", "shove"]})
    ended = done("import", tmp_path / "open.hdf5", tmp_path / "push.hdf5", "--out", tmp_path / "pooled.hdf5")
    for line in (
        "note: obs/of_open is left out: 1 of 2 tasks have it: open\n",
        "note: obs/of_push is left out: 1 of 2 tasks have it: push\n",
        "note: obs/size is left out: it has other shapes in some tasks: [4] in open, [7] in push\n",
    ):
        assert line in ended.err
    pooled = Demonstrations.read(tmp_path / "pooled.hdf5")
    assert pooled.tasks == ("open", "open", "push", "push")
    assert [*pooled.observation_shapes] == ["pose"]
    names = label_names(pooled.attributes)
    said = {}
    for demo in pooled:
        for key in ("phase", "open"):
            own = [names[key][value] if value >= 0 else None for value in demo.labels[key]]
            said[key, demo.attributes["task"]] = own
    assert said["phase", "open"] == ["open: 0", "open: 0", "open: 1", "open: 1", "open: 2"]
    assert said["phase", "push"] == ["near", "near", "touch", "touch", "shove"]
    assert (said["open", "open"], said["open", "push"]) == (["open: 1"] * 5, [None] * 5)
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "push.hdf5").write_bytes((tmp_path / "push.hdf5").read_bytes())
    both = tmp_path / "push.hdf5", tmp_path / "again" / "push.hdf5"
    refused("another file is called push, too; rename one", "import", *both, "--out", tmp_path / "x.hdf5")


# --- planted tasks ------------------------------------------------------------------------------------------


def test_init_shows_the_task_to_gates_alone(spec: Spec) -> None:
    """There are as many options as phases of all tasks together, since these have no names."""
    (level,) = spec.hierarchy.levels
    assert level.count == OPTIONS * len(TASKS)
    assert [one.key for one in spec.observations] == ["state", "task"]
    networks = (level.policy, level.termination, spec.hierarchy.meta_policy)
    assert [network.inputs for network in networks] == [("state",), (), ()]


def test_planted_options_agree_within_each_task(run: ddco_pyro.Fit, path: Path, tmp_path: Path) -> None:
    found = run.metrics.agreement
    assert found.valid[0].nmi == pytest.approx(1.0, abs=0.02)
    assert found.equal_valid[0].nmi < found.valid[0].nmi
    names = label_names(run.demonstrations.attributes)["phase"]
    assert names == [f"{task}: {phase}" for task in TASKS for phase in range(OPTIONS)]
    done("segment", run.folder, path, "--html", tmp_path / "page.html")
    done("report", run.folder)
    for page in (tmp_path / "page.html", run.folder / "report.html"):
        _, _, table = page.read_text().partition("Options in tasks")
        assert all(task in table.partition("</table>")[0] for task in TASKS)


def test_agreement_is_the_mean_over_tasks() -> None:
    """The same numbers stand for other things in two tasks; three parts of a task are no four."""
    ours = [np.array([1, 1, 2, 2]), np.array([1, 1, 2, 2]), np.array([2, 2, 1, 1]), np.array([2, 2, 1, 1])]
    truth = [np.array([0, 0, 1, 1]), np.array([0, 0, 1, 1]), np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])]
    tasks = ["a", "a", "b", "b"]
    nmi = [
        normalized_mutual_info_score(np.concatenate(truth[n : n + 2]), np.concatenate(ours[n : n + 2]))
        for n in (0, 2)
    ]
    assert agreement(ours, truth, tasks).nmi == pytest.approx(np.mean(nmi))
    assert agreement(ours, truth).nmi < 0.1
    assert of_equal_lengths(truth, 4, ours, tasks).nmi == pytest.approx(np.mean(nmi))


def test_a_controller_takes_the_name_of_the_task(run: ddco_pyro.Fit) -> None:
    """A task that was not there is the mean of those that were."""
    controller, state = Controller(run.hierarchy), np.zeros(2)
    first = {}
    for task in (*TASKS, "pull"):
        controller.reset(0)
        first[task] = controller.act({"state": state, "task": task})
        controller.reset(0)
        known, count = np.eye(len(TASKS)), len(TASKS)
        numbers = known[TASKS.index(task)] if task in TASKS else np.full(count, 1 / count)
        np.testing.assert_array_equal(controller.act({"state": state, "task": numbers}), first[task])
    assert len({tuple(first[task]) for task in TASKS}) > 1


def test_an_observation_relative_to_another_is_their_difference(tmp_path: Path) -> None:
    random, records = np.random.default_rng(0), []
    for _ in range(6):
        cup, hand = random.normal(size=(2, 20, 3))
        controls = 0.5 * (cup - hand) + 0.1 * random.normal(size=(20, 3))
        records.append(({"cup_pos": cup, "hand_pos": hand}, controls))
    demos = numbered(records)
    demos.write(tmp_path / "demos.hdf5")
    text = call("inspect", tmp_path / "demos.hdf5").out
    assert "  # - {key: cup_pos, minus: hand_pos}" in text
    known = {"path": str(tmp_path / "demos.hdf5"), "valid_fraction": 0.2}
    relative, reads = {"key": "cup_pos", "minus": "hand_pos"}, LINEAR | {"inputs": ["cup_pos-hand_pos"]}
    seen = [relative | {"differences": True}, "cup_pos"]
    fit = ddco_pyro.fit(
        small_spec((2,), reads, observations=seen, control={"std": {"learn": True}}, demonstrations=known)
    )
    encoder, demo = fit.hierarchy.encoder, demos[0]
    gap = demo.observations["cup_pos"] - demo.observations["hand_pos"]
    expected = np.hstack([gap, np.diff(gap, axis=0, prepend=gap[:1]), demo.observations["cup_pos"]])
    np.testing.assert_allclose(encoder.features(demo.observations), expected)
    assert export(fit, tmp_path / "out")["numpy"][0] < TOLERANCE
    exported, original = runner.Runner(tmp_path / "out"), fit.controller()
    for step in range(5):
        seen = {key: rows[step] for key, rows in demo.observations.items()}
        np.testing.assert_allclose(exported.act(seen), original.act(seen), atol=1e-5)
    for minus in ("cup", "hand_pos"):
        alone = small_spec(observations=[relative | {"minus": minus}], demonstrations=known)
        (tmp_path / "spec.yaml").write_text(dump_spec(alone))
        if minus == "cup":
            refused("", "check", tmp_path / "spec.yaml")
        else:
            done("check", tmp_path / "spec.yaml")
