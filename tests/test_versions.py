"""Other versions of a vector, such as features of moved pictures: how they are written, found, and trained with."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from command_line import call

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import shifted
from ddco_pyro.encoding import Encoding, encode, load
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.spec import SpecError, parse_spec

VERSIONS = 3
VARIED = {"key": "place", "augment": {"versions": "place_moved"}}


def demonstrations(*, apart: float = 1.0, number: int = 8) -> Demonstrations:
    """``place_moved`` has ``place`` moved by ``apart``, twice and three times as far."""
    random, far = np.random.default_rng(0), apart * np.arange(1, VERSIONS + 1)

    def one(index: int) -> Demonstration:
        place = random.normal(size=(5 + index, 2))
        seen = {
            "place": place,
            "place_moved": place[:, None] + far[:, None],
            "other": random.normal(size=(5 + index, 1)),
        }
        return Demonstration(f"demo_{index}", seen, random.normal(size=(5 + index, 2)))

    return Demonstrations(tuple(one(index) for index in range(number)))


def spec_of(*observations: Any, **training: Any) -> dict[str, Any]:
    return {
        "demonstrations": {"path": "unused", "valid_fraction": 0.25},
        "observations": list(observations),
        "hierarchy": {"levels": [{"count": 2, "policy": {"network": "mlp", "hidden": [4]}}]},
        "training": {"epochs": 6, "batch_size": 2, "patience": None, **training},
        "compare_with": [{"kind": "flat"}],
    }


def bits(fit: ddco_pyro.Fit) -> bytes:
    models = (fit.hierarchy, *(beside.hierarchy for beside in fit.baselines.values()))
    return b"".join(value.numpy().tobytes() for model in models for value in model.state_dict().values())


# --- what is trained with ---------------------------------------------------------------------------------------------


def test_each_trajectory_is_seen_as_it_is_or_as_one_version_each_equally_often() -> None:
    demos = demonstrations()
    spec = parse_spec(spec_of("other", {**VARIED, "differences": True}))
    encoder = ObservationEncoder(spec.observations, demos.observation_shapes)
    encoder.fit(demos)
    inputs = encoder.inputs(demo.observations for demo in demos)
    batch = Batch(inputs, torch.zeros(*inputs.batch, 2), torch.tensor(demos.lengths), encoder.versions(demos))
    mean, std = (np.asarray(values)[1:3] for values in (encoder.mean, encoder.std))  # of place, behind other
    seen: Counter[int] = Counter()
    for seed in range(100):
        varied = batch.varied({}, seed)
        assert torch.equal(varied.inputs.vectors["other"], inputs.vectors["other"])
        for n, demo in enumerate(demos):
            found = varied.inputs.vectors["place"][n].numpy()
            by = (found[: len(demo), :2] * std + mean - demo.observations["place"]).round(4)
            assert len(np.unique(by)) == 1  # all of it is moved alike
            assert not found[len(demo) :].any()
            np.testing.assert_allclose(found[:, 2:], inputs.vectors["place"][n, :, 2:], atol=1e-5)  # differences stay
            seen[round(float(by[0, 0]))] += 1
    assert sorted(seen) == [0, 1, 2, 3]
    assert min(seen.values()) > 150  # of 800, of which 200 are expected: 4 standard deviations
    assert torch.equal(batch.varied({}, 7).inputs.vector, batch.varied({}, 7).inputs.vector)
    few = batch.varied({}, 7).select(torch.tensor([2, 0]))
    assert torch.equal(few.inputs.vector, batch.varied({}, 7).inputs.vector[[2, 0], :7])


def test_versions_that_do_not_differ_change_nothing() -> None:
    """Bit for bit, the policies beside it too."""
    demos = demonstrations(apart=0.0)
    varied, plain = (ddco_pyro.fit(parse_spec(spec_of("other", one)), demos) for one in (VARIED, "place"))
    assert bits(varied) == bits(plain)


def test_versions_are_for_training_alone() -> None:
    """A fit trains otherwise with them, and needs none of them for anything else."""
    demos = demonstrations()
    varied, plain = (ddco_pyro.fit(parse_spec(spec_of("other", one)), demos) for one in (VARIED, "place"))
    assert bits(varied) != bits(plain)
    for name in ("mean", "std"):
        assert torch.equal(getattr(varied.hierarchy.encoder, name), getattr(plain.hierarchy.encoder, name))
    kept = [{key: demo.observations[key] for key in ("place", "other")} for demo in demos]
    bare = Demonstrations(tuple(replace(demo, observations=own) for demo, own in zip(demos, kept, strict=True)))
    np.testing.assert_array_equal(varied.log_likelihood(bare), varied.log_likelihood(demos))
    controller = varied.controller(seed=0)
    assert controller.act({key: values[0] for key, values in bare[0].observations.items()}).shape == (2,)


# --- how they are written ---------------------------------------------------------------------------------------------


def test_moved_pictures_are_encoded_as_pictures_are(few_dots: Path, tmp_path: Path) -> None:
    out, most = tmp_path / "out.hdf5", 2
    encode(few_dots, out, Encoding("camera", size=5, moved=VERSIONS, shift=most, seed=3))
    encoder, pictures = load(f"{out}.encoder"), Demonstrations.read(few_dots, ["camera"])
    found, moves = Demonstrations.read(out), []
    for demo, original in zip(found, pictures, strict=True):
        versions, frames = demo.observations["camera_features_moved"], original.observations["camera"]
        assert versions.shape == (len(demo), VERSIONS, encoder.about.size)
        for version in range(VERSIONS):
            steps = (0, len(demo) - 1)
            expected = {
                (down, right): np.stack([encoder(shifted(np.asarray(frames[s])[None], down, right)[0]) for s in steps])
                for down in range(-most, most + 1)
                for right in range(-most, most + 1)
            }
            fits = [
                by for by, values in expected.items() if np.allclose(values, versions[list(steps), version], atol=1e-5)
            ]
            assert fits
            moves += fits[:1]
    assert len(set(moves)) > 9  # of 18, of 25 that there are
    plain = tmp_path / "plain.hdf5"
    encode(few_dots, plain, Encoding("camera", size=5, seed=3))
    for demo, other in zip(found, Demonstrations.read(plain), strict=True):
        np.testing.assert_array_equal(demo.observations["camera_features"], other.observations["camera_features"])


@pytest.mark.usefixtures("undecided")
def test_from_pictures_to_a_policy_by_commands(few_dots: Path, tmp_path: Path) -> None:
    """``init`` finds the versions, a fit trains with them, and pictures without versions are segmented."""
    out, bare, spec, run = (tmp_path / name for name in ("moved.hdf5", "bare.hdf5", "spec.yaml", "run"))
    given = ("encode", few_dots, "--observation", "camera", "--size", 4)
    ended = call(*given, "--out", out, "--moved", VERSIONS, "--shift", 2)
    assert ended.status == 0
    assert "; of moved pictures, 3 times: obs/camera_features_moved; " in ended.out
    assert call(*given, "--out", bare).status == 0
    assert call("init", out, "--out", spec).status == 0
    whole = yaml.safe_load(spec.read_text())
    assert whole["training"]["optimizer"]["name"] == "adam"  # em would see no versions
    written = whole["observations"]
    own = next(one for one in written if one["key"] == "camera_features")
    assert own["augment"] == {"versions": "camera_features_moved"}
    assert "camera_features_moved" not in [one["key"] for one in written]
    assert call("fit", spec, "--out", run, "--set", "training.epochs=4").status == 0
    assert call("segment", run, bare, "--csv", tmp_path / "segments.csv").status == 0
    assert call("fit", spec, "--out", tmp_path / "other", "--set", f"demonstrations.path={bare}").status == 2


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"key": "place", "augment": {"versions": "other"}}, r"'other' has shape \[1\] at each step, it has to be \[v"),
        ({"key": "other", "augment": {"versions": "place_moved"}}, r"has shape \[3, 2\] .* to be \[versions, 1\]"),
        ({"key": "place", "augment": {"shift": 1}}, r"'place' has shape \[2\] at each step: augment.shift is for pic"),
    ],
)
def test_versions_of_another_shape(observation: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        ddco_pyro.fit(parse_spec(spec_of(observation)), demonstrations())
