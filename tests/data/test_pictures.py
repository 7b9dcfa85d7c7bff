"""Pictures stay in their file: what is read of them, what networks see, and a fit is the same to a bit."""

import pickle
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from command_line import call
from dots import followed
from odd_files.hdf5 import spoil
from planted import small_spec

import ddco_pyro
from ddco_pyro.acting.controller import Window
from ddco_pyro.data.arrays import LazyArray
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.data.pictures import Transform, shift_into
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.digest import digest
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.spec import ObservationSpec, SpecError, parse_spec
from ddco_pyro.training.networks import Dimensions, build_hierarchy

HEIGHT, WIDTH = 12, 10
CONV = {"network": "conv", "layers": [{"filters": 3, "kernel": 3, "stride": 2, "padding": 1}], "hidden": [5]}
RAW = {"key": "camera", "crop": [1, 2, 10, 8], "resize": [5, 4]}


def demonstrations(number: int = 8) -> Demonstrations:
    """In memory: short ones, and a long one."""
    random = np.random.default_rng(0)

    def one(index: int) -> Demonstration:
        steps = 40 if index == 2 else 6 + index
        seen = {
            "pose": random.normal(size=(steps, 3)),
            "camera": random.integers(0, 256, (steps, HEIGHT, WIDTH, 3), dtype=np.uint8),
        }
        labels = {"phase": np.arange(steps) // 4}
        return Demonstration(f"demo_{index}", seen, random.normal(size=(steps, 2)), labels)

    return Demonstrations(tuple(one(index) for index in range(number)))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "demos.hdf5"
    demonstrations().write(path)
    return path


def spec_of(path: Path, *observations: Any, **training: Any) -> dict[str, Any]:
    level = {"count": 2, "policy": CONV, "termination": {"network": "linear", "inputs": ["pose"]}}
    return {
        "demonstrations": {"path": str(path), "valid_fraction": 0.25, "labels": "phase"},
        "observations": ["pose", *observations],
        "hierarchy": {"levels": [level], "meta_policy": {"network": "lstm", "over": CONV, "hidden": 3}},
        "training": {"epochs": 2, "batch_size": 3, "patience": None, **training},
        "compare_with": [{"kind": "flat", "policy": CONV}],
    }


def bits(fit: ddco_pyro.Fit) -> bytes:
    models = (fit.hierarchy, *(beside.hierarchy for beside in fit.baselines.values()))
    return b"".join(value.numpy().tobytes() for model in models for value in model.state_dict().values())


# --- the file -----------------------------------------------------------------------------------------------


def test_pictures_of_a_file_are_read_when_asked_for(kept: Path) -> None:
    read, made = Demonstrations.read(kept), demonstrations()
    for demo, original in zip(read, made, strict=True):
        pictures = demo.observations["camera"]
        assert isinstance(pictures, LazyArray)
        assert isinstance(demo.observations["pose"], np.ndarray)
        np.testing.assert_array_equal(pictures[3:6], original.observations["camera"][3:6])
        np.testing.assert_array_equal(pictures[-1], original.observations["camera"][-1])
        np.testing.assert_array_equal(pictures[1:6:2], original.observations["camera"][1:6:2])
        np.testing.assert_array_equal(pictures, original.observations["camera"])
        assert len(pickle.dumps(pictures)) < 1000
    assert read.observation_shapes == made.observation_shapes
    assert digest(read).observations == digest(made).observations


def test_a_file_that_has_changed_since(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    demonstrations().write(path)
    pictures = Demonstrations.read(path)[0].observations["camera"]
    with h5py.File(path, "r+") as file:
        del file["data/demo_0/obs/camera"]
    with pytest.raises(DemonstrationsError, match="demo_0: obs/camera has changed since"):
        pictures[:]


# --- what networks see --------------------------------------------------------------------------------------


def test_transform_by_hand() -> None:
    picture = np.zeros((1, 4, 4, 3), np.uint8)
    picture[0, 1:3, 1:3] = [[[10, 20, 30], [50, 60, 70]], [[90, 100, 110], [130, 140, 150]]]
    cut = Transform(crop=(1, 1, 2, 2))
    np.testing.assert_array_equal(cut(picture), picture[:, 1:3, 1:3])
    np.testing.assert_array_equal(cut._replace(resize=(1, 1))(picture), [[[[70, 80, 90]]]])  # means
    for transform in (cut, cut._replace(resize=(1, 2)), Transform(resize=(8, 7))):
        assert transform(picture).shape[1:] == transform.shape(picture.shape[1:])


def test_pictures_are_cut_and_scaled_wherever_they_are(kept: Path) -> None:
    encoder = ObservationEncoder([ObservationSpec(**RAW)], {"camera": (HEIGHT, WIDTH, 3)})
    assert encoder.images == {"camera": (5, 4, 3)}
    both = (Demonstrations.read(kept), demonstrations())
    read, made = ([demo.observations for demo in demos] for demos in both)
    seen, expected = (encoder.inputs(each).loaded().images["camera"] for each in (read, made))
    assert torch.equal(seen, expected)
    first = made[0]["camera"][0, 1:11, 2:10]
    scaled = cv2.resize(first, (4, 5), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(seen[0, 0], scaled)


def shifted(frames: np.ndarray, down: int, right: int) -> np.ndarray:
    moved = np.empty_like(frames)
    shift_into(moved, frames, down, right)
    return moved


def test_shifting_repeats_the_edge() -> None:
    picture = np.arange(9, dtype=np.uint8).reshape(1, 3, 3, 1)
    np.testing.assert_array_equal(shifted(picture, 1, 0)[0, ..., 0], [[0, 1, 2], [0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(shifted(picture, 0, -2)[0, ..., 0], [[2, 2, 2], [5, 5, 5], [8, 8, 8]])
    np.testing.assert_array_equal(shifted(picture, 0, 0), picture)


def test_a_trajectory_is_shifted_as_one_and_anew_in_each_epoch() -> None:
    spec = parse_spec(spec_of(Path("unused"), {"key": "camera", "shift": 3}))
    encoder = ObservationEncoder(spec.observations, demonstrations().observation_shapes)
    demos = demonstrations()
    inputs = encoder.inputs(demo.observations for demo in demos)
    whole = Batch(inputs, torch.zeros(8, 40, 2), torch.tensor(demos.lengths))
    for seed in (1, 2):
        seen = whole.varied(encoder.shifts, seed)
        shifts = seen.inputs.images["camera"].shifts
        assert np.abs(shifts).max() <= 3
        assert len(np.unique(shifts, axis=0)) > 3
        pictures = seen.select(torch.tensor([5, 2])).inputs.loaded().images["camera"]
        for row, n in enumerate((5, 2)):
            expected = shifted(demos[n].observations["camera"], *shifts[n])
            np.testing.assert_array_equal(pictures[row, : len(expected)], expected)
    again, other = (whole.varied(encoder.shifts, seed).inputs.images["camera"].shifts for seed in (2, 1))
    assert (again == shifts).all()
    assert (other != shifts).any()


NOT_WITHIN = r"'camera' crop: \[3, 3, 10, 4\] is not within 12 × 10 pixels"


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"key": "camera", "crop": [3, 3, 10, 4]}, NOT_WITHIN),
        ({"key": "pose", "resize": [4, 4]}, r"'pose' has shape \[3\] at each step: crop and resize are for"),
        ({"key": "pose", "shift": 1}, r"'pose' has shape \[3\] at each step: shift is f"),
        ({"key": "camera", "bins": 4}, r"'camera' has pictures: bins are for vectors"),
    ],
)
def test_what_cannot_be_cut_is_refused(kept: Path, observation: dict[str, Any], message: str) -> None:
    data = spec_of(kept)
    data["observations"] = [one for one in ("pose", "camera") if one != observation["key"]]
    data["observations"].insert(1, observation)
    with pytest.raises(SpecError, match=message):
        ddco_pyro.fit(parse_spec(data))


# --- a fit --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunks", [False, True])
def test_a_streamed_fit_is_that_in_memory(kept: Path, chunks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, weights and numbers, in chunks of time too, with cut and shifted pictures."""
    starts = ["vq_controls" if chunks else "vq"]
    spec = parse_spec(spec_of(kept, {**RAW, "shift": 1}, starts=starts))
    if chunks:
        step_bytes = build_hierarchy(spec, Dimensions.of(demonstrations())).step_bytes
        monkeypatch.setattr("ddco_pyro.model.hierarchy.BYTES_AT_ONCE", 17 * step_bytes)
    streamed, whole = ddco_pyro.fit(spec), ddco_pyro.fit(spec, demonstrations())
    assert isinstance(streamed.demonstrations[0].observations["camera"], LazyArray)
    assert bits(streamed) == bits(whole)
    numbers = [fit.metrics.model_dump(exclude={"seconds"}) for fit in (streamed, whole)]
    assert numbers[0] == numbers[1]
    assert numbers[0]["options"]
    stored, memory = Demonstrations.read(kept), demonstrations()
    np.testing.assert_array_equal(streamed.log_likelihood(stored), whole.log_likelihood(memory))
    np.testing.assert_array_equal(streamed.posterior(stored).u[0], whole.posterior(memory).u[0])
    assert streamed.segment(stored)[0].segments == whole.segment(memory)[0].segments


def test_a_controller_sees_what_networks_were_trained_on(kept: Path) -> None:
    fit = ddco_pyro.fit(parse_spec(spec_of(kept, RAW, epochs=1)))
    demo = demonstrations()[1]
    seen = [{key: values[step] for key, values in demo.observations.items()} for step in range(len(demo))]
    with torch.no_grad():
        said = fit.hierarchy(fit.hierarchy.encoder.inputs([demo.observations]))
        window, states = Window(fit.hierarchy.encoder), None
        for step, observation in enumerate(seen):
            now, states = fit.hierarchy.advance(window.inputs(observation), states)
            for one, whole in zip(now.tensors(), said.tensors(), strict=True):
                torch.testing.assert_close(one[0, 0], whole[0, step])
    with pytest.raises(BadInput, match=r"shape \(5, 4, 1\), the demonstrations had \(12, 10, 3\)"):
        fit.controller().act(seen[0] | {"camera": np.zeros((5, 4, 1), np.uint8)})


def test_a_damaged_picture_is_one_line(kept: Path, tmp_path: Path) -> None:
    path = tmp_path / "damaged.hdf5"
    path.write_bytes(kept.read_bytes())
    spoil(path, "data/demo_2/obs/camera", chunk=30)
    spec = tmp_path / "spec.yaml"
    spec.write_text(yaml.safe_dump(spec_of(path, "camera")))
    ended = call("fit", spec, "--out", tmp_path / "run")
    assert (ended.status, ended.err.count("ddco-pyro:")) == (2, 1)
    assert f"ddco-pyro: {path}: demo_2: obs/camera cannot be read" in ended.err.splitlines()[-1]


# --- a policy is learnt from pictures -----------------------------------------------------------------------


FIRST = {"filters": 4, "kernel": 5, "stride": 2, "padding": 2}
LAYERS = [FIRST, {"filters": 4, "kernel": 3, "padding": 1}]
CONVOLUTION = {"network": "conv", "layers": LAYERS, "pool": "spatial_softmax", "hidden": [16]}


def test_a_dot_is_followed():
    """With less than a fifth of the error of the best control that does not look."""
    training = {"epochs": 60, "batch_size": 4, "optimizer": {"lr": 0.01}}
    spec = small_spec((), CONVOLUTION, observations=["camera"], control={"std": 0.1}, training=training)
    controller, new = ddco_pyro.fit(spec, followed(16)).controller(), followed(8, seed=1)
    squared = []
    for demo in new:
        controller.reset()
        acted = [controller.act({"camera": picture}) for picture in demo.observations["camera"]]
        squared.append(np.square(acted - demo.actions).mean())
    unseen = np.concatenate([demo.actions for demo in new]).std(0)
    assert np.sqrt(np.mean(squared)) < 0.2 * np.sqrt(np.square(unseen).mean())
