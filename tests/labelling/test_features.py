"""Skills that pictures alone show, planted: what proposals become by features, and where those come from."""

import os
from dataclasses import replace

import numpy as np
import pytest
from command_line import call
from labelled import accept, here, label, refitted, until

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.encoding import Backbone
from ddco_pyro.fitting.fit import fit
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.features import Features
from ddco_pyro.labelling.session import Session
from ddco_pyro.spec import parse_spec

SIZE, SKILLS = 24, 3
LINEAR = {"network": "linear"}


def shown_by_a_lamp(generator, number):
    """Vectors and controls are noise, each in another light. A lamp has another colour for each skill."""
    lengths = generator.integers(8, 20, 6)
    skills = np.cumsum([generator.integers(SKILLS), *generator.integers(1, SKILLS, 5)]) % SKILLS
    phase = np.repeat(skills, lengths)
    pictures = generator.normal(generator.integers(50, 90, 3) + 8 * number, 8, (len(phase), SIZE, SIZE, 3))
    pictures[:, 2:8, 15:21] = 60 + 140 * np.eye(SKILLS)[phase][:, None, None]
    state, action = (generator.normal(size=(len(phase), size)) for size in (3, 2))
    seen = {"state": state.cumsum(0), "camera": pictures.clip(0, 255).astype(np.uint8)}
    return Demonstration(f"demo_{number}", seen, action, {"phase": phase})


@pytest.fixture(scope="module")
def demos():
    generator = np.random.default_rng(0)
    return Demonstrations(tuple(shown_by_a_lamp(generator, number) for number in range(8)))


@pytest.fixture(scope="module")
def lamps(demos, tmp_path_factory):
    """The file, and a run that reads its vectors."""
    path = tmp_path_factory.mktemp("lamps") / "lamps.hdf5"
    demos.write(path)
    level = {"name": "skill", "count": SKILLS, "policy": LINEAR, "termination": LINEAR}
    spec = {
        "demonstrations": {"path": str(path), "valid_fraction": 0},
        "observations": ["state"],
        "control": {"std": {"learn": True, "floor": 0.01}},
        "hierarchy": {"levels": [level], "meta_policy": LINEAR},
        "training": {"optimizer": {"name": "em"}, "tune_fraction": 0, "epochs": 10},
        "compare_with": [],
    }
    return path, fit(parse_spec(spec), out=path.with_name("run"))


@pytest.fixture
def of(lamps, tmp_path, monkeypatch):
    """Features of the file, which this process computes."""
    monkeypatch.setattr(os, "nice", lambda by: 0)
    monkeypatch.setattr(Background, "_submit", here)
    out = tmp_path / "out.hdf5"
    return lambda backbone: Features.of(lamps[0], out, f"user_encoders:{backbone}", True, {})


def settled(session):
    until(lambda: not session.encoding.running)
    refitted(session)


def right(demos, lamps, out, features):
    """The share of right steps of the others after one, two and three demonstrations are labelled."""
    session, found = Session(replace(lamps[1], named={}), lamps[0], out, features=features), []
    session.begin()
    settled(session)
    for index, demo in enumerate(demos[:3]):
        label(session, index, demo.labels["phase"])
        accept(session, index)
        settled(session)
        rest = [session.shown[own.name].options == 1 + own.labels["phase"] for own in demos[index + 1 :]]
        found.append(float(np.concatenate(rest).mean()))
    assert not session.warnings()
    session.close()
    return found


def test_features_show_what_vectors_do_not(demos, lamps, of, tmp_path):
    without = right(demos, lamps, tmp_path / "without.hdf5", None)
    by_pictures = right(demos, lamps, tmp_path / "with.hdf5", of("blocks"))
    assert max(without) < 0.5
    assert by_pictures[0] > 0.8
    assert by_pictures[1] > 0.95


def test_features_are_computed_once_and_again_where_a_file_is_damaged(of, demos, monkeypatch):
    before, asked, compute = of("blocks").computed(), [], Backbone.features
    lengths = {name: len(rows) for name, rows in before.items()}
    assert lengths == dict(zip(demos.names, demos.lengths, strict=True))
    assert np.concatenate([*before.values()]).std() == pytest.approx(1.0)
    monkeypatch.setattr(Backbone, "features", lambda own, seen: asked.append(len(seen)) or compute(own, seen))
    again = of("blocks")
    (again.folder / "2.npy").write_bytes(b"")
    (again.folder / "3.npy").write_bytes((again.folder / "3.npy").read_bytes()[:-8])
    after = again.computed()
    assert asked == list(demos.lengths[2:4])
    for name, rows in before.items():
        np.testing.assert_array_equal(rows, after[name])
    assert of("means").folder != again.folder


def test_a_network_that_fails_later_is_said_and_labelling_goes_on(lamps, of, tmp_path):
    fit, features = replace(lamps[1], named={}), of("later_not_finite")
    session = Session(fit, lamps[0], tmp_path / "out.hdf5", features=features)
    session.begin()
    settled(session)
    (line,) = session.state()["warnings"]
    says = "features of pictures: encoder 'user_encoders:later_not_finite' gives features that are NaN"
    assert line.startswith(says)
    assert session.edit({"do": "name", "demo": 0, "step": 0, "option": 1})["done"]
    session.close()


BLOCKS, ALLOWED = "user_encoders:blocks", "--allow-code"


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ([BLOCKS], "would import user code; pass --allow-code"),
        (["resnet18", ALLOWED], "there is no encoder 'resnet18'; take timm:NAME"),
        (["user_encoders:raises", ALLOWED], "fails on pictures [4, 24, 24, 3]: expected 224 x 224"),
    ],
)
def test_what_cannot_be_read_is_refused_first(lamps, tmp_path, monkeypatch, features, message):
    refused([lamps[1].folder, lamps[0]], features, message, tmp_path, monkeypatch)


def test_demonstrations_without_pictures_are_refused(run, file, tmp_path, monkeypatch):
    says = f"--features: {file} has no pictures"
    refused([run.folder, file], [BLOCKS, ALLOWED], says, tmp_path, monkeypatch)


def refused(paths, features, message, folder, monkeypatch):
    monkeypatch.chdir(folder)
    ended = call("label", *paths, "--no-browser", "--features", *features)
    assert (ended.status, ended.err.count("\n"), list(folder.iterdir())) == (2, 1, [])
    assert message in ended.err
