"""What ``inspect`` says of a file, against what was put into it."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import call, done
from odd_files.hdf5 import instead
from odd_files.kinds import ROWS, twins, write
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.spec import load_spec


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "demos.hdf5"
    demonstrations(5, {"valid": ("demo_1",), "20_percent": ("demo_0",)}).write(found)
    with h5py.File(found, "r+") as file:
        for name, group in file["data"].items():
            steps = len(group["actions"])
            group["obs/goal"] = np.tile(float(name[-1]), (steps, 2))
            group["obs/fixed"] = np.full((steps, 3), [1.0, 2.0, 3.0], dtype=np.float32)
            group["actions"][:, 1] = 0.5
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
    return found


WITHIN = json.dumps({"env_kwargs": {"control_freq": 40}})
BESIDE = json.dumps({"control_freq": 40, "env_kwargs": None})
RATES: dict[str, tuple[str, object, float | None]] = {
    "its own": ("", {"control_frequency": 25}, 25),
    "before others": ("", {"fps": 30, "control_frequency": 25.0}, 25),
    "of a demonstration": ("data/demo_0", {"fps": 15}, 15),
    "text": ("data", {"fps": "50 Hz"}, 50),
    "a period": ("", {"dt": 0.02}, 50),
    "of the environment": ("data", {"env_args": WITHIN}, 40),
    "beside the environment": ("data", {"env_args": BESIDE}, 40),
    "none": ("", {"fps": 0}, None),
    "no number": ("", {"fps": "fast", "hz": float("nan"), "rate": True, "dt": float("inf")}, None),
}


@pytest.mark.parametrize(("place", "said", "hertz"), RATES.values(), ids=RATES)
def test_the_rate_is_read_under_usual_names(
    place: str, said: dict[str, object], hertz: float | None, tmp_path: Path
) -> None:
    path = write(tmp_path / "demos.hdf5")
    with h5py.File(path, "r+") as file:
        (file[place] if place else file).attrs.update(said)
    assert inspect(path).frequency == hertz
    shown = call("inspect", path).out
    unknown = 'file.attrs["control_frequency"] = 20 says'
    assert (f"control frequency: {hertz:g} Hz\n" if hertz else unknown) in shown


def test_shapes_ranges_lengths_and_constants(path: Path) -> None:
    found = inspect(path)
    original = demonstrations(5)
    assert found.format == "robomimic"
    assert found.lengths == dict(zip(original.names, original.lengths, strict=True))
    assert found.frequency == 20
    assert found.masks == {"valid": ("demo_1",), "20_percent": ("demo_0",)}
    assert found.problems == []
    pose = np.concatenate([demo.observations["pose"] for demo in original])
    np.testing.assert_array_equal(found.fields["obs/pose"].minimum, pose.min(0))
    np.testing.assert_array_equal(found.fields["obs/pose"].maximum, pose.max(0))
    assert found.fields["actions"].constant == [1]
    assert found.fields["obs/fixed"].constant == [0, 1, 2]
    assert found.fields["obs/fixed"].dtype == "float32"
    assert [one.key for one in found.observations if one.still] == ["fixed", "goal"]
    assert [one.key for one in found.observations if one.image] == ["camera"]
    assert [one.key for one in found.labels] == ["phase"]


def test_what_a_fit_would_refuse_is_said_with_its_place(path: Path) -> None:
    """A number that no network takes is one of them."""
    with h5py.File(path, "r+") as file:
        instead(file, "mask/valid", [b"demo_9"])
        instead(file, "data/demo_1/obs/goal", np.ones((2, 2)))
        del file["data/demo_2/actions"]
        file["data/demo_3/obs/pose"][[2, 4], 1] = np.nan, 1e300
        file["data/demo_4/obs/pose"][:, 2] = -2e30
        file["data/demo_4/obs/goal"][2] = np.inf
        file["data/demo_3/labels/phase"][0] = 2**40
    found = inspect(path)
    pose, goal = found.fields["obs/pose"], found.fields["obs/goal"]
    assert (pose.nan, pose.infinite, pose.huge) == (1, 0, 1 + 3)
    assert (pose.first, pose.affected) == (("demo_3", 2), ["demo_3", "demo_4"])
    assert (goal.first, goal.affected) == (("demo_4", 2), ["demo_4"])
    assert np.isfinite(pose.minimum).all()
    assert found.problems == [
        "demo_1: obs/goal has 2 steps, but actions has 4",
        "demo_2: actions is missing; there is: labels/phase, obs/camera, obs/fixed, obs/goal, obs/pose",
        "mask/valid: there is no demonstration 'demo_9' (did you mean 'demo_4'?)",
        "obs/goal has 0 NaN and 2 infinite values, the first in demo_4 at step 2; 1 of 3 demonstrations is "
        "affected",
        "obs/pose has 1 NaN and 0 infinite values and 4 beyond ±1e+30, the first in demo_3 at step 2; 2 of 4 "
        "demonstrations are affected",
    ]
    assert "1 NaN and 0 infinite values and 4 beyond ±1e+30" in call("inspect", path).out
    assert len(inspect(path, exclude=["demo_3", "demo_4"]).problems) == 3


def test_the_command_shows_it_and_a_spec(path: Path) -> None:
    ended = call("inspect", path)
    assert (ended.status, ended.err) == (0, "")
    assert "robomimic, 5 demonstrations of 3 to 6 steps (median 4, 21 in all)" in ended.out
    assert "control frequency: 20 Hz" in ended.out
    lines = [line.split("│") for line in ended.out.splitlines()]
    rows = {name.strip(): [cell.strip() for cell in cells] for name, *cells in lines}
    assert rows["obs/fixed"] == ["[3]", "float32", "1 to 3", "constant"]
    assert rows["actions"][-1] == "constant: 1"
    assert "observations:" in ended.out
    whole = json.loads(call("inspect", path, "--json").out)
    assert whole == json.loads(json.dumps(inspect(path).as_json()))


def test_markup_in_names_is_shown_as_it_is(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            group["obs/[red]x[/red]"] = np.ones((len(group["actions"]), 1))
    assert "obs/[red]x[/red]" in call("inspect", path).out


TWICE = "1 of 5 demonstrations equal another one, the first demo_4, which equals demo_0: one of"
PADDED = "control dimension 2: exactly 0 in 29.4 % of the steps; exactly at its minimum -1 in 47.1"
CONVENTIONS = "control dimension 2: exactly 0 in 17.6 % of the steps; exactly at its minimum -1 in"
NOTES: dict[str, list[str]] = {
    "equal tails": [
        "control dimension 0: -0.30100668315876145 is common in demo_2 alone",
        "control dimension 1: -0.38171402837921675 is common in demo_3 alone",
    ],
    "a demonstration twice": [TWICE],
    "an observation that is the control": ["obs/command is control dimensions 0-1 at the same step, up to"],
    "a switch padded by zeros": [PADDED],
    "two conventions of a switch": [CONVENTIONS],
    "integers -1, 0, 1": [],
    "demonstrations of one step": [],
    "channels first": [],
}


@pytest.mark.parametrize(("name", "notes"), NOTES.items(), ids=NOTES)
def test_what_coincides_is_noted_once(name: str, notes: list[str], tmp_path: Path) -> None:
    found = [note for note in inspect(ROWS[name].make(tmp_path)).notes if "by control.kind" not in note]
    assert [note[: len(said)] for note, said in zip(found, notes, strict=True)] == notes


@pytest.mark.parametrize(("shift", "left_out"), [(-1, False), (0, True), (1, True)])
def test_a_control_among_others_is_noted_and_alone_left_out(
    shift: int, left_out: bool, tmp_path: Path
) -> None:
    """It is that of the step before, of the same one, or of the next; beside it is a number of its own."""

    def change(made: dict[str, np.ndarray], number: int) -> None:
        control = np.roll(made["actions"][:, 1], -shift)
        made["obs/alone"] = control[:, None]
        made["obs/both"] = np.column_stack([made["obs/pose"], control])
        for key in ("alone", "both"):  # what is not there for want of a step is anything
            made[f"obs/{key}"][[0, -1], -1] += {-1: (7, 0), 0: (0, 0), 1: (0, 7)}[shift]

    found = inspect(write(tmp_path / "demos.hdf5", change))
    when = {-1: "of the step before", 0: "at the same step", 1: "of the next step"}[shift]
    said = [f"obs/both: dimension 3 = control dimension 1 {when}, "]
    said += [
        f"obs/alone is control dimension 1 {when}, "
        if left_out
        else said[0].replace("both: dimension 3", "alone: dimension 0")
    ]
    for line in said:
        assert sum(note.startswith(line) for note in found.notes) == 1
    assert [*found.leaks] == (["obs/alone"] if left_out else [])


def test_copies_are_noted_where_the_masks_part_them(tmp_path: Path) -> None:
    def noted(**masks: list[bytes]) -> bool:
        notes = inspect(write(tmp_path / "d.hdf5", twins, masks)).notes
        return any("equal another one" in note for note in notes)

    assert noted(valid=[b"demo_0"])
    assert noted(train=[b"demo_0", b"demo_1"], valid=[b"demo_4"])
    assert not noted(valid=[b"demo_1"])
    assert not noted(valid=[b"demo_0", b"demo_4"])


# --- odd demonstrations -------------------------------------------------------------------------------------


def arm(steps: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """An arm that goes to a place and back under velocity control, with a switch for its gripper."""
    there = np.arange(steps) < steps // 2
    velocity = np.where(there, 0.1, -0.1)[:, None] + 0.05 * random.normal(size=(steps, 3))
    switch = np.where(there, -1.0, 1.0)[:, None]
    hand = np.cumsum(np.concatenate([np.zeros((1, 3)), velocity[:-1]]), axis=0)
    return {"actions": np.column_stack([velocity, switch]), "obs/hand": hand, "obs/jaw": 0.5 * switch}


def held(made: dict[str, np.ndarray], before: int, after: int) -> dict[str, np.ndarray]:
    """The arm, which rests before and after, under commands of 0."""
    longer = {}
    for place, rows in made.items():
        first, last = (rows[[at]] * (place != "actions") for at in (0, -1))
        longer[place] = np.concatenate([first.repeat(before, 0), rows, last.repeat(after, 0)])
    return longer


Spoil = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]


def recorded(path: Path, spoil: Spoil, spoilt: Sequence[int]) -> Path:
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for number in range(20):
            made = arm(60 + number, random)
            for place, rows in (spoil(made) if number in spoilt else made).items():
                file[f"data/demo_{number}/{place}"] = rows
    return path


DEAD = "all commands are 0"
FURTHER = "control dimension 3 has further values there, and is a switch elsewhere"
ODD: dict[str, tuple[Spoil, str]] = {
    "dead": (lambda made: made | {"actions": 0 * made["actions"]}, DEAD),
    "padded": (lambda made: held(made, 0, 50), FURTHER),
    "late": (lambda made: held(made, 90, 0), FURTHER),
    "a lost command": (
        lambda made: made | {"actions": made["actions"] * (np.arange(len(made["actions"])) != 9)[:, None]},
        FURTHER,
    ),
}


@pytest.mark.parametrize(("name", "spoilt"), [("dead", (3,)), *((name, (3, 11)) for name in ODD)])
@pytest.mark.usefixtures("undecided")
def test_an_odd_demonstration_is_named_and_left_out(name: str, spoilt, tmp_path: Path) -> None:
    spoil, why = ODD[name]
    path = recorded(tmp_path / "demos.hdf5", spoil, spoilt)
    names = [f"demo_{number}" for number in spoilt]
    line = f"{', '.join(names)} ({len(names)} of 20): {why}; exclude such ones (demonstrations.exclude)"
    assert inspect(path).notes[0] == line
    done("init", path, "--out", tmp_path / "spec.yaml")
    text = (tmp_path / "spec.yaml").read_text()
    assert f"# {line}\n" in text
    assert load_spec(tmp_path / "spec.yaml").demonstrations.exclude == tuple(names)
    assert "# control dimensions 0-2: gaussian (varies freely), by" in text
    assert "# control dimension 3: binary (takes two values, -1 and 1), by" in text


@pytest.mark.parametrize("name", ["padded", "late", "dead"])
def test_what_many_demonstrations_do_is_not_odd(name: str, tmp_path: Path) -> None:
    many = range(0, 20, 2)
    assert not inspect(recorded(tmp_path / "demos.hdf5", ODD[name][0], many)).odd


def test_a_period_in_milliseconds_is_asked_about(tmp_path: Path) -> None:
    path = write(tmp_path / "demos.hdf5")
    with h5py.File(path, "r+") as file:
        file.attrs["dt"] = 33
    line = "a step lasts 33 s by the file: if its dt is in milliseconds, write "
    line += 'file.attrs["control_frequency"] = 30.3'
    assert line in inspect(path).notes
    with h5py.File(path, "r+") as file:
        file.attrs["dt"] = 2
    assert not [note for note in inspect(path).notes if "a step lasts" in note]


CLOCKS = {
    "a gap": ([0.0, 0.1, 0.2, 0.6, 0.7], "obs/timestamp has a gap before row 3: 0.2, then 0.6, in demo_1"),
    "a step back": ([0.0, 0.1, 0.2, 0.1, 0.3], "obs/timestamp steps back in row 3: 0.2, then 0.1, in demo_1"),
    "a repeated stamp": (
        [0.0, 0.1, 0.1, 0.2, 0.3],
        "obs/timestamp repeats its stamp in row 2: 0.1, then 0.1, in demo_1",
    ),
    "late": ([0.0, 0.1, 0.23, 0.3, 0.4], ""),
}


@pytest.mark.parametrize(("times", "line"), CLOCKS.values(), ids=CLOCKS)
def test_the_fault_of_a_clock_is_named(times: list[float], line: str, tmp_path: Path) -> None:
    demos = [
        Demonstration(f"demo_{number}", {"timestamp": clock, "place": np.eye(5)}, np.eye(5, 2))
        for number, clock in enumerate(map(np.array, ([0.0, 0.1, 0.2, 0.3, 0.4], times)))
    ]
    Demonstrations(tuple(demos)).write(tmp_path / "demos.hdf5")
    assert "obs/timestamp" in inspect(tmp_path / "demos.hdf5").leaks
    assert [
        note for note in inspect(tmp_path / "demos.hdf5").notes if "timestamp" in note and "row" in note
    ] == [line] * bool(line)
