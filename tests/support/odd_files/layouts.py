"""Files and folders of other libraries, in their true layouts: some are read, others have to be converted."""

import json
from functools import partial
from pathlib import Path

import cv2
import h5py
import numpy as np

from odd_files import Row

LENGTHS = 3, 5, 4
"""Steps of each demonstration."""


def control(number: int) -> np.ndarray:
    """The control of a demonstration [T, 2]; every number tells which."""
    steps = np.arange(LENGTHS[number], dtype=np.float32)
    return np.stack([steps, np.full_like(steps, number)], 1) / 10


def state(number: int, more: int = 0) -> np.ndarray:
    """The state before each step [T, 3], and ``more`` states after the last."""
    steps = np.arange(LENGTHS[number] + more, dtype=np.float32)
    return np.stack([steps, steps**2, np.full_like(steps, number)], 1)


def pictures(number: int) -> np.ndarray:
    """Pictures of one colour each [T, 16, 24, 3]."""
    colours = np.arange(LENGTHS[number])[:, None] * [10, 20, 30] + number
    return np.broadcast_to(colours[:, None, None], (LENGTHS[number], 16, 24, 3)).astype(np.uint8)


def maniskill(folder: Path, obs: str) -> Path:
    """A file as ManiSkill's ``RecordEpisode`` writes it, with observations as an array, a tree, or none."""
    path = folder / "trajectory.h5"
    with h5py.File(path, "w") as file:
        for number, steps in enumerate(LENGTHS):
            group = file.create_group(f"traj_{number}", track_order=True)
            group["actions"] = control(number)
            for name in ("terminated", "truncated", "success"):
                group[name] = np.arange(steps) == steps - 1
            group["env_states/actors/cube"] = state(number, 1)
            if obs == "array":
                group["obs"] = state(number, 1)
            if obs == "tree":
                group["obs/agent/qpos"] = state(number, 1)
                group["obs/extra/is_grasped"] = np.arange(steps + 1) > 1
    path.with_suffix(".json").write_text(json.dumps({"env_info": {"env_id": "PickCube-v1"}, "episodes": []}))
    return path


def act_file(path: Path, number: int, encoded: bool = False, base: bool = False) -> None:
    """An episode as ACT's and Mobile ALOHA's recording scripts write it."""
    with h5py.File(path, "w") as file:
        file.attrs["sim"] = True
        file["action"] = control(number)
        file["observations/qpos"] = state(number)
        if base:
            file["base_action"] = -control(number)
        seen = pictures(number)
        if encoded:
            file.attrs["compress"] = True
            packed = [cv2.imencode(".jpg", one, [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for one in seen]
            longest = max(map(len, packed))
            seen = np.stack([np.pad(one, (0, longest - len(one))) for one in packed])
        file["observations/images/top"] = seen


def act(folder: Path, encoded: bool = False, base: bool = False) -> Path:
    dataset = folder / "episodes"
    dataset.mkdir()
    for number in range(len(LENGTHS)):
        act_file(dataset / f"episode_{number}.hdf5", number, encoded, base)
    return dataset


def act_twice(folder: Path) -> Path:
    dataset = act(folder)
    act_file(dataset / "episode_01.hdf5", 1)
    return dataset


def robosuite(folder: Path, attribute: str) -> Path:
    """What robosuite records, and what robomimic's ``convert_robosuite`` makes: states, controls alone."""
    path = folder / "demo.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs[attribute] = "{}"
        for number in range(len(LENGTHS)):
            demo = data.create_group(f"demo_{number + 1}")
            demo.attrs["model_file"] = "<mujoco/>"
            demo["states"], demo["actions"] = state(number), control(number)
    return path


def zarr(folder: Path) -> Path:
    """A replay buffer of diffusion policy, as zarr 2 writes it."""
    store = folder / "pusht.zarr"
    for group in ("", "data", "meta"):
        (store / group).mkdir()
        (store / group / ".zgroup").write_text('{"zarr_format": 2}')
    (store / "meta" / "episode_ends").mkdir()
    return store


def tfds(folder: Path) -> Path:
    """A dataset of tensorflow_datasets, named without its version."""
    version = folder / "toto" / "0.1.0"
    version.mkdir(parents=True)
    for name in ("dataset_info.json", "features.json"):
        (version / name).write_text("{}")
    (version / "toto-train.tfrecord-00000-of-00001").write_bytes(b"")
    return version.parent


def hdf5(folder: Path, *groups: str) -> Path:
    """An HDF5 file with these groups."""
    with h5py.File(folder / "trajectory.hdf5", "w") as file:
        for group in groups:
            file[group] = state(0)
    return folder / "trajectory.hdf5"


def within(folder: Path, *names: str) -> Path:
    """A folder with empty files of these names."""
    for name in names:
        path = folder / "dataset" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return folder / "dataset"


def lerobot_v2(folder: Path) -> Path:
    dataset = folder / "pusht"
    (dataset / "meta").mkdir(parents=True)
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    said = {"codebase_version": "v2.1", "features": {}, "data_path": path}
    (dataset / "meta" / "info.json").write_text(json.dumps(said))
    return dataset


def strange(folder: Path) -> Path:
    """A folder of nothing known, whose name would do something to a terminal."""
    path = folder / "\x1b[2J\nx"
    path.mkdir()
    return path


IMPORT = "ddco-pyro import"
"""What ``inspect`` and ``init`` say of a file that can be imported."""

ROWS = {
    "maniskill array": Row(partial(maniskill, obs="array"), IMPORT),
    "maniskill tree": Row(partial(maniskill, obs="tree"), IMPORT),
    "maniskill without observations": Row(
        partial(maniskill, obs="none"),
        r"python -m mani_skill\.trajectory\.replay_trajectory --traj-path .* --save-traj -o state",
    ),
    "act": Row(act, None),
    "act encoded": Row(partial(act, encoded=True), None),
    "act twice": Row(act_twice, r"episode_0?1\.hdf5: has the number of episode_0?1\.hdf5"),
    "robosuite": Row(
        partial(robosuite, attribute="env_info"),
        r"conversion\.convert_robosuite --dataset .* && .*dataset_states_to_obs --dataset",
    ),
    "robosuite prepared": Row(
        partial(robosuite, attribute="env_args"), r"python -m robomimic\.scripts\.dataset_states"
    ),
    "zarr": Row(zarr, r"is a zarr store, as diffusion policy writes them; .*docs/own\.md"),
    "tfds": Row(tfds, r"is a TensorFlow dataset \(RLDS\); .*docs/own\.md"),
    "mcap": Row(
        lambda folder: within(folder, "x.mcap") / "x.mcap", r"is a recording of ROS: .* rosbags.*docs/own\.md"
    ),
    "RoboMIND": Row(
        lambda folder: hdf5(folder, "puppet/joint_position", "master/joint_position"),
        r"has the layout of RoboMIND, with observations in puppet and controls in master; .*docs/own\.md",
    ),
    "AgiBot": Row(
        lambda folder: hdf5(folder, "state/joint/position", "action/joint/position", "timestamp"),
        "has the layout of AgiBot World, with observations in state and controls in action",
    ),
    "RoboSet": Row(lambda folder: hdf5(folder, "Trial0/data/qp_arm"), "has the layout of RoboSet"),
    "lerobot v2": Row(
        lerobot_v2, r"v2\.1, and v3\.x can be read; .*: python -m lerobot\..*convert_dataset_v21_to_v30"
    ),
    "strange name": Row(strange, "is a folder of no known format"),
}
