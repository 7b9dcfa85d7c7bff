"""The spec that ``init`` writes fits as it is, and leaves out what cannot be fitted."""

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from command_line import call, done, refused, with_set
from odd_files.kinds import ROWS
from random_demonstrations import demonstration, demonstrations, numbered
from scipy import stats

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.report.likelihood import stds
from ddco_pyro.spec import Spec, load_spec, with_overrides
from ddco_pyro.training.data import demonstrations as read_demonstrations
from ddco_pyro.training.data import outline, seen, train_and_valid


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "my demos: 1.hdf5"
    demonstrations(6).write(found)
    return found


def add(path: Path, key: str, value: float) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            group[f"obs/{key}"] = np.full((len(group["actions"]), 2), value)


NOISE = 0.1


def two_skills(path: Path, number: int = 12) -> None:
    """One skill follows ``place``, the other flees it; ``side`` tells them apart, ``goal`` is constant."""
    random = np.random.default_rng(0)
    records = []
    for _ in range(number):
        skill = np.repeat([5, 2, 5], [4, 5, 4])
        side = np.where(skill == 5, 1.0, -1.0)[:, None]
        place = random.normal(size=(13, 1))
        seen = {"side": side + 0.1 * random.normal(size=(13, 1)), "place": place}
        seen["goal"] = np.full((13, 2), 3.0)
        actions = side * place + NOISE * random.normal(size=(13, 1))
        records.append((seen, actions, {"skill": skill}))
    numbered(records).write(path)


def short_of_the_truth(fit: ddco_pyro.Fit) -> float:
    """Held-out nats per step that a fit to :func:`two_skills` lacks, beside the policy that drew them."""
    held_out = fit.demonstrations.select([one.name for one in fit.metrics.valid])
    ways = [np.where(demo.labels["skill"] == 5, 1, -1)[:, None] for demo in held_out]
    side = [way * demo.observations["place"] for way, demo in zip(ways, held_out, strict=True)]
    actions = np.concatenate([demo.actions for demo in held_out])
    truth = stats.norm.logpdf(actions, np.concatenate(side), NOISE).mean()
    return float(truth - fit.metrics.log_likelihood_per_step.valid)


@pytest.mark.slow
def test_what_it_writes_finds_what_was_planted_as_it_is(path: Path, tmp_path: Path) -> None:
    """Segments are the planted ones. By Adam they are as likely, held out and to 0.1 nats per step, as under
    the policy that they were drawn from.
    """
    two_skills(path)
    spec = tmp_path / "spec.yaml"
    said = call("init", path, "--out", spec).out.splitlines()
    assert said[0] == "2 options, as many as the values of labels/skill"
    assert re.fullmatch(r"median segment [\d.]+ steps in small fits", said[1])
    assert said[2:] == [f"{spec}: fit it with: ddco-pyro fit {spec} --out runs/spec"]
    ended = done("fit", spec, "--out", tmp_path / "run")
    line = f"next: ddco-pyro segment {tmp_path / 'run'} '{path}' --html segments.html"
    assert ended.out.splitlines()[-1] == line
    looked = call("inspect", path).out.splitlines()[-1]
    assert looked == f"next: ddco-pyro init '{path}' --out 'my demos: 1.yaml'"
    fit = ddco_pyro.load(tmp_path / "run")
    assert fit.spec == load_spec(spec)
    adam = ["compare_with=[]", "training.optimizer={name: adam, lr: 3.0e-3}"]
    assert short_of_the_truth(ddco_pyro.fit(load_spec(spec, adam))) < 0.1
    assert list(fit.baselines) == ["mixture", "flat", "flat_equal"]
    assert ended.out.count("flat and flat of equal size have a σ that depends on the state.") == 1
    assert fit.metrics.agreement.valid[0].nmi > 0.95  # with the labels in the file


@pytest.mark.slow
def test_what_it_writes_lets_every_method_converge(tmp_path: Path) -> None:
    """Two-valued and constant controls are what took longest."""
    demos = (replace(demo, actions=np.insert(demo.actions, 0, 0.5, axis=1)) for demo in pick_and_place(120))
    Demonstrations(tuple(demos)).write(tmp_path / "planted.hdf5")
    done("fit", started(tmp_path / "planted.hdf5"), "--out", tmp_path / "run")
    metrics = ddco_pyro.load(tmp_path / "run").metrics
    trainings = metrics.trainings.values()
    assert [one.converged for one in trainings] == [True] * 4  # with a mixture and two flat policies
    assert len({one.budget.epochs for one in trainings}) == 1


def test_it_says_what_it_leaves_out(path: Path, tmp_path: Path) -> None:
    add(path, "goal", 3.0)
    add(path, "1e3", np.nan)
    spec = load_spec(write(tmp_path, text := starting_spec(inspect(path), path).text))
    assert [(one.key, one.differences) for one in spec.observations] == [("pose", True)]
    assert spec.demonstrations.path == str(path)
    assert "# - goal   # is constant" in text
    assert '# - "1e3"   # has 50 NaN and 0 infinite values' in text
    assert "# - camera   # an image" in text


def broken(path: Path, number: int, names: list[str], key: str = "obs/pose", **masks: tuple[str, ...]) -> str:
    """The spec for so many demonstrations, of which those named have a NaN."""
    demonstrations(number, masks).write(path)
    with h5py.File(path, "r+") as file:
        for name in names:
            file[f"data/{name}/{key}"][1, 1] = np.nan
    return starting_spec(inspect(path), path).text


def test_options_are_compared_with_the_labels_that_know_most(path: Path) -> None:
    """Neither with constant labels, nor with those that ``segment`` wrote."""
    with h5py.File(path, "r+") as file:
        file["data"].attrs["label_names"] = json.dumps({"whole": ["go", "take\nit"]})
        for number, group in enumerate(file["data"].values()):
            halves = np.arange(len(group["actions"])) * 2 // len(group["actions"])
            group["labels/phase"][:] = np.where(number < 2, halves, -1)
            full = dict.fromkeys(["option", "option_boundary", "other", "whole"], halves)
            for name, values in {"all": 0 * halves, **full}.items():
                group[f"labels/{name}"] = values
    facts = inspect(path)
    text, steps = starting_spec(facts, path).text, sum(facts.lengths.values())
    assert "  labels: whole                  # compared" in text
    assert f"  # the fullest of the labels: known in {steps} of {steps} steps\n" in text
    assert "  # labels 0, 1, ...: go, take\\nit\n" in text
    assert "      count: 2                      # as many as the values of labels/whole; try others:" in text
    few = sum(list(facts.lengths.values())[:2])
    known = {"other": steps, "phase": few, "all": steps, "option": steps, "option_boundary": steps}
    found = re.findall(r"# labels: (\w+)   # known in (\d+) of", text)
    assert found == [(key, str(known[key])) for key in known]


def test_a_few_broken_demonstrations_are_left_out(path: Path, tmp_path: Path) -> None:
    """Two of ten, which are 20 %; what is said of the rest is said of eight."""
    assert "exclude: [demo_2, demo_9]" in broken(path, 10, ["demo_2", "demo_9"], "actions")
    written = write(tmp_path, text := broken(path, 10, ["demo_2", "demo_9"]))
    spec = load_spec(written)
    assert spec.demonstrations.exclude == ("demo_2", "demo_9")
    assert [one.key for one in spec.observations] == ["pose"]
    assert "# NaN, infinite or huge values, damaged, or odd; why: ddco-pyro inspect" in text
    assert text.startswith("# A starting spec for 8 demonstrations of 3 to 6 steps.")
    fit = ddco_pyro.fit(load_spec(written, ["training.epochs=1", "compare_with=[]"]), out=tmp_path / "run")
    numbers = fit.metrics.demonstrations
    assert numbers.train + numbers.tune + numbers.valid == 8
    done("segment", tmp_path / "run", path, "--csv", tmp_path / "segments.csv")
    rows = [line.split(",")[0] for line in (tmp_path / "segments.csv").read_text().splitlines()[1:]]
    assert set(rows) == {f"demo_{number}" for number in range(10)} - {"demo_2", "demo_9"}


def test_of_many_broken_demonstrations_the_key_is_left_out(path: Path) -> None:
    text = broken(path, 9, ["demo_2", "demo_8"])
    assert "exclude" not in text
    assert "# - pose   # has 2 NaN and 0 infinite values" in text
    assert "- {key: camera}" in text
    assert "exclude" not in broken(path, 10, ["demo_2"], valid=("demo_2",))  # nothing would be held out
    says = "actions has 1 NaN and 0 infinite values; repair them first"
    with pytest.raises(DemonstrationsError, match=says):
        broken(path, 4, ["demo_1"], "actions")  # a quarter


def test_pictures_alone_are_seen_by_one_network(tmp_path: Path) -> None:
    """Two cameras, a small one as it is and a larger one reduced; what is written can be fitted."""
    random, records = np.random.default_rng(2), []
    for _ in range(6):
        sizes = {name: (5, *size, 3) for name, size in CAMERAS.items()}
        seen = {name: random.integers(0, 256, size, dtype=np.uint8) for name, size in sizes.items()}
        records.append((seen, random.normal(size=(5, 2))))
    numbered(records).write(tmp_path / "seen.hdf5")
    written = started(tmp_path / "seen.hdf5")
    spec = load_spec(written)
    assert [(one.key, one.resize, one.shift) for one in spec.observations] == [
        ("2nd eye", None, 0),
        ("eye", (32, 64), 3),
    ]
    assert set(spec.hierarchy.trunk.of) == set(CAMERAS)
    fit = ddco_pyro.fit(load_spec(written, ["training.epochs=2"]))
    assert list(fit.baselines) == ["mixture", "flat_equal"]
    said = "Options and mixture have one σ for each option; flat of equal size has a σ that depends on the "
    said += "state."
    assert stds(fit) == said


CAMERAS = {"eye": (40, 80), "2nd eye": (12, 16)}


def write(folder: Path, text: str) -> Path:
    path = folder / "written.yaml"
    path.write_text(text)
    return path


def turning(path: Path) -> None:
    """An arm that turns on: its angle jumps by 2π or 360, its quaternion changes sign; others seem to."""
    random, records = np.random.default_rng(3), []
    for number in range(8):
        angle = np.linspace(0, 7, 50) + random.uniform(-3, 3) + 0.02 * random.normal(size=50)
        real, other = np.cos(angle / 2), np.sin(angle / 2)
        quaternion = (
            np.column_stack([other, 0 * real, 0 * real, real])
            * np.sign(real if number % 2 else other)[:, None]
        )
        place = np.cumsum(random.normal(size=(50, 3)), axis=0)
        seen = {
            "pose": np.hstack([place, quaternion]),
            "yaw": np.column_stack([place[:, 0], (angle + np.pi) % (2 * np.pi) - np.pi]),
            "degrees": np.degrees(angle)[:, None] % 360,
            "unbound": angle[:, None],
            "noise": random.uniform(-np.pi, np.pi, (50, 2)),
            "steady": np.column_stack([real, 0 * real, 0 * real, other]) * np.sign(real[0]),
        }
        records.append((seen, np.column_stack([np.gradient(angle), angle % (2 * np.pi)])))
    numbered(records).write(path)


def test_what_jumps_as_an_angle_or_a_quaternion_is_read_without_its_jumps(path: Path, tmp_path: Path) -> None:
    turning(path)
    notes = [note for note in inspect(path).notes if "jump" in note or "change sign" in note]
    assert [note.split(" as ")[0] for note in notes] == [
        "actions: dimension 1 jumps by 2π",
        "obs/degrees: dimension 0 jumps by 360",
        "obs/pose: dimensions 3-6 change sign",
        "obs/yaw: dimension 1 jumps by 2π",
    ]
    text = starting_spec(inspect(path), path).text
    spec = load_spec(write(tmp_path, text), ["training.epochs=2", "compare_with=[]"])
    turned = [one for one in spec.observations if one.angles or one.quaternions]
    read = {one.key: (one.angles, one.quaternions) for one in turned}
    assert read == {"pose": ((), (3,)), "yaw": ((1,), ())}
    encoder = ddco_pyro.fit(spec).hierarchy.encoder
    for demo in Demonstrations.read(path):
        pose, yaw = demo.observations["pose"].copy(), demo.observations["yaw"].copy()
        pose[:, 3:], yaw[:, 1] = -pose[:, 3:], yaw[:, 1] + 2 * np.pi
        same = encoder.features({**demo.observations, "pose": pose, "yaw": yaw})
        np.testing.assert_allclose(encoder.features(demo.observations), same, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"angles": [1, 1]}, "observations.0.angles: name a number twice"),
        ({"quaternions": [0]}, "there is no number 3"),
    ],
)
def test_angles_that_are_none_are_refused(
    settings: dict[str, list[int]], says: str, path: Path, tmp_path: Path
) -> None:
    seen, levels = [{"key": "pose", **settings}], [{"count": 2}]
    spec = {"demonstrations": {"path": str(path)}, "observations": seen, "hierarchy": {"levels": levels}}
    refused(says, "check", write(tmp_path, yaml.safe_dump(spec)))


def test_text_alone_cannot_be_fitted(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            del group["obs/pose"], group["obs/camera"]
            group["obs/text"] = [b"a"] * len(group["actions"])
    says = r"no observation can be used: obs/text holds text, not numbers; see"
    with pytest.raises(DemonstrationsError, match=says):
        starting_spec(inspect(path), path)


@pytest.mark.usefixtures("undecided")
def test_a_file_that_is_there_is_not_replaced_unasked(path: Path, tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text("mine")
    ended = call("init", path, "--out", spec)
    assert (ended.status, spec.read_text()) == (2, "mine")
    assert ended.err == f"ddco-pyro: {spec}: exists; choose another --out, or replace it with --force\n"
    done("init", path, "--out", spec, "--force")
    assert spec.read_text() != "mine"


def test_few_demonstrations_all_train(path: Path, tmp_path: Path) -> None:
    def spec(*steps: int) -> Spec:
        records = tuple(demonstration(f"demo_{n}", length, n) for n, length in enumerate(steps))
        vectors = (replace(one, observations={"pose": one.observations["pose"]}) for one in records)
        Demonstrations(tuple(vectors)).write(path)
        return load_spec(write(tmp_path, starting_spec(inspect(path), path).text))

    few, more = spec(*[20] * 7), spec(*[20] * 8)
    assert [one.demonstrations.hold_out_by for one in (few, more)] == ["demonstration", None]
    assert [one.training.tune_fraction for one in (few, more)] == [0, 0.1]


LABELS = [({"one": 1}, 4), ({"many": 31}, 4), ({"coarse": 2, "fine": 6, "one": 1}, 6)]


@pytest.mark.parametrize(("labels", "count"), LABELS)
@pytest.mark.usefixtures("undecided")
def test_there_are_as_many_options_as_labels(labels, count: int, path: Path, tmp_path: Path) -> None:
    """Of the labelling that knows most; ``coarse`` knows no label in the first step."""
    records = []
    for number in range(9):
        seen = {"pose": np.random.default_rng(number).normal(size=(40, 2))}
        actions = np.arange(40.0)[:, None] % 5
        given = {name: (np.arange(40) * most // 40) - 10 * (name == "fine") for name, most in labels.items()}
        if "coarse" in given:
            given["coarse"][0] = -1
        records.append((seen, actions, given))
    numbered(records).write(path)
    ended = call("init", path, "--out", tmp_path / "spec.yaml")
    assert load_spec(tmp_path / "spec.yaml").hierarchy.levels[0].count == count
    chosen = [name for name in labels if labels[name] == count]
    said = [f"{count} options, as many as the values of labels/{name}" for name in chosen]
    assert ended.out.splitlines()[:-1] == said


def of_operators(path: Path, operators: str) -> Path:
    """A demonstration by each operator; the file has another division in masks."""
    owned = tuple(
        replace(one, attributes={"operator": who, "robot": "left"})
        for one, who in zip(demonstrations(len(operators)), operators, strict=True)
    )
    Demonstrations(owned, {"train": ("demo_0", "demo_1"), "valid": ("demo_2",)}).write(path)
    return path


@pytest.mark.parametrize(
    ("operators", "held_out"),
    [("ABCDEABCDE", {2}), ("AAB", {1}), ("ABBBBBBBBBBB", {1})],
)
@pytest.mark.usefixtures("undecided")
def test_no_operator_is_on_both_sides(operators: str, held_out: set[int], path: Path, tmp_path: Path) -> None:
    """About a fifth is held out, the same in every call, and a fit has this division."""
    asked, by = ("init", of_operators(path, operators)), ("--hold-out-by", "operator")
    ended = [call(*asked, "--out", tmp_path / f"{n}.yaml", *by) for n in "01"]
    first, again = ((tmp_path / f"{n}.yaml").read_text() for n in "01")
    assert first.replace("0.yaml", "1.yaml") == again
    said = re.fullmatch(
        rf"held out: operator (.*), (\d+) of {len(operators)} demonstrations", ended[0].out.splitlines()[-2]
    )
    spec = load_spec(tmp_path / "0.yaml")
    for demos in (read_demonstrations(spec), outline(spec), seen(spec, Demonstrations.read(path))):
        parts = train_and_valid(spec, demos).values()
        train, valid = ([one.attributes["operator"] for one in part] for part in parts)
        assert {*train} | {*valid} == {*operators}
        assert not {*train} & {*valid}
        assert (", ".join(sorted({*valid})), str(len(valid))) == said.groups()
        assert len(valid) in held_out
    drawn = {read_demonstrations(with_overrides(spec, {"seed": seed})).masks["valid"] for seed in range(9)}
    assert (len(drawn) > 1) == (len({*operators}) > 2)


MISSPELT = "demo_0 has no attribute 'operater' (did you mean 'operator'?); there is: operator, robot"
ALIKE = "attribute 'robot' is left in all demonstrations; hold out by another one"


@pytest.mark.parametrize(("attribute", "says"), [("operater", MISSPELT), ("robot", ALIKE)])
@pytest.mark.usefixtures("undecided")
def test_what_cannot_be_held_out_by(attribute: str, says: str, path: Path, tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    ended = call("init", of_operators(path, "ABCAB"), "--out", spec, "--hold-out-by", attribute)
    assert (ended.status, ended.out, ended.err) == (2, "", f"ddco-pyro: {path}: {says}\n")
    assert not spec.exists()
    done("init", path, "--out", spec)
    for command in ("check", "fit"):
        out = ["--out", tmp_path / "run"] if command == "fit" else []
        refused(says, command, spec, *out, *with_set(f"demonstrations.hold_out_by={attribute}"))
    assert not (tmp_path / "run").exists()


FITTED = ("grey alone", "demonstrations of one step")
"""Rows that are fitted, too."""


def started(path: Path) -> Path | None:
    """The spec that ``init`` writes; None where it refuses the file in a line, and ``inspect`` says why."""
    spec = path.with_suffix(".yaml")
    ended = call("init", path, "--out", spec)
    assert ended.status in (0, 2), ended.err
    if ended.status == 0:
        done("check", spec)
        return spec
    assert ended.err.count("\n") == 1
    return None


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.usefixtures("undecided")
def test_what_init_accepts_check_accepts(name: str, tmp_path: Path) -> None:
    path, says = ROWS[name].make(tmp_path), ROWS[name].says
    spec = started(path)
    assert (spec is None) == (says is not None)
    if says:  # which `inspect` says too: a problem of the file, or a note where an observation is the control
        found = inspect(path)
        with pytest.raises(DemonstrationsError, match=says):
            starting_spec(found, path)
        said = "\n".join([*found.problems, *found.notes])
        nothing = all(dimension.constant for dimension in found.control)
        assert re.search(says, said) or found.problems or found.leaks or nothing
    elif name in FITTED:
        run = spec.with_suffix(".run")
        done("fit", spec, "--out", run, "--jobs", 1, *with_set("training.epochs=2", "compare_with=[]"))
