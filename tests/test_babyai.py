"""The BabyAI study without minigrid: labels of toy stacks, observations of a toy grid, recording, what is refused."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import arena_playing
import arena_recording
import babyai
import babyai_cell
import babyai_labels
import babyai_results
import babyai_seen
import cells
import h5py
import numpy as np
import pytest
from babyai_labels import NONE, SUBGOALS

from ddco_pyro.spec import load_spec

# --- labels -----------------------------------------------------------------------------------------------------------


def made(name, **values):
    """Something of a class of this name, as the labels tell things apart."""
    return type(name, (SimpleNamespace,), {})(**values)


def sequence(name, a, b, a_done=False, b_done=False):
    return made(f"{name}Instr", instr_a=a, instr_b=b, a_done=a_done, b_done=b_done)


def pushed(*names):
    stack = []
    for name in names:
        kind, _, reason = name.partition(" ")
        stack.append(made(f"{kind}Subgoal", reason=reason or None))
    return stack


GO, PUT, OPEN, PICK = (made(f"{name}Instr") for name in ("GoTo", "PutNext", "Open", "Pickup"))


@pytest.mark.parametrize(
    ("mission", "order"),
    [
        (GO, [GO]),
        (sequence("Before", GO, PUT), [GO, PUT]),
        (sequence("After", GO, PUT), [PUT, GO]),
        (sequence("After", sequence("And", GO, PUT), sequence("And", OPEN, PICK)), [OPEN, PICK, GO, PUT]),
    ],
)
def test_instructions_are_in_the_order_in_which_they_are_followed(mission, order):
    assert babyai_labels.leaves(mission) == order


def test_labels_of_an_episode_worked_by_hand():
    mission = sequence("After", GO, sequence("Before", OPEN, PUT))  # open, then put next, then go
    first = pushed("GoNextTo", "Drop", "GoNextTo PutNext", "Pickup", "GoNextTo", "Open", "GoNextTo Open")
    stack = babyai_labels.Stack(first, mission)
    episode = [  # how many subgoals the top one takes off, itself first, and pushes
        (0, [], "GoNextTo Open", 0),
        (1, [], "Open", 0),
        (1, ["Open Unlock"], "Open", 0),  # puts another in its place
        (1, ["Drop", "GoNextTo"], "GoNextTo", 0),  # where the key is put serves what it opened
        (1, [], "Drop", 0),
        (1, [], "GoNextTo", 1),
        (0, ["Explore", "GoNextTo Explore"], "Explore", 1),
        (1, [], "Explore", 1),
        (1, [], "GoNextTo", 1),
        (1, [], "Pickup", 1),
        (1, [], "GoNextTo PutNext", 1),
        (1, [], "Drop", 1),
        (1, [], "GoNextTo", 2),
        (0, ["Open"], "Open", 2),  # a door in the way, with more on the stack than below the first leaf
        (0, ["Close"], "Close", 2),
    ]
    for taken, names, kind, number in episode:
        top = stack[-1]
        assert [stack.pop() for _ in range(taken)] == [top] * taken
        for one in pushed(*names):
            stack.append(one)
        assert (SUBGOALS[babyai_labels.subgoal(stack)], stack.instruction) == (kind, number)
    stack[-1], stack.pop(), stack.pop(), stack.pop()
    assert (babyai_labels.subgoal(stack), stack.instruction, len(stack)) == (NONE, NONE, 0)


def test_what_the_labels_do_not_know_is_refused():
    with pytest.raises(ValueError, match="begins with 2 subgoals, not 1"):
        babyai_labels.Stack(pushed("Drop", "GoNextTo"), GO)
    with pytest.raises(ValueError, match="Dance"):
        babyai_labels.subgoal(pushed("Dance"))


def test_what_is_done_is_as_the_environment_says():
    pair = sequence("And", OPEN, PICK, a_done="success", b_done="continue")
    assert babyai_labels.done(sequence("After", GO, pair, a_done=False, b_done="continue")) == [True, False, False]
    assert babyai_labels.done(sequence("After", GO, pair, a_done=False, b_done="success")) == [True, True, False]


# --- observations -----------------------------------------------------------------------------------------------------

MAP = """
#########
#...#...#
#..b|.k.#
#...#...#
#########
"""
"""Two rooms of three by three cells with a closed door (|), a ball (b) and a key (k)."""

RIGHT, DOWN, LEFT, UP = range(4)


class Grid:
    def __init__(self, cells):
        self.cells = cells

    def get(self, x, y):
        return self.cells[x, y]


def world(place, direction, carrying=None, text=MAP):
    """A toy world, and by their letter the things in it."""
    rows = text.split()
    cells = np.full((len(rows[0]), len(rows)), None, object)
    types, things = {"#": "wall", "|": "door", "b": "ball", "k": "key"}, {}
    for (y, row), x in ((item, x) for item in enumerate(rows) for x in range(len(item[1]))):
        if row[x] in types:
            cells[x, y] = things[row[x]] = SimpleNamespace(type=types[row[x]], is_open=False, is_locked=False)
    state = {"agent_pos": place, "agent_dir": direction, "carrying": carrying, "room_size": 5}
    return SimpleNamespace(grid=Grid(cells), **state), things


def seen(columns):
    """The first columns of the map have been in view."""
    return np.repeat(np.arange(9) < columns, 5).reshape(9, 5)


def described(*things):
    return SimpleNamespace(obj_set=list(things))


def test_observations_worked_by_hand():
    room, things = world((1, 2), RIGHT)
    put = made("PutNextInstr", desc_move=described(things["b"]), desc_fixed=described(things["|"]))
    mission = sequence("Before", made("GoToInstr", desc=described(things["k"])), put)
    now = babyai_seen.observation(room, seen(6), mission)
    assert now["body"].tolist() == [1, *[0] * 10, 1, 1, 1]  # nothing in front; one free cell ahead, right, left
    assert now["ways"][:6].tolist() == [1, 1, 0, 3, 0, pytest.approx(2 / 3)]  # a closed door, three cells ahead
    assert not now["ways"][6:].any()
    assert now["instruction_1"].tolist() == [1, 0, 0, 0, *[0] * 22]  # the key has not been in view
    ball, door = [1, 2, 0, 1, 0, 1, 0, 0, 1, 0, 0], [1, 3, 0, 1, 0, 0, 0, 0, 0, 0, 0]
    assert now["instruction_2"].tolist() == [0, 0, 0, 1, *ball, *door]
    assert not now["instruction_3"].any()
    assert now["done"].tolist() == [0, 0, 0, 0]
    room.agent_dir, room.carrying = UP, things["b"]
    room.grid.cells[3, 2], things["|"].is_open = None, True
    now = babyai_seen.observation(room, seen(9), mission)
    assert now["body"].tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 4, 0]  # to the right up to the key
    assert now["ways"][6:12].tolist() == [1, 0, 0, 0, 3, 0]
    assert now["instruction_1"][4:15].tolist() == [1, 0, 5, 0, 1, 0, 0, 0, 0, 0, 0]
    assert now["instruction_2"][4:].tolist() == [1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 3, 0, 1, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize("place", [(1, 2), (2, 3), (4, 2), (5, 1)])
@pytest.mark.parametrize("direction", range(4))
def test_a_turned_world_looks_the_same(place, direction):
    room, things = world(place, direction)
    things["|"].is_open = True
    mission = made("PutNextInstr", desc_move=described(things["k"]), desc_fixed=described(things["b"]))
    view, cells = seen(8), room.grid.cells
    expected = babyai_seen.observation(room, view, mission)
    for _ in range(3):  # a quarter turn clockwise, as y points down
        height = cells.shape[1]
        cells, view = cells.T[::-1], view.T[::-1]
        x, y = room.agent_pos
        room.agent_pos, room.agent_dir, room.grid = (height - 1 - y, x), (room.agent_dir + 1) % 4, Grid(cells)
        for key, values in babyai_seen.observation(room, view, mission).items():
            np.testing.assert_array_equal(values, expected[key], key)


def test_a_doorway_belongs_to_the_room_ahead_or_on_the_right():
    for direction, corner in ((RIGHT, [4, 0]), (UP, [4, 0]), (LEFT, [0, 0]), (DOWN, [0, 0])):
        room, _ = world((4, 2), direction)
        assert babyai_seen.View(room, seen(9)).room.tolist() == corner


# --- recording --------------------------------------------------------------------------------------------------------


def episode(seed):
    """Those of every third seed fail; observations named after what they are."""
    if seed % 3 == 2:
        return None
    steps = 4 + seed
    return {
        "actions": np.arange(steps)[:, None] % 6,
        "obs/body": np.arange(steps, dtype=np.float32)[:, None],
        "obs/instruction_4": np.zeros((steps, 2), np.float32),
        "obs/done": (np.arange(steps)[:, None] > 2).astype(np.float32),
        "labels/subgoal": np.array([-1] + [1] * (steps - 1)),
        "labels/mission": np.zeros(steps, int),
    }


def test_the_first_successes_are_recorded(tmp_path):
    path = tmp_path / "demos.hdf5"
    arena_recording.collect(path, "toy", episode, 4, 1, {"subgoal": 3, "mission": 1}, noise=0)
    with h5py.File(path) as file:
        assert [group.attrs["seed"] for group in file["data"].values()] == [0, 1, 3, 4]
        assert (list(file["mask/valid"]), list(file["mask/train"])) == ([b"demo_0"], [b"demo_1", b"demo_2", b"demo_3"])
        assert file["data/demo_2/dones"][()].tolist() == [False] * 6 + [True]
        said = json.loads(file.attrs["expert"])
    steps = 4 + 5 + 7 + 8
    shares = {"subgoal": [0, pytest.approx((steps - 4) / steps), 0], "mission": [1]}
    assert said == {"successes": 4, "attempts": 5, "shares": shares, "noise": 0}
    assert babyai_cell.observed(path, "hidden") == ["body"]
    assert babyai_cell.observed(path, "told") == ["body", "done"]


def test_an_expert_that_fails_is_one_line_and_no_file(tmp_path):
    with pytest.raises(SystemExit, match="toy: the expert succeeded in 0 of 20 episodes; 2 are needed"):
        arena_recording.collect(tmp_path / "demos.hdf5", "toy", lambda _: None, 2, 1, {})
    assert not list(tmp_path.iterdir())


class Line:
    """An agent at 0 that has to get to 3 within five steps."""

    def reset(self, seed):
        self.place, self.time = 0, 0
        return {"body": np.array([0.0])}

    def step(self, control):
        self.place, self.time = self.place + int(control[0]), self.time + 1
        return {"body": np.array([float(self.place)])}, self.place == 3, self.time == 5


class Walker:
    """Takes a step while it sees less than this."""

    def __init__(self, until):
        self.until = until

    def reset(self, seed):
        pass

    def act(self, observation):
        return np.array([int(observation["body"][0] < self.until)])


def test_controllers_are_played_and_shown_a_demonstration_scripted_ones_played_alone(tmp_path):
    arena_recording.collect(tmp_path / "demos.hdf5", "toy", episode, 2, 1, {})
    players, out = {"good": Walker(3), "short": Walker(2)}, tmp_path / "played.json"
    arena_playing.play_all(Line(), out, players, range(2), tmp_path / "demos.hdf5", {"late": Walker(9)})
    done, failed = {"success": True, "steps": 3}, {"success": False, "steps": 5}
    assert json.loads(out.read_text()) == {
        "episodes": {"good": [done, done], "short": [failed, failed], "late": [done, done]},
        "demonstration": "demo_0",
        "controls": {"good": [[1], [1], [1], [0]], "short": [[1], [1], [0], [0]]},
    }


def test_a_cell_is_done_once_for_each_code_and_settings(tmp_path):
    done = []

    def work():
        done.append(len(done))
        return {"value": done[-1]}

    for code, settings, value in (("a", {"seed": 1}, 0), ("a", {"seed": 1}, 0), ("b", {"seed": 1}, 1)):
        content = cells.kept(tmp_path / "cell.json", settings, {"code": code}, work)
        assert content == {"provenance": [{"code": code}], "results": settings | {"value": value}}
    assert cells.kept(tmp_path / "cell.json", {"seed": 2}, {"code": "b"}, work)["results"] == {"seed": 2, "value": 2}
    with pytest.raises(ValueError, match="results are named like settings: seed"):  # it would be done each time
        cells.kept(tmp_path / "cell.json", {"seed": 3}, {"code": "b"}, lambda: {"seed": [1.0]})


# --- the study --------------------------------------------------------------------------------------------------------


def test_two_levels_are_compared_with_a_label_each(tmp_path):
    for levels, names in ((1, ("subgoal",)), (2, ("subgoal", "mission"))):
        path = tmp_path / f"{levels}.yaml"
        path.write_text(json.dumps(babyai_cell.rule(tmp_path / "demos.hdf5", ["body"], levels, 3)))
        spec = load_spec(path, ["training.epochs=7"])
        assert spec.demonstrations.labels_by_level(levels) == names
        assert (len(spec.hierarchy.levels), spec.seed, spec.training.epochs) == (levels, 3, 7)


def test_a_study_without_its_environment_ends_with_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "venv").write_text("")  # a file is in its place
    monkeypatch.setattr(sys, "argv", ["babyai.py", "--runs", str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        babyai.main()
    told = capsys.readouterr().err
    assert (ended.value.code, told.count("\n"), "venv" in told) == (2, 1, True)
    assert not (tmp_path / "out").exists()


def cell(seed, likelihoods, successes, nmi):
    scores = dict.fromkeys((*babyai_results.UNMATCHED, "matched_globally"), nmi)
    scores["matched_globally"] = dict.fromkeys(babyai_results.MATCHED, nmi)
    labels = dict.fromkeys(babyai_cell.LABELS, scores)
    valid = dict(zip(babyai_results.METHODS, likelihoods, strict=True))
    return {
        "level": "Toy",
        "progress": "told",
        "seed": seed,
        "bot": {"successes": 3, "attempts": 4, "steps": [3, 4], "shares": {"subgoal": [1] + [0] * 7, "mission": [1]}},
        "methods": {
            name: {
                "log_likelihood_per_step": {"train": -0.25, "valid": value},
                "parameters": 1,
                "converged": name != "two",
                "bridge_difference": 0.0,
            }
            for name, value in valid.items()
        },
        "played": {name: {"success": [True] * successes + [False] * (4 - successes)} for name in babyai_results.PLAYED},
        "crossed": {"one": [labels], "two": [labels, labels]},
        "references": {"kmeans": labels},
        "seconds": {"all": 1.0},
    }


def test_the_page_of_two_seeds_worked_by_hand():
    found = [cell(0, (-1.0, -1.0, -0.5, -0.25), 1, 0.25), cell(1, (-1.0, -1.0, -0.5, -0.25), 2, 0.75)]
    text = babyai_results.page(json.loads(json.dumps(babyai_results.summarize(found))), "Made.")
    two = "-0.250 [-0.250, -0.250]; +0.750 [+0.750, +0.750] (-0.25), 2 not converged"
    assert f"-0.500 [-0.500, -0.500]; +0.500 [+0.500, +0.500] (-0.25) | {two} |" in text
    assert "| Toy | told | 3 of 8 | 3 of 8 | 3 of 8 | 3 of 8 | 3 of 8 | 3 of 8 |" in text
    assert "| Toy | told | two: plan | mission | 0.50 | 0.50 |" in text
    assert "| Toy | 3 of 4 | 3.5 | GoNextTo 100% | 100% |" in text
