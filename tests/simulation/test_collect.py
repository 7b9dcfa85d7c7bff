"""Demonstrations kept by content: what is the same is reused, whatever differs is collected anew."""

import importlib.metadata
import json
import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
import toy_task
from scipy import stats

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.events import Counted
from ddco_pyro.simulation.collect import cache_path, collect
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import DemonstrationsSpec, SpecError, parse_spec, with_overrides
from ddco_pyro.training.data import demonstrations, dimensions
from ddco_pyro.training.networks import Dimensions, build_hierarchy, check_networks

TASK = "toy_task:task"
SPEC = DemonstrationsSpec(count=5, seed=20)


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DDCO_PYRO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_the_same_demonstrations_are_collected_once(own_cache):
    told = []
    path = collect(TASK, SPEC, on_event=told.append)
    assert own_cache in path.parents
    assert told == [Counted("collecting demonstrations", 5, done=done) for done in range(1, 6)]
    before = path.stat()
    assert collect(TASK, SPEC, on_event=told.append) == path
    assert (path.stat().st_mtime_ns, path.stat().st_ino, len(told)) == (before.st_mtime_ns, before.st_ino, 5)


def test_demonstrations_are_the_supervisors_episodes(own_cache):
    read = Demonstrations.read(collect(TASK, SPEC), labels=["phase"])
    assert read.names == tuple(f"demo_{seed}" for seed in range(20, 25))
    for demo, seed in zip(read, range(20, 25), strict=True):
        record = run_episode(toy_task.task, "supervisor", seed).record
        np.testing.assert_array_equal(demo.actions, record.actions)
        np.testing.assert_array_equal(demo.observations["offsets"], record.observations["offsets"])
        np.testing.assert_array_equal(demo.labels["phase"], record.labels["phase"])
        assert demo.attributes == record.attributes


def test_the_supervisors_own_rate_is_stored(own_cache):
    """Of the open-loop plan, because the supervisor hardly ever fails."""
    path = collect(TASK, DemonstrationsSpec(count=12, supervisor="open_loop"))
    stored = json.loads(Demonstrations.read(path).attributes["supervisor"])
    outcomes = [run_episode(toy_task.task, "open_loop", seed).outcome for seed in range(12)]
    successes = int(sum(one["success"] for one in outcomes))
    assert 0 < successes < 12
    interval = stats.binomtest(successes, 12).proportion_ci(method="wilson")
    rate = {"rate": successes / 12, "interval": [interval.low, interval.high]}
    assert stored["success"] == {"successes": successes, "trials": 12} | rate
    errors = [one["error"] for one in outcomes if not math.isnan(one["error"])]
    assert stored["error"]["trials"] == len(errors)
    assert stored["error"]["mean"] == pytest.approx(np.mean(errors))


@pytest.mark.parametrize("key", ["count", "seed", "supervisor", "valid_fraction", "labels"])
def test_other_demonstrations_have_another_file_but_not_another_split_or_other_labels(key):
    other = {"count": 6, "seed": 21, "supervisor": "open_loop", "valid_fraction": 0.5, "labels": "phase"}[key]
    one = cache_path(toy_task.task, TASK, SPEC)
    same = cache_path(toy_task.task, TASK, SPEC.model_copy(update={key: other})) == one
    assert same == (key in ("valid_fraction", "labels"))


def test_changed_sources_have_another_file(tmp_path):
    source = tmp_path / "source.py"
    task = replace(toy_task.task, sources=(source,))
    source.write_text("gain = 1")
    one = cache_path(task, TASK, SPEC)
    source.write_text("gain = 2")
    assert cache_path(task, TASK, SPEC) != one
    source.write_text("gain = 1")
    assert cache_path(task, TASK, SPEC) == one


@pytest.mark.parametrize("package", ["mujoco", "dm-control", "toy-task"])
def test_another_version_of_a_simulator_or_of_the_tasks_package_has_another_file(monkeypatch, package):
    """The toy task is registered by the package ``toy-task``; one named by its module has no package."""
    registered, named = cache_path(toy_task.task, "toy", SPEC), cache_path(toy_task.task, TASK, SPEC)
    version = importlib.metadata.version
    other = lambda name: version(name) + ".other" * (name == package)  # noqa: E731
    monkeypatch.setattr(importlib.metadata, "version", other)
    assert cache_path(toy_task.task, "toy", SPEC) != registered
    assert (cache_path(toy_task.task, TASK, SPEC) == named) == (package == "toy-task")


def test_an_unknown_supervisor_is_refused_in_one_line():
    message = r"^task 'toy' has no policy 'expert' to record \(it has: open_loop, supervisor\)$"
    with pytest.raises(DemonstrationsError, match=message):
        collect(TASK, DemonstrationsSpec(supervisor="expert"))


# --- which demonstrations a spec means ----------------------------------------------------------------------


SIZE = Dimensions({"offsets": (4,), "camera": (8, 8, 3), "visited": (1,)}, control_size=2, steps=12)


def spec(**changes):
    given = {"task": TASK, "observations": ["offsets"], "baseline": "flat", "demonstrations": {"count": 3}}
    return parse_spec(given | changes)


@pytest.fixture
def path(tmp_path):
    records = [
        Demonstration(f"demo_{n}", {"offsets": np.zeros((n, 7))}, np.arange(3.0 * n).reshape(n, 3))
        for n in (4, 9)
    ]
    Demonstrations(tuple(records)).write(tmp_path / "demos.hdf5")
    return tmp_path / "demos.hdf5"


def test_dimensions_come_from_the_file(path):
    of_file = {"demonstrations": {"path": str(path)}}
    for given in (spec(**of_file), spec(task=None, **of_file)):
        assert dimensions(given) == Dimensions({"offsets": (7,)}, 3, 9)


def test_what_never_changes_is_constant(path):
    """In all demonstrations: dimension 1 changes from one to the other, within neither."""
    with h5py.File(path, "r+") as file:
        for name, value in (("demo_4", 1.0), ("demo_9", 2.0)):
            file[f"data/{name}/actions"][:, 1:] = [value, -0.25]
    found = dimensions(spec(demonstrations={"path": str(path)}))
    assert (found.constant, found.control_size) == ({2: -0.25}, 3)
    assert [one.note for one in found.control[1:]] == [
        "takes two values, 1 and 2",
        "constant (-0.25): no part of the model, emitted as it is",
    ]
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            group["actions"][:, :2] = 7.0
    with pytest.raises(DemonstrationsError, match=r"every dimension is constant \(7, 7, -0\.25\)"):
        dimensions(spec(demonstrations={"path": str(path)}))


def test_demonstrations_can_be_left_out(path):
    """Nothing of them is looked at: they may hold NaN, and other shapes than the rest."""
    with h5py.File(path, "r+") as file:
        file["data/demo_4/actions"][2] = np.nan
        file["mask/valid"] = [b"demo_4", b"demo_9"]
    left = spec(demonstrations={"path": str(path), "exclude": ["demo_4"]})
    found = demonstrations(left)
    assert (found.names, dict(found.masks)) == (("demo_9",), {"valid": ("demo_9",)})
    says = r"demo_4: actions is nan at step 2, index \[0\]; repair it, or"
    with pytest.raises(DemonstrationsError, match=says):
        demonstrations(spec(demonstrations={"path": str(path)}))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["demo_9", "demo_04"], r"exclude: there is no demonstration 'demo_04' \(did you mean 'demo_4'\?\)$"),
        (["demo_4", "demo_9"], r"demonstrations.exclude: leaves every demonstration out; keep some$"),
    ],
)
def test_leaving_out_the_wrong_ones_is_refused(path, names, message):
    for ask in (demonstrations, dimensions):
        with pytest.raises(DemonstrationsError, match=message):
            ask(spec(demonstrations={"path": str(path), "exclude": names}))


def test_demonstrations_are_collected_where_there_is_no_file_yet(tmp_path):
    path, told = tmp_path / "later.hdf5", []
    given = spec(demonstrations={"path": str(path), "count": 3, "labels": "phase"})
    found = demonstrations(given, told.append)
    assert found.names == ("demo_0", "demo_1", "demo_2")
    assert told[-1] == Counted("collecting demonstrations", 3, done=3)
    assert (set(found[0].observations), set(found[0].labels)) == ({"offsets"}, {"phase"})
    assert path.exists()


def test_demonstrations_may_come_from_another_task(tmp_path):
    """``toy_task:short`` has episodes of 5 steps; the task to roll out in does not exist."""
    elsewhere = {"task": "toy_task:short", "path": str(tmp_path / "demos.hdf5"), "count": 3}
    given = spec(task="not_registered", demonstrations=elsewhere)
    assert dimensions(given) == Dimensions({"offsets": (4,), "visited": (1,)}, 2, 5)
    assert demonstrations(given).lengths == (5, 5, 5)


LEVEL = {"count": 2, "policy": {"network": "linear"}}
CONV = {"network": "conv"}
ABOVE = LEVEL | {"name": "task", "termination": CONV}
ONE_NUMBER = {"observations": ["visited"], "report": {"trajectory": "visited"}}


def own(options):
    """A network of one's own that needs ``passes``."""
    return {"network": "user_networks:Diverging", "options": dict.fromkeys(options, 1)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": ["offsets", "pose", "jaw"]}, r"^observations: there is no pose, jaw \(there are:"),
        (ONE_NUMBER, r"^report\.trajectory: 'visited' is 1"),
        ({"report": {"trajectory": ["offsets", "3:9"]}}, r"^report\.trajectory: 'offsets\[3:9\]' is 1 num"),
        ({"report": {"trajectory": ["offsets", "0:4"]}}, r"^report\.trajectory: 'offsets\[0:4\]' is 4 num"),
        (
            {"report": {"trajectory": [["offsets", "0:3"], ["offsets", "2:4"]]}},
            r"^report\.trajectory: offsets\[2:4\] is in the plane, offsets\[0:3\] in space; name as many",
        ),
        ({"observations": ["camera"]}, r"^baseline\.policy: reads vectors, but camera are images"),
        (
            {"baseline": None, "hierarchy": {"levels": [LEVEL, ABOVE]}},
            r"^hierarchy\.levels\.1\.termination: needs an image",
        ),
        (
            {"baseline": None, "hierarchy": {"levels": [LEVEL], "meta_policy": {"network": "nowhere:Net"}}},
            r"^hierarchy\.meta_policy: network 'nowhere:Net' cannot be imported",
        ),
        *(
            (
                {"baseline": {"kind": "flat", "policy": own(options)}},
                rf"^baseline\.policy: .* made with options .*{why}",
            )
            for options, why in {
                (): "missing 1 required positional argument: 'passes'",
                ("passes", "gian"): "got an unexpected keyword argument 'gian'",
                ("passes", "shape"): "got multiple values for argument 'shape'",
            }.items()
        ),
    ],
)
def test_a_spec_that_does_not_fit_says_where(changes, message):
    with pytest.raises(SpecError, match=message):
        build_hierarchy(spec(**changes), SIZE)


HIDDEN = "hierarchy.levels.0.policy.hidden"
UNCOUNTED = "the networks have more parameters than a machine can count"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({HIDDEN: [10**6, 10**6]}, r"the networks have \d+ parameters, more than 50000000"),
        ({HIDDEN: [10**30]}, UNCOUNTED),
        ({"hierarchy.levels.0.count": 10**9}, "the levels have 1000000001 joint choices, at most 10000"),
    ],
)
def test_a_model_that_fills_the_memory_is_refused_before_it_is_made(toy_spec, overrides, message):
    spec, size = with_overrides(toy_spec, overrides), Dimensions({"offsets": (4,), "visited": (1,)}, 2, 12)
    with pytest.raises(SpecError, match=message):
        check_networks(spec, size)
