"""Pictures encoded as vectors: against torch, scikit-learn and planted places; whole, in pieces, and after a kill."""

from __future__ import annotations

import json
import os
import shutil
import signal
import tracemalloc

import forked
import h5py
import numpy as np
import pytest
import torch
from command_line import call
from dots import SIZE, dots, followed, together
from odd_files.hdf5 import instead
from planted import make_spec, make_trainer, make_truth, plant
from safetensors.torch import load_file
from sklearn.decomposition import PCA
from sklearn.linear_model import LinearRegression
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import Damaged
from ddco_pyro.encoding import Encoding, autoencoder, encode, load
from ddco_pyro.encoding.encoder import principal_components
from ddco_pyro.errors import BadInput
from ddco_pyro.events import DemonstrationsDone, UpdatesDone
from ddco_pyro.inference import segment
from ddco_pyro.model.batch import encode as prepare
from ddco_pyro.spec import parse_spec

OWN = "user_encoders:"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("dots") / "dots.hdf5"
    followed(24).write(path)
    return path


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.hdf5"


def contents(out):
    """Every byte of the file and of what is beside it."""
    beside = {path.name: path.read_bytes() for path in out.with_name(f"{out.name}.encoder").iterdir()}
    return out.read_bytes(), beside


# --- what comes out ---------------------------------------------------------------------------------------------------


def held_out_accuracy(out):
    """R² of the dot's place as a linear map of the features, in demonstrations that were held out of everything."""
    train, valid = Demonstrations.read(out).split(0.2, 0)
    places = LinearRegression().fit(together(train, "camera_features"), together(train, "place"))
    return places.score(together(valid, "camera_features"), together(valid, "place"))


def test_random_convolutions_say_where_the_dot_is(source, out):
    encode(source, out, Encoding("camera", "random_conv", size=16))
    assert held_out_accuracy(out) > 0.9


def test_an_autoencoder_says_where_the_dot_is(source, out):
    """It gives the picture from that: better than the best picture that never changes, which cannot show a dot."""
    seen = []
    encode(source, out, Encoding("camera", "autoencoder", size=16, updates=150), seen.append)
    assert held_out_accuracy(out) > 0.9
    pictures = together(Demonstrations.read(source).split(0.2, 0)[0], "camera") / 255
    losses = [event.loss for event in seen if isinstance(event, UpdatesDone)]
    assert len(losses) == 3
    assert losses[-1] < 0.8 * pictures.var(0).mean()


def test_options_are_recovered_from_features(tmp_path, out):
    """Planted in a plane, and seen as pictures of a dot alone."""
    truth = make_truth(make_spec((3,)))
    demos, choices = plant(truth, 40, 20, seed=1)
    drawn = [Demonstration(demo.name, {"camera": dots(demo.observations["state"])}, demo.actions) for demo in demos]
    Demonstrations(tuple(drawn)).write(tmp_path / "planted.hdf5")
    encode(tmp_path / "planted.hdf5", out, Encoding("camera", size=8, name="state"))
    spec = make_spec((3,), epochs=300, starts=["vq_controls"])
    found = make_trainer(spec, Demonstrations.read(out), tmp_path / "fit").run()
    batch = prepare(Demonstrations.read(out), found.encoder, found.scaling)
    segments = segment(found.tabulate(batch), batch.lengths)[0]
    assert normalized_mutual_info_score(choices.flatten(), segments.flatten()) > 0.85


def test_all_but_the_pictures_stays(few_dots, out):
    before = Demonstrations.read(few_dots)
    assert encode(few_dots, out, Encoding("camera", size=5)).demonstrations == 6
    after = Demonstrations.read(out)
    assert (after.masks, after.names) == (before.masks, before.names)
    assert before.attributes.items() <= after.attributes.items()
    assert after.observation_shapes == {"other": (4, 4, 2), "place": (2,), "camera_features": (5,)}
    labelled = [Demonstrations.read(path, labels=["phase"]) for path in (few_dots, out)]
    for demo, other in zip(*labelled, strict=True):
        np.testing.assert_array_equal(demo.actions, other.actions)
        np.testing.assert_array_equal(demo.labels["phase"], other.labels["phase"])
        np.testing.assert_array_equal(demo.observations["other"], other.observations["other"])
        np.testing.assert_array_equal(demo.observations["place"], other.observations["place"])
        assert demo.attributes == other.attributes
    with h5py.File(out) as file:
        assert file["data/demo_0/obs/camera_features"].dtype == np.float32


def test_random_convolutions_written_out(few_dots, out):
    folder = encode(few_dots, out, Encoding("camera", seed=3)).folder
    weights, picture = load_file(folder / "encoder.safetensors"), together(Demonstrations.read(few_dots), "camera")[7]
    maps = torch.from_numpy(picture).permute(2, 0, 1)[None] / 255
    for layer, stride, padding in (("0", 2, 2), ("1", 1, 1)):
        weight, bias = (weights[f"network/network.convolutions.0.{layer}.{name}"] for name in ("weight", "bias"))
        maps = torch.relu(torch.nn.functional.conv2d(maps, weight, bias, stride, padding))
    share = torch.exp(maps[0]) / torch.exp(maps[0]).sum((1, 2), keepdim=True)
    axis = torch.linspace(-1, 1, SIZE // 2)
    expected = torch.stack([(share.sum(2) * axis).sum(1), (share.sum(1) * axis).sum(1)], 1).flatten()
    assert expected.shape == (128,)
    np.testing.assert_allclose(load(folder).extractor.encode(picture[None])[0], expected, atol=1e-6)


@pytest.mark.parametrize("size", [1, 4, 9])
def test_principal_components_are_those_of_all_rows_at_once(size):
    random = np.random.default_rng(0)
    rows = 100 + random.normal(size=(500, 9)) @ random.normal(size=(9, 9))
    ours, theirs = principal_components(np.array_split(rows.astype(np.float32), 13), size), PCA(size).fit(rows)
    projected, expected = ours(rows), theirs.transform(rows)
    np.testing.assert_allclose(projected * np.sign((projected * expected).sum(0)), expected, atol=1e-4)
    np.testing.assert_allclose(ours.explained, theirs.explained_variance_ratio_.sum(), rtol=1e-6)
    spread = theirs.explained_variance_ / theirs.explained_variance_[0]
    for least in (0.0, 0.3, 2.0):
        without = principal_components([rows], size, least)
        assert len(without.components) == max(1, (spread >= least).sum())


def test_components_see_the_training_demonstrations_alone(few_dots, out):
    folder = encode(few_dots, out, Encoding("camera", "user_encoders:Means", size=2), allow_code=True).folder
    train, _ = Demonstrations.read(few_dots).split(0.2, 0)
    pictures = together(train, "camera").astype(float)
    rows = np.concatenate([pictures.mean((1, 2)), pictures[:, : SIZE // 2].mean((1, 2))], 1)
    everything = load_file(folder / "encoder.safetensors")
    np.testing.assert_allclose(everything["mean"], rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(everything["components"].abs(), np.abs(PCA(2).fit(rows).components_), atol=1e-4)


@pytest.mark.parametrize("encoder", ["random_conv", "autoencoder", "user_encoders:Means"])
def test_a_picture_that_is_seen_while_acting(few_dots, out, encoder):
    folder = encode(few_dots, out, Encoding("camera", encoder, size=3, updates=2), allow_code=True).folder
    loaded, pictures = load(folder, allow_code=True), together(Demonstrations.read(few_dots), "camera")
    one_by_one = np.stack([loaded(picture) for picture in pictures])
    assert one_by_one.dtype == np.float32
    np.testing.assert_allclose(one_by_one, together(Demonstrations.read(out), "camera_features"), rtol=1e-4, atol=1e-5)
    with pytest.raises(BadInput, match=r"camera: is float64 \(20, 20, 2\); this encoder reads uint8 \(20, 20, 2\)"):
        loaded(pictures[0] / 255)


# --- in pieces --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoder", ["random_conv", "autoencoder"])
def test_blocks_of_any_size(few_dots, tmp_path, monkeypatch, encoder):
    encoding, results = Encoding("camera", encoder, size=4, updates=3), []
    for size in (2**24, 1, 3 * SIZE * SIZE * 2):
        monkeypatch.setattr("ddco_pyro.data.pictures.BLOCK_BYTES", size)
        encode(few_dots, tmp_path / f"{size}.hdf5", encoding)
        results.append(contents(tmp_path / f"{size}.hdf5"))
    assert results[0] == results[1] == results[2]


def test_memory_holds_a_block_of_pictures(tmp_path, out, monkeypatch):
    """Of a demonstration of 17 MB."""
    pictures, controls = np.zeros((400, 120, 120, 3), np.uint8), np.zeros((400, 1))
    Demonstrations((Demonstration("demo_0", {"camera": pictures}, controls),)).write(tmp_path / "long.hdf5")
    monkeypatch.setattr("ddco_pyro.data.pictures.BLOCK_BYTES", 2**20)
    tracemalloc.start()
    try:
        encode(tmp_path / "long.hdf5", out, Encoding("camera", f"{OWN}Means"), allow_code=True)
        assert tracemalloc.get_traced_memory()[1] < pictures.nbytes / 2
    finally:
        tracemalloc.stop()


def killed(path, out, encoding, kind, after):
    """Encode in another process, which kills itself at an event."""
    left = after

    def strike(event):
        nonlocal left
        left -= isinstance(event, kind)
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    assert forked.run(lambda: encode(path, out, encoding, strike)).status == -signal.SIGKILL
    assert not out.exists()


def test_killed_again_and_again(few_dots, tmp_path, monkeypatch):
    monkeypatch.setattr(autoencoder, "SHOWN_EVERY", 2)
    encoding = Encoding("camera", "autoencoder", size=4, updates=9)
    encode(few_dots, tmp_path / "whole.hdf5", encoding)
    out, seen = tmp_path / "killed.hdf5", []
    killed(few_dots, out, encoding, UpdatesDone, 3)
    killed(few_dots, out, encoding, DemonstrationsDone, 2)
    killed(few_dots, out, encoding, DemonstrationsDone, 2)
    encode(few_dots, out, encoding, seen.append)
    assert [event.done for event in seen if isinstance(event, DemonstrationsDone)] == [5, 6]
    assert contents(out) == contents(tmp_path / "whole.hdf5")
    left = {path.name for path in tmp_path.iterdir() if "killed" in path.name}
    assert left == {"killed.hdf5", "killed.hdf5.encoder"}


def test_the_command(few_dots, out):
    arguments = ("encode", few_dots, "--observation", "camera", "--size", 6, "--out", out)
    ended = call(*arguments)
    assert ended.status == 0
    assert ended.out.startswith(f"{out}: 6 demonstrations, obs/camera_features: 6 of 128 features, 9")
    before = contents(out)
    assert call(*arguments).status == 0
    assert contents(out) == before
    other = call(*arguments, "--seed", 1)
    assert (other.status, contents(out)) == (2, before)
    assert "is there already and is not this encoding; choose another --out" in other.err


# --- what cannot be encoded -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--observation", "camra"], "there is no observation 'camra' (did you mean 'camera'?); pictures are: camera"),
        (["--observation", "place"], "obs/place is float64 [8, 2]; pictures are uint8 [steps, height, width"),
        (["--size", "129"], "--size 129: encoder 'random_conv' gives 128 features; take at most as many"),
        (["--size", "60"], "--size 60: there are 35 training pictures; take at most as many"),
        (["--as", "place"], "obs/place is there already; choose another name with --as"),
        (["--encoder", "random"], "there is no encoder 'random' (did you mean 'random_conv'?); take random_conv, "),
        (["--encoder", f"{OWN}Nothing"], "cannot be imported or made: module 'user_encoders' has no attribute"),
        (["--encoder", f"{OWN}NotMade"], "cannot be imported or made: no weights"),
        (["--encoder", f"{OWN}NotCallable"], "cannot be called; it needs __call__(pictures)"),
        (["--encoder", f"{OWN}Raises"], "fails on pictures [8, 20, 20, 2]: expected 224 x 224 pixels"),
        (["--encoder", f"{OWN}Integers"], "gives int64; it has to give floats"),
        (["--encoder", f"{OWN}Flat"], "gives shape (8,) for 8 pictures; it has to be (8, features)"),
        (["--encoder", f"{OWN}NotFinite"], "gives features that are NaN or infinite"),
        (["--encoder", f"{OWN}Noisy"], "gives other features when it is called again"),
        (["--encoder", f"{OWN}Together"], "gives other features of a picture among others than alone"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_cannot_be_used(few_dots, out, options, message):
    refused(call("encode", few_dots, "--observation", "camera", "--allow-code", *options, "--out", out), out, message)
    assert not list(out.parent.iterdir())


def test_what_was_not_written_here_stays(few_dots, out):
    out.write_bytes(b"mine")
    assert call("encode", few_dots, "--observation", "camera", "--out", out).status == 2
    assert out.read_bytes() == b"mine"
    out.unlink()
    (out.parent / "out.hdf5.encoder").mkdir()
    ended = call("encode", few_dots, "--observation", "camera", "--out", out)
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert "out.hdf5.encoder: is there already" in ended.err


def test_features_that_only_later_pictures_spoil(tmp_path, out):
    demos = followed(2)
    demos[1].observations["camera"][:] = 255
    demos.write(tmp_path / "bright.hdf5")
    with pytest.raises(BadInput, match="gives features that are NaN or infinite in float32"):
        encode(tmp_path / "bright.hdf5", out, Encoding("camera", f"{OWN}LaterNotFinite"), allow_code=True)
    assert not out.exists()
    assert not out.with_name("out.hdf5.encoder").exists()


def test_user_code_needs_permission(few_dots, out):
    ended = call("encode", few_dots, "--observation", "camera", "--encoder", f"{OWN}Means", "--out", out)
    refused(ended, out, "would import user code; pass --allow-code")
    folder = encode(few_dots, out, Encoding("camera", f"{OWN}Means"), allow_code=True).folder
    with pytest.raises(BadInput, match="would import user code"):
        load(folder)


def test_a_damaged_encoder(few_dots, out):
    folder = encode(few_dots, out, Encoding("camera", size=2)).folder
    weights = bytearray((folder / "encoder.safetensors").read_bytes())
    weights[-1] ^= 1
    (folder / "encoder.safetensors").write_bytes(weights)
    with pytest.raises(Damaged, match="write it again with ddco-pyro encode"):
        load(folder)
    about = json.loads((folder / "encoder.json").read_text())
    (folder / "encoder.json").write_text(json.dumps(about | {"version": 2}))
    with pytest.raises(Damaged, match=r"encoder\.json: is damaged"):
        load(folder)
    with pytest.raises(BadInput, match="is no encoder"):
        load(folder.parent)


# --- the network of a fit as an encoder -------------------------------------------------------------------------------


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
    assert call(*arguments).out.startswith(f"{out}: 6 demonstrations, obs/camera_features: 5 of 5 features")
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
    ended = call("encode", few_dots, "--observation", "camera", "--encoder", run, "--out", out)
    refused(ended, out, f"{run}: {message}")


def test_pictures_that_the_fit_does_not_know(few_dots, branched, tmp_path):
    out, run = tmp_path / "out.hdf5", shutil.copytree(branched, tmp_path / "run")
    other = call("encode", few_dots, "--observation", "other", "--encoder", run, "--out", out)
    refused(other, out, f"{run}: this fit observes no pictures 'other'; the pictures it observes: camera")
    with h5py.File(few_dots) as source, h5py.File(tmp_path / "cut.hdf5", "w") as file:
        source.copy("data", file)
        for demo in file["data"].values():
            instead(demo, "obs/camera", demo["obs/camera"][:, 1:])
    cut = call("encode", tmp_path / "cut.hdf5", "--observation", "camera", "--encoder", run, "--out", out)
    refused(cut, out, f"{run}: this fit observed camera of (20, 20, 2), and these are (19, 20, 2)")
    (run / "model.safetensors").unlink()
    unfinished = call("encode", few_dots, "--observation", "camera", "--encoder", run, "--out", out)
    refused(unfinished, out, "an unfinished run")


def refused(ended, out, message):
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert message in ended.err
    assert not [path for path in out.parent.iterdir() if "out" in path.name]
