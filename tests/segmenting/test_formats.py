"""Planted segments in every format, read back by readers of their own: the tool's where it is installed."""

import json
import os
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import h5py
import numpy as np
import pyarrow.parquet as parquet
import pytest
from command_line import call, done

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting.formats import Asked, check_format, write_format
from ddco_pyro.segmenting.segments import LevelLabels, Segmented, Segments

HERE = Path(__file__).parents[1]
NAMES = ("control", "place", "reach", "grasp")
ORDERED = [[(2, 4), (3, 3), (1, 5)], [(2, 2), (3, 1), (1, 1)], [(2, 6), (3, 2), (1, 3)]]
"""Of each demonstration, its subtasks as (option, steps), in one order: reach, grasp, place."""
OTHER = [*ORDERED, [(2, 3), (1, 3), (2, 2), (1, 2)]]
"""The last one reaches twice and does not grasp."""
LEROBOT = HERE / "fixtures" / "lerobot"
OF_DATASET = [
    [(2, 2), (3, 1), (1, 2)],
    [(2, 2), (3, 2), (1, 2)],
    [(2, 4), (3, 1), (1, 2)],
    [(2, 3), (1, 2), (2, 1), (1, 2)],
]
"""Subtasks of that dataset's episodes, which have 5 to 8 steps."""


class Planted:
    """Demonstrations in a file, with known segments."""

    def __init__(self, folder, plan, frequency=20.0):
        self.folder, self.file = folder, folder / "demos.hdf5"
        self.options = [np.concatenate([np.full(steps, option) for option, steps in each]) for each in plan]
        rng = np.random.default_rng(0)
        demos = []
        for number, options in enumerate(self.options):
            sizes = {"arm/joints": 3, "jaw": 1}
            seen = {key: rng.normal(size=(len(options), size)) for key, size in sizes.items()}
            demos.append(Demonstration(f"demo_{number}", seen, rng.normal(size=(len(options), 2))))
        self.demos = Demonstrations(tuple(demos), attributes={"control_frequency": frequency})
        self.demos.write(self.file)
        certain = [0.5 + 0.5 * rng.random(len(options)) for options in self.options]
        labels = [
            LevelLabels(options, np.diff(options, prepend=-1) != 0, probability)
            for options, probability in zip(self.options, certain, strict=True)
        ]
        self.segmented = Segmented(
            tuple(Segments(f"demo_{n}", {"skill": level}, 0.0, False) for n, level in enumerate(labels)),
            {"skill": 3},
            frequency,
            names={"skill": NAMES},
        )

    def runs(self, number):
        """(name, first step, step after the last) of each subtask."""
        options = self.options[number]
        edges = [0, *(np.flatnonzero(np.diff(options)) + 1), len(options)]
        return [(NAMES[options[a]], int(a), int(b)) for a, b in pairwise(edges)]

    def write(self, option, name, demos=None, **more):
        """What is written in a format, checked as the command checks it before."""
        spec = SimpleNamespace(demonstrations=SimpleNamespace(path=None, exclude=()))
        fit = SimpleNamespace(names={"skill": NAMES}, spec=spec, place="run")
        out, demos = self.folder / name, demos or self.file
        with open_source(demos) as source:
            asked = Asked(option, out, fit, source, "skill", **more)
            check_format(asked)
            self.said = write_format(asked, self.segmented)
        return out


@pytest.fixture
def planted(tmp_path):
    return Planted(tmp_path, ORDERED)


# --- MimicGen and Isaac Lab Mimic ---------------------------------------------------------------------------

PREPARED = {
    "--mimicgen": ("datagen_info", ("eef_pose", "object_poses/cube", "target_pose", "gripper_action")),
    "--isaac": ("obs/datagen_info", ("eef_pose/arm", "object_pose/cube", "target_eef_pose/arm")),
}


def prepare(planted, kind):
    place, needed = PREPARED[kind]
    with h5py.File(planted.file, "r+") as file:
        for demo in file["data"].values():
            for name in needed:
                demo[f"{place}/{name}"] = np.zeros((len(demo["actions"]), 4, 4))
            demo[place].attrs["env_interface_name"] = "MG_Plant"
        file["mask/train"] = np.array([b"demo_0", *([b"demo_3"] if len(file["data"]) > 3 else [])])
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Plant"})
        file["data"].attrs["total"] = sum(len(demo["actions"]) for demo in file["data"].values())


def arrays(group):
    """Every dataset below a group, by name."""
    found = {}

    def visit(name, item):
        if isinstance(item, h5py.Dataset):
            found[name] = item[()]

    group.visititems(visit)
    return found


def spans(signals, subtasks, steps):
    """Subtasks as (start, stop), as MimicGen's documentation of termination signals defines them.

    A subtask ends with the step where its signal goes from 0 to 1 for the first time; the last one ends with
    the demonstration.
    """
    stops = []
    for name in subtasks[:-1]:
        signal = signals[name][()]
        assert signal.shape == (steps,)
        stops.append(next(t for t in range(1, steps) if signal[t - 1] == 0 and signal[t] == 1) + 1)
    return list(pairwise([0, *stops, steps]))


@pytest.mark.parametrize("kind", ["--mimicgen", "--isaac"])
def test_signals_give_the_true_ends_of_subtasks_back(planted, kind):
    prepare(planted, kind)
    with h5py.File(planted.write(kind, "copy.hdf5")) as copy, h5py.File(planted.file) as file:
        for number in range(3):
            demo = copy[f"data/demo_{number}"]
            signals = demo[f"{PREPARED[kind][0]}/subtask_term_signals"]
            assert set(signals) == {"reach", "grasp"}  # no signal for the last subtask
            assert {signal.dtype for signal in signals.values()} == {np.dtype(np.int64)}
            found = spans(signals, ["reach", "grasp", "place"], len(demo["actions"]))
            assert found == [run[1:] for run in planted.runs(number)]
            before, after = arrays(file[f"data/demo_{number}"]), arrays(demo)
            assert all("subtask_term_signals" in name for name in after.keys() - before.keys())
            assert all(np.array_equal(values, after[name]) for name, values in before.items())
        assert copy["data"].attrs["total"] == file["data"].attrs["total"]


def test_an_order_that_differs_is_refused_or_left_out(tmp_path):
    planted = Planted(tmp_path, OTHER)
    prepare(planted, "--mimicgen")
    with pytest.raises(BadInput) as refused:
        planted.write("--mimicgen", "copy.hdf5")
    assert str(refused.value) == (
        "--mimicgen: demo_3: its subtasks are reach, place, reach, place, and those of 3 of 4 demonstrations "
        "are reach, grasp, place; --same-order leaves such demonstrations out (1 of 4)"
    )
    assert not (tmp_path / "copy.hdf5").exists()
    with h5py.File(planted.write("--mimicgen", "copy.hdf5", same_order=True)) as copy:
        assert set(copy["data"]) == {"demo_0", "demo_1", "demo_2"}
        assert list(copy["mask/train"]) == [b"demo_0"]
        assert copy["data"].attrs["total"] == sum(map(len, planted.options[:3]))
    assert planted.said.endswith("3 demonstrations with subtasks reach, grasp, place; left out: demo_3")


def test_a_subtask_that_occurs_twice_has_a_number(tmp_path):
    planted = Planted(tmp_path, [[(2, 3), (3, 2), (2, 2), (1, 4)]] * 2)
    prepare(planted, "--mimicgen")
    with h5py.File(planted.write("--mimicgen", "copy.hdf5")) as copy:
        signals = copy["data/demo_1/datagen_info/subtask_term_signals"]
        found = spans(signals, ["reach", "grasp", "reach_2", "place"], 11)
    assert found == [(0, 3), (3, 5), (5, 7), (7, 11)]


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ([[(2, 1), (3, 3)]], "demo_0: its first subtask, reach, lasts one step, whose end cannot be marked"),
        ([[(2, 4)], [(2, 3)]], "most demonstrations have one subtask, reach: there is no end to mark"),
    ],
)
def test_ends_that_no_signal_can_mark_are_refused(tmp_path, plan, message):
    planted = Planted(tmp_path, plan)
    prepare(planted, "--mimicgen")
    with pytest.raises(BadInput, match=message):
        planted.write("--mimicgen", "copy.hdf5", same_order=True)
    assert not (tmp_path / "copy.hdf5").exists()


# --- LeRobot ------------------------------------------------------------------------------------------------


@pytest.fixture
def dataset(tmp_path):
    return Path(shutil.copytree(LEROBOT, tmp_path / "dataset"))


def test_annotations_are_imported_as_labels_with_names(dataset, tmp_path):
    """As the page on which LeRobot's users label keeps them, for some episodes."""
    atom = {"role": "assistant", "style": "subtask", "tool_calls": None}
    memory = {"role": "assistant", "style": "memory", "content": "seen", "timestamp": 0.0}
    early = {**atom, "content": "go", "timestamp": 0.1}
    atoms = [{**atom, "content": "lift it", "timestamp": 0.3}, memory, early]
    annotations = {"version": 2, "schema": {}, "episodes": {"0": {"atoms": atoms}, "2": {"atoms": []}}}
    (dataset / "meta" / "lerobot_annotations.json").write_text(json.dumps(annotations))
    import_demonstrations(dataset, tmp_path / "imported.hdf5")
    with h5py.File(tmp_path / "imported.hdf5") as file:
        np.testing.assert_array_equal(file["data/demo_0/labels/subtask"], [-1, 0, 0, 1, 1])
        np.testing.assert_array_equal(file["data/demo_2/labels/subtask"], np.full(7, -1))
        named = [
            json.loads(file[place].attrs["label_names"])
            for place in ("/", "data")
            if "label_names" in file[place].attrs
        ]
        assert named == [{"subtask": ["go", "lift it"]}]


@pytest.mark.parametrize("text", ["{", "[]", '{"episodes": 3}', '{"episodes": {"x": {"atoms": [{}]}}}'])
def test_damaged_annotations_are_one_line(dataset, text):
    (dataset / "meta" / "lerobot_annotations.json").write_text(text)
    with (
        pytest.raises(BadInput, match=r"lerobot_annotations\.json: cannot be read, or is damaged"),
        open_source(dataset),
    ):
        pass


def test_the_stages_of_sarm(tmp_path):
    planted = Planted(tmp_path, OF_DATASET)
    out = planted.write("--sarm", "dataset", demos=LEROBOT)
    rows = parquet.read_table(next((out / "meta" / "episodes").rglob("*.parquet"))).to_pylist()
    for number, row in enumerate(rows):
        columns = [row[f"dense_subtask_{key}"] for key in ("names", "start_frames", "end_frames")]
        stages = zip(*columns, strict=True)
        assert [(name, start, end + 1) for name, start, end in stages] == planted.runs(number)
    shares = json.loads((out / "meta" / "temporal_proportions_dense.json").read_text())
    assert list(shares) == ["reach", "grasp", "place"]
    expected = [np.mean([np.mean(each == option) for each in planted.options]) for option in (2, 3, 1)]
    np.testing.assert_allclose(list(shares.values()), expected)


def test_a_copy_of_a_dataset_gets_stages_beside_its_subtasks(tmp_path):
    """And existing stages are replaced."""
    planted = Planted(tmp_path, OF_DATASET)
    first = planted.write("--lerobot", "first", demos=LEROBOT)
    second = planted.write("--sarm", "second", demos=first)
    third = planted.write("--sarm", "third", demos=second)
    assert (second / "meta" / "lerobot_annotations.json").read_text() == (
        first / "meta" / "lerobot_annotations.json"
    ).read_text()
    files = [next((one / "meta" / "episodes").rglob("*.parquet")) for one in (second, third)]
    names = [parquet.read_schema(file).names for file in files]
    assert names[0] == names[1]
    (tmp_path / "taken").mkdir()
    with pytest.raises(BadInput, match="taken: exists; remove it, or choose another --sarm"):
        planted.write("--sarm", "taken", demos=first)


# --- annotation tools ---------------------------------------------------------------------------------------


def test_predictions_for_label_studio(planted):
    out = planted.write("--label-studio", "studio")
    for number, task in enumerate(json.loads((out / "tasks.json").read_text())):
        (prediction,) = task["predictions"]
        values = [region["value"] for region in prediction["result"]]
        found = [(*value["timeserieslabels"], value["start"], value["end"] + 1) for value in values]
        assert found == planted.runs(number)
        probability = planted.segmented.segments[number].levels["skill"].probability
        scores = [region["score"] for region in prediction["result"]]
        np.testing.assert_allclose(scores, [probability[a:b].mean() for _, a, b in planted.runs(number)])
        assert prediction["score"] == min(scores)
        np.testing.assert_allclose(task["data"]["series"]["control_1"], planted.demos[number].actions[:, 1])
    config = ElementTree.parse(out / "config.xml")
    assert [label.get("value") for label in config.iter("Label")] == ["reach", "grasp", "place"]
    assert [channel.get("column") for channel in config.iter("Channel")] == ["control_0", "control_1"]


def test_annotations_for_elan(planted):
    out = planted.write("--elan", "elan")
    for number in range(3):
        document = ElementTree.parse(out / f"demo_{number}.eaf")
        times = {slot.get("TIME_SLOT_ID"): int(slot.get("TIME_VALUE")) for slot in document.iter("TIME_SLOT")}
        (tier,) = document.iter("TIER")
        found = [
            (one.findtext("ANNOTATION_VALUE"), *(times[one.get(f"TIME_SLOT_REF{side}")] for side in (1, 2)))
            for one in tier.iter("ALIGNABLE_ANNOTATION")
        ]
        assert tier.get("TIER_ID") == "skill"
        assert found == [(name, 50 * start, 50 * stop) for name, start, stop in planted.runs(number)]  # 20 Hz


# --- the tools themselves -----------------------------------------------------------------------------------

TOOLS = Path(os.environ.get("DDCO_PYRO_TOOLS", HERE.parent / ".venv-tools")) / "bin" / "python"
"""``make tools`` makes this environment."""


@pytest.mark.slow
@pytest.mark.skipif(not TOOLS.exists(), reason="the tools are not installed: make tools")
@pytest.mark.parametrize(
    ("form", "plan"),
    [
        ("lerobot", OF_DATASET),
        ("sarm", OF_DATASET),
        ("mimicgen", ORDERED),
        ("isaac", ORDERED),
        ("label-studio", OTHER),
        ("elan", OTHER),
        ("rerun", OTHER),
    ],
)
def test_the_tool_reads_what_was_planted(tmp_path, form, plan):
    if form == "rerun":
        pytest.importorskip("rerun")
    planted, option = Planted(tmp_path, plan), f"--{form}"
    if option in PREPARED:
        prepare(planted, option)
    out = planted.write(option, "out", demos=LEROBOT if plan is OF_DATASET else None)
    in_tools("read_formats.py", form.replace("-", "_"), out, planted.write("--csv", "table.csv"), "skill")


def in_tools(script, *arguments):
    command = [str(TOOLS), str(HERE / "fixtures" / script), *map(str, arguments)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    if ended.returncode == 77:
        pytest.skip("this tool is not installed: make tools")
    assert ended.returncode == 0, ended.stderr
    print(ended.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not TOOLS.exists(), reason="the tools are not installed: make tools")
def test_lerobot_acts_as_the_run_does(toy_run, tmp_path):
    done("export", toy_run.folder, "--lerobot", tmp_path / "policy", "--out", tmp_path / "export")
    in_tools("act_lerobot.py", tmp_path / "policy", tmp_path / "export")


def test_a_policy_for_lerobot_is_an_export_with_lerobots_files(toy_run, tmp_path):
    done("export", toy_run.folder, "--lerobot", tmp_path / "policy")
    done("export", toy_run.folder, "--out", tmp_path / "export")
    exported, policy = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("export", "policy")
    )
    for name in ("controller.json", "runner.py"):
        assert policy[name] == exported[name]
    more = {"config.json", "policy_preprocessor.json", "policy_postprocessor.json"}
    assert policy.keys() - exported.keys() == more
    config = json.loads(policy["config.json"])
    assert config["type"] == "ddco"
    assert config["input_features"]["observation.offsets"] == {"type": "STATE", "shape": [4]}
    assert config["output_features"] == {"action": {"type": "ACTION", "shape": [2]}}
    (tmp_path / "policy" / "mine.txt").touch()
    ended = call("export", toy_run.folder, "--lerobot", tmp_path / "policy")
    assert (ended.status, ended.err.count("\n")) == (2, 1)
