"""Segments of a length that is asked for: small fits find the power and the gates."""

from pathlib import Path

import numpy as np
import pytest
from command_line import done, refused
from planted import small_spec
from random_demonstrations import numbered
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.options import segments_of
from ddco_pyro.selection import small
from ddco_pyro.selection.small import Lasting, heavy_tails, in_steps, lasting, moved, overrides
from ddco_pyro.spec import load_spec, with_overrides

SLOW = 30


def skills_within_which_speed_varies(number=5, steps=100, seed=0, long=SLOW):
    """Skills of about ``long`` steps, each a direction; the speed along it changes every 3 or 4 steps."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        skill = np.repeat(np.arange(steps // long + 2) % 2, long)[random.integers(0, long) :][:steps]
        fast = np.cumsum(random.random(len(skill)) < 0.3) % 2
        turned = np.stack([np.where(skill, 1.0, -1.0), np.where(skill, -1.0, 1.0)], 1)
        controls = turned * np.where(fast, 1.2, 0.8)[:, None] + 0.6 * random.normal(size=(len(skill), 2))
        speed = np.where(fast, 1.0, -1.0)[:, None] + 0.5 * random.normal(size=(len(skill), 2))
        observed = random.normal(size=(len(skill), 2))
        found.append(({"state": observed}, np.concatenate([controls, speed], 1), {"skill": skill}))
    return numbered(found)


SPEC = small_spec(
    demonstrations={"path": "unused.hdf5", "valid_fraction": 0},
    control={"std": {"learn": True, "floor": 0.01, "per_option": True}},
    training={"starts": ["vq_controls"], "optimizer": {"name": "em"}, "epochs": 60},
)


@pytest.mark.parametrize("long", [SLOW, 8])
def test_options_last_as_long_as_is_asked(long):
    """Windows as wide as two short skills would mix them; long ones are not found without windows."""
    demos = skills_within_which_speed_varies(long=long)
    assert segments_of(ddco_pyro.fit(SPEC, demos).segment(demos)[0]).median < 6  # the speed
    found = lasting(SPEC, demos, long)
    assert long / 1.5 < found.segments.median < 1.5 * long
    changes = overrides(SPEC, found.power, found.constant, found.window)
    fit = ddco_pyro.fit(with_overrides(SPEC, changes), demos)
    options = np.concatenate(fit.segment(demos)[0])
    skills = np.concatenate([demo.labels["skill"] for demo in demos])
    assert normalized_mutual_info_score(skills, options) > 0.7


def test_long_options_are_found_where_no_length_is_asked():
    demos = skills_within_which_speed_varies()
    assert not lasting(SPEC, demos, None).segments.brief


def test_lengths_are_seconds_or_steps():
    whole = [("20", 10.0, 20.0), ("20", None, 20.0)]
    for length, frequency, steps in [("2s", 10.0, 20.0), *whole, ("0.5s", 30.0, 15.0)]:
        assert in_steps("--segment", length, frequency) == steps
    for length, frequency, says in (
        ("2s", None, "do not say how many"),
        ("long", 10.0, "give sec"),
        ("-3", 10.0, "give sec"),
    ):
        with pytest.raises(BadInput, match=says):
            in_steps("--segment", length, frequency)


def test_init_writes_what_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Five segments of 100 steps are 20 each."""
    file, spec = tmp_path / "demos.hdf5", tmp_path / "spec.yaml"
    skills_within_which_speed_varies().write(file)
    some = segments_of([np.repeat([1, 2], 21)])
    found = {20: Lasting(0.3, True, 7, some, 0.0)}
    monkeypatch.setattr(small, "lasting", lambda _, __, steps, ___: found[steps])
    monkeypatch.setattr(small, "heavy_tails", lambda *_: (1, 2))
    ended = done("init", file, "--out", spec, "--segments", "5")
    assert "median segment 21 steps in small fits; asked: 20 steps" in ended.out
    written = load_spec(spec)
    assert (written.control.power, written.training.window) == (0.3, 7)
    gates = (written.hierarchy.levels[0].termination, written.hierarchy.meta_policy)
    assert [gate.network for gate in gates] == ["constant", "constant"]
    assert [(part.kind, part.dims) for part in written.control.parts] == [("student", (1, 2))]
    both = ("--segments", "5", "--segment", "3s")
    refused("exclude each other", "init", file, "--out", spec, "--force", *both)


def test_heavy_tails_are_found_where_they_predict_better():
    random = np.random.default_rng(0)
    observed = [random.normal(size=(60, 2)) for _ in range(8)]
    spec = with_overrides(SPEC, {"hierarchy.levels.0.count": 1})
    for degrees, dims in ((1.5, (0, 1)), (1000.0, ())):
        scale = [1 / np.sqrt(random.chisquare(degrees, size=(60, 1)) / degrees) for _ in observed]
        noise = [0.3 * own * random.normal(size=(60, 2)) for own in scale]
        demos = numbered(({"state": x}, x + e) for x, e in zip(observed, noise, strict=True))
        assert heavy_tails(spec, demos) == dims


def reaching(other, absolute, random):
    """A hand that wanders by 0.1, and something else that moves further, in [60, 3]."""
    steps = 0.02 * random.normal(size=3) + 0.01 * random.normal(size=(60, 3))
    hand = np.cumsum(steps, axis=0)
    seen = {"handle": other(np.linspace(0, 1, 60)[:, None]) * [3.0, 2.0, 1.0], "palm": hand}
    return seen, np.vstack([hand[1:], hand[-1:]]) if absolute else np.vstack([steps[1:], 0 * steps[:1]])


OTHERS = {"late": lambda time: np.maximum(time - 0.7, 0), "belt": lambda time: time}


@pytest.mark.parametrize("absolute", [False, True], ids=["velocities", "targets"])
@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_the_hand_is_drawn_where_something_else_moves_further(other, absolute):
    random = np.random.default_rng(0)
    assert moved(numbered(reaching(other, absolute, random) for _ in range(10))) == "palm"


@pytest.mark.parametrize(("more", "drawn"), [({}, ""), ({"hand": 2}, "hand"), ({"hand": 2, "arm": 3}, "arm")])
def test_a_plane_is_drawn_where_nothing_moves_in_space(more, drawn):
    """A goal does not move, a sine and a cosine are no place, nor are fingers of a gripper beside an arm."""
    rng, rows = np.random.default_rng(0), []
    for _ in range(4):
        control, turn = rng.normal(size=(30, 3)), np.cumsum(0.1 * rng.random(30))[:, None]
        seen = {key: np.cumsum(control[:, :size], 0) for key, size in more.items()}
        still = {"angle": np.hstack([np.sin(turn), np.cos(turn)]), "goal": np.ones((30, 3))}
        rows.append((still | seen, control))
    assert moved(numbered(rows)) == drawn
