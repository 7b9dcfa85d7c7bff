"""Pictures of a task's cameras: drawn where a spec observes them, and nowhere else."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import toy_task
from joblib import parallel_config
from planted import LINEAR, small_spec
from toy_task import DRAWN, watched

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.arrays import LazyArray
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources.video import frames
from ddco_pyro.encoding import About, Backbone, Encoder, Projection
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.simulation import collect as collecting
from ddco_pyro.simulation.cameras import Encoded
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import DemonstrationsSpec
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import Dimensions, build_hierarchy

TASK = "toy_task:watched"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Nothing is drawn yet, and nothing collected; all that is drawn is drawn in this process."""
    monkeypatch.setenv("DDCO_PYRO_CACHE", str(tmp_path / "cache"))
    DRAWN.clear()
    with parallel_config(backend="sequential"):
        yield


def spec_of(*observations, **parts):
    layers = [{"filters": 2, "kernel": 5, "stride": 2, "padding": 2}]
    conv = {"network": "conv", "layers": layers, "pool": "spatial_softmax", "hidden": [4]}
    return small_spec(
        (),
        conv if "camera" in observations else LINEAR,
        task=TASK,
        demonstrations={"count": 4, "valid_fraction": 0.25},
        observations=list(observations),
        training={"epochs": 1},
        rollout={"episodes": 2},
        **parts,
    )


def test_an_episode_is_drawn_where_its_pictures_are_observed():
    """The pictures are those of the states before each control, and all else is as without them."""
    runs = (run_episode(watched, "supervisor", 3, observed=names) for names in (["camera"], ["offsets"]))
    seen, blind = (run.record for run in runs)
    assert list(range(len(seen) + 1)) == DRAWN
    assert seen.observations.keys() - blind.observations.keys() == {"camera"}
    np.testing.assert_array_equal(seen.actions, blind.actions)
    environment = toy_task.task.load(3)
    environment.reset()
    for control, picture in zip(seen.actions, seen.observations["camera"], strict=True):
        np.testing.assert_array_equal(picture, toy_task.frame(environment))
        environment.step(control)


def test_an_encoder_stands_in_for_the_pictures():
    """A policy acts on features of the pictures of the very same states."""

    def brightness(picture):
        return picture.mean((0, 1), dtype=np.float32)

    coded = replace(watched, cameras={"colour": Encoded(watched.cameras["camera"], brightness, 3)})
    assert coded.watched(0, ["colour"]).observation_spec()["colour"].shape == (3,)
    seen, told = (
        run_episode(one, "supervisor", 3, observed=[name]).record
        for one, name in ((watched, "camera"), (coded, "colour"))
    )
    expected = [*map(brightness, seen.observations["camera"])]
    np.testing.assert_array_equal(told.observations["colour"], expected)
    policy = spec_of("colour")
    size = Dimensions({"colour": (3,)}, seen.actions.shape[1], len(seen))
    hierarchy = build_hierarchy(policy, size)
    controller = Controller(hierarchy, policy.rollout.control, policy.rollout.options)
    played = run_episode(coded, controller, 3, observed=hierarchy.encoder.shapes, keep=["colour"])
    expected = brightness(seen.observations["camera"][0])
    np.testing.assert_array_equal(played.record.observations["colour"][0], expected)


def test_another_encoder_has_another_file():
    """Its weights decide what is recorded, and they lie in no source of the task."""

    def path(scale, observed):
        backbone = Backbone("user_encoders:means", allow_code=True)
        about = About(encoder=backbone.name, observation="camera", picture=[48, 65, 3], features=6, size=6)
        encoder = Encoder(about, backbone, Projection(np.zeros(6), scale * np.eye(6), 1.0))
        coded = replace(watched, cameras={"colour": Encoded(watched.cameras["camera"], encoder, 4)})
        return collecting.cache_path(coded, TASK, DemonstrationsSpec(count=5), observed)

    assert path(1, ["colour"]) == path(1, ["colour"]) != path(2, ["colour"])
    assert path(1, ["offsets"]) == path(2, ["offsets"])


def test_pictures_are_collected_where_the_spec_observes_them(monkeypatch):
    """Compressed and a frame in each chunk; in slices as long as memory allows; in a file of their own."""
    monkeypatch.setattr(collecting, "EPISODES_WITH_PICTURES", 2)
    spec = DemonstrationsSpec(count=5, seed=20)
    blind = collecting.collect(TASK, spec, observed=["offsets"])
    path = collecting.collect(TASK, spec, observed=["camera"])
    assert path != blind
    assert blind == collecting.cache_path(watched, TASK, spec)
    with h5py.File(path) as file:
        dataset = file["data/demo_22/obs/camera"]
        assert (dataset.dtype, dataset.chunks, dataset.compression) == (np.uint8, (1, 48, 65, 3), "gzip")
    read, without = Demonstrations.read(path), Demonstrations.read(blind)
    assert read.names == without.names == tuple(f"demo_{seed}" for seed in range(20, 25))
    for demo, other in zip(read, without, strict=True):
        np.testing.assert_array_equal(demo.actions, other.actions)
        assert isinstance(demo.observations["camera"], LazyArray)
        seed = int(demo.name.removeprefix("demo_"))
        record = run_episode(watched, "supervisor", seed, observed=["camera"]).record
        np.testing.assert_array_equal(demo.observations["camera"], record.observations["camera"])


def test_a_spec_with_a_camera_is_checked_fitted_and_rolled_out(tmp_path):
    """Its shape is known before anything is collected, and all that act see the camera."""
    spec = spec_of("offsets", "camera")
    assert dimensions(spec).shapes["camera"] == (48, 65, 3)
    fit = ddco_pyro.fit(spec, out=tmp_path / "run")
    DRAWN.clear()
    measured = roll_out(fit, 2, film=1, jobs=1).methods["flat"].measures["success"]
    assert DRAWN
    assert list(frames(fit.folder / "videos" / "flat-1000.mp4"))
    controller, seen = fit.controller(), fit.hierarchy.encoder.shapes
    alone = [run_episode(watched, controller, seed, observed=seen, keep=()) for seed in range(1000, 1002)]
    assert [one.outcome["success"] for one in alone].count(1.0) == measured.successes
