"""Files that robomimic, LeRobot and Minari themselves wrote, imported: every number is there.

``fixtures/README.md`` says how these files were made.
"""

import json
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pyarrow
import pytest
from command_line import call, done, refused
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from odd_files import lerobot as odd
from odd_files.hdf5 import instead
from pyarrow import parquet
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.data.importing import Choice, import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.errors import BadInput
from ddco_pyro.events import Counted

ROBOMIMIC, LEROBOT = Path(__file__).parents[1] / "fixtures" / "robomimic.hdf5", odd.FIXTURE


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "demos.hdf5"


# --- robomimic ----------------------------------------------------------------------------------------------


def test_a_file_of_robomimics_is_read_as_it_is() -> None:
    demos = Demonstrations.read(ROBOMIMIC)
    with h5py.File(ROBOMIMIC) as file:
        for demo in demos:
            np.testing.assert_array_equal(demo.actions, file[f"data/{demo.name}/actions"])
            np.testing.assert_array_equal(demo.observations["object"], file[f"data/{demo.name}/obs/object"])
    shapes = {"agentview_image": (12, 10, 3), "object": (2,), "robot0_eef_pos": (2,)}
    assert demos.observation_shapes == shapes
    assert set(demos.masks) == {"train", "valid", "better"}
    assert inspect(ROBOMIMIC).frequency == 20


@pytest.mark.parametrize("written", [False, True])
def test_robomimic_in_this_layout(out: Path, written: bool) -> None:
    """Imported, or read and written again."""
    before = Demonstrations.read(ROBOMIMIC)
    if written:
        before.write(out)
    else:
        assert import_demonstrations(ROBOMIMIC, out).names == tuple(f"demo_{number}" for number in range(6))
    after = Demonstrations.read(out)
    assert inspect(out).frequency == 20
    assert after.masks == before.masks
    assert not written or after.attributes == before.attributes
    for one, other in zip(before, after, strict=True):
        assert (one.name, one.attributes) == (other.name, other.attributes)
        np.testing.assert_array_equal(one.actions, other.actions)
        for key, array in one.observations.items():
            np.testing.assert_array_equal(array, other.observations[key])
    with h5py.File(out) as file, h5py.File(ROBOMIMIC) as source:
        for name in ("env_args", "total"):
            assert file["data"].attrs[name] == source["data"].attrs[name]
        assert file["data/demo_0/obs/robot0_eef_pos"].dtype == np.float64
        assert "next_obs" not in file["data/demo_0"]
        if not written:
            assert file["data/demo_0/obs/object"].dtype == np.float32
            assert file.attrs["control_frequency"] == 20


def test_a_filter_key_some_observations_and_smaller_pictures(out: Path) -> None:
    choice = Choice(("object", "agentview_image"), mask="better", image_size=(6, 5))
    import_demonstrations(ROBOMIMIC, out, choice=choice)
    demos = Demonstrations.read(out)
    assert demos.names == ("demo_0", "demo_1", "demo_2")
    assert demos.observation_shapes == {"agentview_image": (6, 5, 3), "object": (2,)}
    assert all(set(names) <= set(demos.names) for names in demos.masks.values())
    before = np.asarray(Demonstrations.read(ROBOMIMIC)[0].observations["agentview_image"])
    halved = before.reshape(-1, 6, 2, 5, 2, 3).mean((2, 4))
    np.testing.assert_allclose(demos[0].observations["agentview_image"], halved, atol=1)


# --- LeRobot ------------------------------------------------------------------------------------------------


def test_lerobot_without_its_videos(out: Path) -> None:
    import_demonstrations(LEROBOT, out)
    demos = Demonstrations.read(out)
    assert demos.lengths == (5, 6, 7, 8)
    assert demos.observation_shapes == {"state": (3,), "images/wrist": (8, 10, 3)}
    for episode, demo in enumerate(demos):
        steps = np.arange(len(demo))
        np.testing.assert_array_equal(demo.observations["state"][:, :2], [[episode, step] for step in steps])
        expected = np.stack([0.1 * steps, np.full(len(demo), -0.1 * episode)], 1)
        np.testing.assert_allclose(demo.actions, expected, 1e-6)
        picture = demo.observations["images/wrist"]
        assert (picture[..., 0] == 50 * episode).all()
        assert (picture[:, 0, 0, 1:] == 10 * steps[:, None]).all()
        assert demo.attributes["task"] == ("push the block" if episode % 2 else "pull the block")
    with h5py.File(out) as file:
        assert (file.attrs["control_frequency"], file.attrs["robot_type"]) == (10, "point")


no_file_is_left_open = pytest.mark.filterwarnings(
    "error::ResourceWarning", "error::pytest.PytestUnraisableExceptionWarning"
)


@no_file_is_left_open
def test_lerobots_videos_frame_by_frame(out: Path) -> None:
    import_demonstrations(LEROBOT, out, choice=Choice(("images/top",)))
    for episode, demo in enumerate(Demonstrations.read(out)):
        brightness = np.asarray(demo.observations["images/top"]).mean((1, 2, 3))
        np.testing.assert_allclose(brightness, 40 * episode + 5 * np.arange(len(demo)), atol=1.5)


DROID = [
    *(odd.column(f"observation.state.{name}") for name in ("gripper_position", "joint.0")),
    *(odd.column(f"action.{name}") for name in ("gripper_position", "joint_position")),
]


def test_features_that_begin_with_the_name_of_another_keep_their_dots(tmp_path: Path, out: Path) -> None:
    """As in DROID. Each feature is asked for as LeRobot names it, or by its key."""
    dataset = odd.changed(*DROID)(tmp_path)
    keys = ["state", "state.gripper_position", "state.joint.0"]
    import_demonstrations(dataset, out)
    demos = Demonstrations.read(out)
    assert set(demos.observation_shapes) == {*keys, "images/wrist"}
    np.testing.assert_array_equal(demos[1].observations["state.gripper_position"].ravel(), np.arange(5, 11))
    assert {f"obs/{key}" for key in keys} < set(inspect(dataset).fields)
    for asked in (keys, [f"observation.{key}" for key in keys], keys[1:2]):
        out.unlink()
        import_demonstrations(dataset, out, choice=Choice(tuple(asked)))
        expected = {key for key in keys if {key, f"observation.{key}"} & set(asked)}
        assert set(Demonstrations.read(out).observation_shapes) == expected


def test_the_control_is_made_of_the_features_that_are_asked_for(tmp_path: Path, out: Path) -> None:
    dataset = odd.changed(*DROID, odd.renamed("action", "action.continuous"))(tmp_path)
    asked = ["action.joint_position", "action.continuous"]
    ended = call("import", dataset, "--out", out, "--action", asked[0], "--action", asked[1])
    assert (ended.status, ended.out) == (0, f"{out}: 4 demonstrations\n")
    for demo, start in zip(Demonstrations.read(out), (0, 5, 11, 18), strict=True):
        np.testing.assert_array_equal(demo.actions[:, 0], start + np.arange(len(demo)))
        np.testing.assert_allclose(demo.actions[:, 1], 0.1 * np.arange(len(demo)), rtol=1e-6)


BROKEN = odd.values("observation.state", lambda row, value: None if row % 5 else value)


@pytest.mark.parametrize("change", [BROKEN, odd.feature("observation.ghost"), odd.WITHOUT_VIDEOS])
def test_what_is_not_chosen_is_not_read(change: odd.Change, tmp_path: Path, out: Path) -> None:
    import_demonstrations(odd.changed(change)(tmp_path), out, choice=Choice(("observation.images.wrist",)))
    assert set(Demonstrations.read(out).observation_shapes) == {"images/wrist"}


@pytest.mark.parametrize("index", [True, False], ids=["an index of pandas", "a column"])
def test_lerobots_tasks_and_subtasks_are_labels_with_names(index: bool, tmp_path: Path, out: Path) -> None:
    """Subtasks have a table of names, of which one number is missing; the last episode's task changes."""
    column = "__index_level_0__" if index else "subtask"
    names = pyarrow.table({"subtask_index": [2, 0], column: ["lift", "reach"]})

    def framed(table: pyarrow.Table) -> pyarrow.Table:
        tasks = table["task_index"].to_pylist()
        tasks[-3:] = [0, 0, 0]
        place = table.schema.get_field_index("task_index")
        table = table.set_column(place, "task_index", pyarrow.array(tasks))
        return table.append_column("subtask_index", pyarrow.array([2 * (n % 2) for n in range(len(table))]))

    def both(table: pyarrow.Table) -> pyarrow.Table:
        tasks = [*table["tasks"].to_pylist()[:-1], ["push the block", "pull the block"]]
        return table.set_column(table.schema.get_field_index("tasks"), "tasks", pyarrow.array(tasks))

    dataset = odd.changed(odd.rewritten(odd.DATA, framed), odd.rewritten(odd.EPISODES, both))(tmp_path)
    parquet.write_table(names, dataset / "meta" / "subtasks.parquet")
    import_demonstrations(dataset, out)
    demos = Demonstrations.read(out)
    assert json.loads(str(demos.attributes["label_names"])) == {
        "subtask": ["reach", "subtask 1", "lift"],
        "task": ["pull the block", "push the block"],
    }
    assert demos[3].labels["task"].tolist() == [1, 1, 1, 1, 1, 0, 0, 0]
    assert demos[2].labels["task"].tolist() == [0] * 7
    assert demos[0].labels["subtask"].tolist() == [0, 2, 0, 2, 0]


NO_VIDEO = r"file-000\.mp4: the video is missing; leave its observation"
SMALLER = odd.feature("observation.images.top", dtype="video", shape=[11, 12, 3])


def cut(dataset: Path) -> None:
    (dataset / odd.DATA).write_bytes((dataset / odd.DATA).read_bytes()[:-100])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda dataset: (dataset / odd.VIDEO).unlink(), NO_VIDEO),
        (SMALLER, r"mp4: is \d+ x \d+, and meta/info"),
        (cut, r"demo_0: cannot be read, or is damaged"),
    ],
    ids=["no video", "small video", "damaged data"],
)
def test_a_damaged_lerobot_dataset_is_refused(tmp_path: Path, out: Path, change: odd.Change, message) -> None:
    dataset = odd.changed(change)(tmp_path)
    with pytest.raises(DemonstrationsError, match=message):
        import_demonstrations(dataset, out, choice=Choice(videos=True))
    assert not out.exists()


# --- Minari -------------------------------------------------------------------------------------------------


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari.*")


def batched(samples: list[Any]) -> Any:
    """Samples of a space, with a first axis of time in each array."""
    if isinstance(samples[0], dict):
        return {key: batched([sample[key] for sample in samples]) for key in samples[0]}
    if isinstance(samples[0], tuple):
        return tuple(map(batched, map(list, zip(*samples, strict=True))))
    return samples if isinstance(samples[0], str) else np.stack(samples)


@pytest.fixture
def written_by_minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes a dataset with Minari: its folder, and the buffers it was made of."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def make(action: gymnasium.Space) -> tuple[Path, list[EpisodeBuffer]]:
        random = np.random.default_rng(0)
        arm = spaces.Dict({"joints": spaces.Box(-9, 9, (3,), np.float64)})
        camera = spaces.Box(0, 255, (32, 32, 3), np.uint8)
        others = {"goal": spaces.Discrete(4), "mission": spaces.Text(30)}
        space = spaces.Dict({"arm": arm, "camera": camera, **others})
        action.seed(0)
        buffers = []
        for episode in range(4):
            steps = 5 + episode
            observations = {
                "arm": {"joints": random.normal(size=(steps + 1, 3))},
                "camera": np.full((steps + 1, 32, 32, 3), 60 * episode, np.uint8),
                "goal": np.full(steps + 1, episode),
                "mission": ["go to the green ball"] * (steps + 1),
            }
            actions = batched([action.sample() for _ in range(steps)])
            ends = np.arange(steps) == steps - 1
            known = (episode, 7 + episode, None, observations, actions)
            buffers.append(EpisodeBuffer(*known, np.ones(steps), ends, ~ends, {}))
        given = {"observation_space": space, "action_space": action}
        minari.create_dataset_from_buffers("arm/reach-v0", buffers, **given)
        return tmp_path / "arm" / "reach-v0", buffers

    return make


def test_minari(written_by_minari, out: Path) -> None:
    folder, buffers = written_by_minari(spaces.Box(-1, 1, (2,)))
    note = "networks do not read obs/mission: it holds text, not numbers"
    assert import_demonstrations(folder, out).notes == (note,)
    assert "obs/mission holds text, not numbers" in inspect(folder).problems
    demos = Demonstrations.read(out)
    assert demos.lengths == (5, 6, 7, 8)
    for buffer, demo in zip(buffers, demos, strict=True):
        np.testing.assert_array_equal(demo.actions, buffer.actions)
        joints = buffer.observations["arm"]["joints"][:-1]
        np.testing.assert_array_equal(demo.observations["arm/joints"], joints)
        np.testing.assert_array_equal(demo.observations["goal"][:, 0], buffer.observations["goal"][:-1])
        pictures = buffer.observations["camera"][:-1]
        np.testing.assert_allclose(demo.observations["camera"], pictures, atol=2)  # JPEG
        assert demo.attributes["seed"] == buffer.seed
    for other in (folder / "data", folder / "data" / "main_data.hdf5"):
        assert inspect(other).format == "minari"


def test_minari_with_nested_actions(written_by_minari, out: Path) -> None:
    arm = spaces.Dict({"joints": spaces.Box(-1, 1, (2,)), "base": spaces.Box(-1, 1, (1,), np.float64)})
    folder, buffers = written_by_minari(
        spaces.Dict({"arm": arm, "hands": spaces.Tuple((spaces.Discrete(2), spaces.Box(-1, 1, (1, 2))))})
    )
    import_demonstrations(folder, out)
    for buffer, demo in zip(buffers, Demonstrations.read(out), strict=True):
        joints, base = (buffer.actions["arm"][key] for key in ("joints", "base"))
        grasp, fingers = buffer.actions["hands"]
        np.testing.assert_array_equal(demo.actions, np.hstack([base, joints, grasp[:, None], fingers[:, 0]]))
    out.unlink()
    import_demonstrations(folder, out, choice=Choice(actions=("hands/0", "arm/base")))
    np.testing.assert_array_equal(Demonstrations.read(out)[3].actions, np.hstack([grasp[:, None], base]))
    says = r"no action 'hand/0' \(did you mean 'hands/0'\?\); there is: arm"
    with pytest.raises(DemonstrationsError, match=says):
        import_demonstrations(folder, out.with_name("x"), choice=Choice(actions=("hand/0",)))


def test_minaris_text_is_no_control(written_by_minari, out: Path) -> None:
    folder, _ = written_by_minari(spaces.Dict({"jaw": spaces.Box(-1, 1, (1,)), "say": spaces.Text(5)}))
    says = r"demo_0: say holds <U5, not numbers; name the control with"
    with pytest.raises(DemonstrationsError, match=says):
        import_demonstrations(folder, out)
    import_demonstrations(folder, out, choice=Choice(actions=("jaw",)))
    assert Demonstrations.read(out).control_size == 1


def test_minaris_environment_is_never_made(written_by_minari, out: Path) -> None:
    """Without its spaces in the metadata, Minari would run the environment that the data names."""
    folder, _ = written_by_minari(spaces.Box(-1, 1, (2,)))
    path = folder / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    del metadata["observation_space"]
    path.write_text(json.dumps(metadata | {"env_spec": '{"id": "x-v0", "entry_point": "antigravity:x"}'}))
    says = r"metadata\.json does not say its observation and action spaces"
    with pytest.raises(DemonstrationsError, match=says):
        import_demonstrations(folder, out)


def test_minaris_episodes_and_steps_are_counted(written_by_minari, out: Path) -> None:
    """One episode was not stored to its end, one says that it is longer, one has an observation too many;
    then one is gone.
    """
    folder, _ = written_by_minari(spaces.Box(-1, 1, (2,)))
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        file["episode_2"].attrs["total_steps"] = 9
        joints = file["episode_3/observations/arm/joints"][:]
        instead(file, "episode_3/observations/arm/joints", np.concatenate([joints, joints[:1]]))
        del file["episode_1/actions"]
        file["episode_1"].create_dataset("actions", (6, 2), "f4", chunks=(1, 2))[:3] = 1.0
    left_out = import_demonstrations(folder, out, choice=Choice(skip_broken=True)).left_out
    assert Demonstrations.read(out).names == ("demo_0",)
    for name, message in {
        "demo_1": "demo_1: actions claims 6 chunks, but the file holds 3",
        "demo_2": "demo_2: total_steps is 9, and there are 7 actions",
        "demo_3": "demo_3: obs/arm/joints has 10 steps, but actions has 8",
    }.items():
        assert message in left_out[name]
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        del file["episode_1"]
    says = "counts 4 episodes, and the dataset has 3; correct total_episodes"
    with pytest.raises(DemonstrationsError, match=says):
        inspect(folder)


# --- JIGSAWS ------------------------------------------------------------------------------------------------


@pytest.fixture
def surgeons(tmp_path: Path) -> tuple[Path, list[np.ndarray]]:
    """A task's folder in the official layout, and trials: instruments move half as far as their masters."""
    folder, random, trials = tmp_path / "Knot_Tying", np.random.default_rng(0), []
    for part in ("kinematics/AllGestures", "transcriptions"):
        (folder / part).mkdir(parents=True)
    for trial, frames in {"Knot_Tying_B001": 31, "Knot_Tying_C002": 24, "Knot_Tying_C003": 30}.items():
        rows = random.normal(size=(frames, 76))
        for master, instrument in ((0, 57), (19, 38)):  # crossed
            rows[:, instrument : instrument + 3] = 0.5 * np.cumsum(rows[:, master + 12 : master + 15], 0) / 30
        np.savetxt(folder / "kinematics" / "AllGestures" / f"{trial}.txt", rows, fmt="%15.8f")
        trials.append(rows.round(8))
    (folder / "transcriptions" / "Knot_Tying_B001.txt").write_text("3 12 G12 \n13 30 G2 \n")
    (folder / "transcriptions" / "Knot_Tying_C002.txt").write_text("1 24 G11\n\n")
    meta = "Knot_Tying_B001\t\tN\t\t13\t\t2\nKnot_Tying_C002\t\tE\t\t20\n\n"
    (folder / "meta_file_Knot_Tying.txt").write_text(meta)
    return folder, trials


def test_a_task_of_jigsaws(surgeons, out: Path) -> None:
    folder, trials = surgeons
    assert import_demonstrations(folder, out).names == ("demo_0", "demo_1", "demo_2")
    demos = Demonstrations.read(out)
    for demo, rows in zip(demos, trials, strict=True):
        np.testing.assert_array_equal(demo.actions, np.concatenate([rows[:, 12:19], rows[:, 31:38]], 1))
        moved = np.diff(demo.observations["left_position"], axis=0)
        np.testing.assert_allclose(moved, 0.5 * demo.actions[1:, :3] / 30, atol=1e-7)
        np.testing.assert_array_equal(demo.observations["right_rotation"], rows[:, 41:50])
    assert {key for key in demos.observation_shapes if "velocity" in key} == set()
    first, second, third = (demo.labels["gesture"].tolist() for demo in demos)
    assert first == [-1] * 2 + [2] * 10 + [0] * 18 + [-1]  # G2, G11, G12
    assert (second, third) == ([1] * 24, [-1] * 30)
    facts = inspect(out)
    assert facts.frequency == 30
    assert json.loads(demos.attributes["label_names"]) == {"gesture": ["G2", "G11", "G12"]}
    with h5py.File(out) as file:
        about = [dict(file[f"data/demo_{number}"].attrs) for number in range(3)]
    assert [(one["surgeon"], one["trial"], one.get("skill")) for one in about] == [
        ("B", 1, "N"),
        ("C", 2, "E"),
        ("C", 3, None),
    ]


def test_a_source_at_a_lower_rate(surgeons, out: Path) -> None:
    folder, trials = surgeons
    done("import", folder, "--out", out, "--hz", "10")
    demos = Demonstrations.read(out)
    assert demos.lengths == (10, 8, 10)
    means = trials[0][:30].reshape(10, 3, 76).mean(1)
    np.testing.assert_allclose(demos[0].actions[:, :7], means[:, 12:19], rtol=1e-6)
    np.testing.assert_allclose(demos[0].observations["left_position"], means[:, 57:60], rtol=1e-6)
    assert demos[0].labels["gesture"].tolist() == [-1, 2, 2, 2, 0, 0, 0, 0, 0, 0]
    assert inspect(out).frequency == 10


WORDS, NUMBERS = "transcriptions/Knot_Tying_B001.txt", "kinematics/AllGestures/Knot_Tying_B001.txt"
OTHER_RATE = "--hz 20: the source has 30 Hz; give a whole part of that, such as 15, 10, 7.5, 6"


@pytest.mark.parametrize(
    ("change", "more", "message"),
    [
        ((WORDS, "3 x G12"), (), "Knot_Tying_B001.txt: row 1 is no FIRST LAST GESTURE"),
        ((NUMBERS, ""), (), "Knot_Tying_B001.txt is empty"),
        ((NUMBERS, "1 2"), (), "rows of 2 numbers, where JIGSAWS has 76"),
        ((NUMBERS, "1 a"), (), "Knot_Tying_B001.txt is no table of numbers"),
        (None, ("--hz", "20"), OTHER_RATE),
    ],
)
def test_what_is_wrong_with_surgeons_files_is_one_line(surgeons, out: Path, change, more, message) -> None:
    folder, _ = surgeons
    if change:
        (folder / change[0]).write_text(change[1])
    refused(message, "import", folder, "--out", out, *more)
    assert not out.exists()


# --- whole or not at all ------------------------------------------------------------------------------------


class Stopped(Exception):
    pass


def test_an_interrupted_import_leaves_nothing_and_replaces_nothing(out: Path, tmp_path: Path) -> None:
    def stop(event: Counted) -> None:
        if event.done == 3:
            raise Stopped

    with pytest.raises(Stopped):
        import_demonstrations(ROBOMIMIC, out, on_event=stop)
    assert not any(tmp_path.iterdir())
    import_demonstrations(ROBOMIMIC, out)
    assert [path.name for path in tmp_path.iterdir()] == ["demos.hdf5"]
    with pytest.raises(BadInput, match=r"demos\.hdf5: is there already; choose another --out, or remove it"):
        import_demonstrations(ROBOMIMIC, out)


# --- what cannot be used ------------------------------------------------------------------------------------


def test_broken_demonstrations_are_refused_or_left_out(tmp_path: Path, out: Path) -> None:
    source = tmp_path / "source.hdf5"
    demonstrations(5, {"valid": ("demo_1", "demo_2")}).write(source)
    with h5py.File(source, "r+") as file:
        file["data/demo_1/actions"][0, 0] = np.nan
    with pytest.raises(
        DemonstrationsError, match=r"demo_1: actions is nan at step 0, index \[0\]; .*; or leave .*--skip"
    ):
        import_demonstrations(source, out)
    with h5py.File(source, "r+") as file:
        del file["data/demo_3/obs/pose"]
    with pytest.raises(DemonstrationsError, match=r"demo_3: obs/pose is missing, .*; or leave .*--skip"):
        import_demonstrations(source, out)  # headers first
    ended = call("import", source, "--out", out, "--skip-broken")
    assert (ended.status, ended.out) == (0, f"{out}: 3 demonstrations\n")
    assert "left out demo_1: demo_1: actions is nan at step 0, index [0]; repair it" in ended.err
    assert "left out demo_3: demo_3: obs/pose is missing, which demo_0 has" in ended.err
    demos = Demonstrations.read(out)
    assert (demos.names, demos.masks) == (("demo_0", "demo_2", "demo_4"), {"valid": ("demo_2",)})


NO_MASK = "there is no mask 'bettr' (did you mean 'better'?); there is: better, train, valid"
NO_KEY = "demo_0: there is no observation 'objct' (did you mean 'object'?); there is: "
NO_FORMAT = "there is no format 'roboimic' (did you mean 'robomimic'?); there is: lerobot, "
ONE_CONTROL = "has the format robomimic, with one control; --action is for the folder of a Le"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mask", "bettr"], NO_MASK),
        (["--observation", "objct"], NO_KEY),
        (["--format", "lerobot"], "info.json: cannot be read, or is damaged"),
        (["--format", "roboimic"], NO_FORMAT),
        (["--action", "actions"], ONE_CONTROL),
        (["--image-size", "3"], "Invalid value for '--image-size'"),
    ],
)
def test_wrong_choices_are_refused_in_one_line(out: Path, arguments: list[str], message: str) -> None:
    refused(message, "import", ROBOMIMIC, "--out", out, *arguments)
    assert not out.exists()
