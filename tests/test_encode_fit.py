"""Pictures encoded by the network of a fit, against what that network gives within the fit."""

from __future__ import annotations

import json
import shutil

import h5py
import numpy as np
import pytest
import torch
from command_line import call
from dots import together

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Damaged
from ddco_pyro.encoding import Encoding, encode, load
from ddco_pyro.spec import parse_spec

SEES = {"network": "conv", "filters": 3, "pool": "flatten", "hidden": [5], "activation": "tanh", "standardize": True}
BRANCHES = {"network": "branches", "of": {"camera": SEES, "place": {"network": "mlp", "hidden": [4]}}, "hidden": [6]}
SHARED = BRANCHES | {"of": BRANCHES["of"] | {"camera": SEES | {"shared": True}}}
LSTM = {"network": "lstm", "over": SEES | {"inputs": ["camera"]}, "hidden": [4]}
CUT = {"crop": [2, 1, 16, 18], "resize": [8, 9]}


def flat(policy):
    return {"baseline": {"kind": "flat", "policy": policy}}


def options(trunk, whole=None, **policy):
    level = {"name": "option", "count": 2, "termination": {"network": "linear"}, "policy": {"network": "linear"}}
    level |= {"trunk": trunk} if trunk else {}
    meta_policy = {"network": "linear", "inputs": [] if whole else ["place"]}
    return {"hierarchy": {"trunk": whole, "levels": [level | policy], "meta_policy": meta_policy}}


MODELS = {
    "a flat policy": (flat(BRANCHES), {}, lambda networks: networks["meta_policy"].of[0]),
    "cut pictures": (flat(BRANCHES), CUT, lambda networks: networks["meta_policy"].of[0]),
    "options that share it": (options(SHARED), {}, lambda networks: networks["levels.0.trunk"].of[0]),
    "read by all": (options(None, BRANCHES), {}, lambda networks: networks["trunk"].of[0]),
    "under an LSTM": (flat(LSTM), {}, lambda networks: networks["meta_policy"].over),
    "by itself": (flat(SEES | {"inputs": ["camera"]}), {}, lambda networks: networks["meta_policy"].layers[1]),
}


def fitted(few_dots, folder, model, camera=None):
    """A run of one epoch."""
    observations = [{"key": "camera", **(camera or {})}, {"key": "place"}]
    spec = {"demonstrations": {"path": str(few_dots)}, "observations": observations, "training": {"epochs": 1}}
    return ddco_pyro.fit(parse_spec(spec | model), out=folder)


@pytest.fixture(scope="module")
def branched(few_dots, tmp_path_factory):
    """The folder of a run whose flat policy has a branch for pictures; nobody changes it."""
    return fitted(few_dots, tmp_path_factory.mktemp("runs") / "run", flat(BRANCHES)).folder


def within(fit, network, demo):
    """What the last hidden layer of a network of the fit gives at each step of a demonstration."""
    given = []
    handle = network.register_forward_hook(
        lambda _, __, output: given.append(output[0] if isinstance(output, tuple) else output)
    )
    with torch.no_grad():
        fit.hierarchy(fit.hierarchy.encoder.inputs([demo.observations]).loaded())
    handle.remove()
    return torch.cat([part.reshape(-1, part.shape[-1]) for part in given]).numpy()


@pytest.mark.parametrize("name", MODELS)
def test_features_are_those_of_the_fit(few_dots, tmp_path, name):
    model, camera, network = MODELS[name]
    run, out = tmp_path / "run", tmp_path / "out.hdf5"
    fit = fitted(few_dots, run, model, camera)
    folder = encode(few_dots, out, Encoding("camera", str(run))).folder
    shutil.rmtree(run)  # the encoder holds what it needs
    demos, encoder = Demonstrations.read(few_dots), load(folder)
    for before, after in zip(demos, Demonstrations.read(out), strict=True):
        expected = within(fit, network(fit.hierarchy.networks()), before)
        features = after.observations["camera_features"]
        np.testing.assert_allclose(features, expected, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose([encoder(one) for one in before.observations["camera"]], features, atol=1e-5)
    assert np.ptp(together(Demonstrations.read(out), "camera_features"), axis=0).max() > 0.01


def test_an_encoder_that_names_user_code_is_damaged(few_dots, branched, tmp_path):
    about = encode(few_dots, tmp_path / "out.hdf5", Encoding("camera", str(branched))).folder / "encoder.json"
    said = json.loads(about.read_text())
    said["reader"]["network"] = {"network": "user_networks:Stateful", "inputs": ["camera"]}
    about.write_text(json.dumps(said))
    with pytest.raises(Damaged, match="has to be convolutions over one observation"):
        load(about.parent)


def test_another_fit_is_another_encoding(few_dots, branched, tmp_path):
    out, run = tmp_path / "out.hdf5", shutil.copytree(branched, tmp_path / "run")
    arguments = ("encode", few_dots, "--observation", "camera", "--encoder", run, "--out", out)
    ended = call(*arguments)
    assert (ended.status, ended.out.startswith(f"{out}: 6 demonstrations, obs/camera_features: 5 of 5 fea")) == (
        0,
        True,
    )
    assert call(*arguments).status == 0
    shutil.rmtree(run)
    fitted(few_dots, run, flat(BRANCHES | {"hidden": [7]}))
    again = call(*arguments)
    assert (again.status, "is not this encoding" in again.err) == (2, True)


ALONE = {"network": "mlp", "hidden": [4], "inputs": ["place"]}


@pytest.mark.parametrize(
    ("model", "camera", "message"),
    [
        (flat(ALONE), {}, "its lowest policy has no convolutions that read camera alone; make them a branch"),
        (options(BRANCHES), {}, "each option has a network of its own for camera; take a flat policy"),
        (flat(BRANCHES), {"frames": 2}, "this fit sees 2 pictures at once; take one with frames: 1"),
    ],
)
def test_fits_that_have_no_encoder(few_dots, tmp_path, model, camera, message):
    out, run = tmp_path / "out.hdf5", tmp_path / "run"
    fitted(few_dots, run, model, camera)
    refused(
        call("encode", few_dots, "--observation", "camera", "--encoder", run, "--out", out), out, f"{run}: {message}"
    )


def test_pictures_that_the_fit_does_not_know(few_dots, branched, tmp_path):
    out, run = tmp_path / "out.hdf5", shutil.copytree(branched, tmp_path / "run")
    other = call("encode", few_dots, "--observation", "other", "--encoder", run, "--out", out)
    refused(other, out, f"{run}: this fit observes no pictures 'other'; the pictures it observes: camera")
    with h5py.File(few_dots) as source, h5py.File(tmp_path / "cut.hdf5", "w") as file:
        source.copy("data", file)
        for demo in file["data"].values():
            pictures = demo["obs/camera"][:, 1:]
            del demo["obs/camera"]
            demo["obs/camera"] = pictures
    cut = call("encode", tmp_path / "cut.hdf5", "--observation", "camera", "--encoder", run, "--out", out)
    refused(cut, out, f"{run}: this fit observed camera of (20, 20, 2), and these are (19, 20, 2)")
    (run / "model.safetensors").unlink()
    unfinished = call("encode", few_dots, "--observation", "camera", "--encoder", run, "--out", out)
    refused(unfinished, out, "an unfinished run")


def refused(ended, out, message):
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert message in ended.err
    assert not [path for path in out.parent.iterdir() if "out" in path.name]
