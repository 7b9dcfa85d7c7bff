"""Pictures encoded as vectors: against timm, scikit-learn and planted places, in a file and while acting."""

import sys

import h5py
import numpy as np
import pytest
import torch
from command_line import call, done, refused
from dots import SIZE, followed, together
from sklearn.decomposition import PCA
from sklearn.linear_model import LinearRegression

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.encoding import Backbone, encode, load, principal_components
from ddco_pyro.errors import BadInput
from ddco_pyro.events import Counted

MEANS, PLACES = "user_encoders:means", "user_encoders:places"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.hdf5"


def encoded(path, out, encoder=MEANS, **options):
    return encode(path, out, "camera", encoder, allow_code=True, **options)


# --- what comes out -----------------------------------------------------------------------------------------


def test_components_say_where_the_dot_is(tmp_path, out):
    """R² of the dot's place as a linear map of the features, in demonstrations held out of everything."""
    followed(24).write(tmp_path / "dots.hdf5")
    encoded(tmp_path / "dots.hdf5", out, PLACES, size=16)
    train, valid = Demonstrations.read(out).split(0.2, 0)
    places = LinearRegression().fit(together(train, "camera_features"), together(train, "place"))
    assert places.score(together(valid, "camera_features"), together(valid, "place")) > 0.9


def test_all_but_the_pictures_stays(few_dots, out):
    before, seen = Demonstrations.read(few_dots), []
    encoded(few_dots, out, size=4, on_event=seen.append)
    assert seen == [Counted("encoding", 6, done=done) for done in range(1, 7)]
    after = Demonstrations.read(out)
    assert (after.masks, after.names, after.attributes) == (before.masks, before.names, before.attributes)
    assert after.observation_shapes == {"other": (4, 4, 2), "place": (2,), "camera_features": (4,)}
    labelled = [Demonstrations.read(path, labels=["phase"]) for path in (few_dots, out)]
    for demo, other in zip(*labelled, strict=True):
        np.testing.assert_array_equal(demo.actions, other.actions)
        np.testing.assert_array_equal(demo.labels["phase"], other.labels["phase"])
        np.testing.assert_array_equal(demo.observations["other"], other.observations["other"])
        np.testing.assert_array_equal(demo.observations["place"], other.observations["place"])
        assert demo.attributes == other.attributes
    with h5py.File(out) as file:
        assert file["data/demo_0/obs/camera_features"].dtype == np.float32


@pytest.mark.parametrize("size", [1, 4, 9])
def test_principal_components_are_those_of_all_rows_at_once(size):
    random = np.random.default_rng(0)
    rows = 100 + random.normal(size=(500, 9)) @ random.normal(size=(9, 9))
    ours = principal_components(np.array_split(rows.astype(np.float32), 13), size)
    theirs = PCA(size).fit(rows)
    projected, expected = ours(rows), theirs.transform(rows)
    np.testing.assert_allclose(projected * np.sign((projected * expected).sum(0)), expected, atol=1e-4)
    np.testing.assert_allclose(ours.explained, theirs.explained_variance_ratio_.sum(), rtol=1e-6)
    spread = theirs.explained_variance_ / theirs.explained_variance_[0]
    for least in (0.0, 0.3, 2.0):
        without = principal_components([rows], size, least)
        assert len(without.components) == max(1, (spread >= least).sum())


def test_components_see_the_training_demonstrations_alone(few_dots, out):
    projection = encoded(few_dots, out, size=2).projection
    train, _ = Demonstrations.read(few_dots).split(0.2, 0)
    pictures = together(train, "camera").astype(float)
    rows = np.concatenate([pictures.mean((1, 2)), pictures[:, : SIZE // 2].mean((1, 2))], 1)
    np.testing.assert_allclose(projection.mean, rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(np.abs(projection.components), np.abs(PCA(2).fit(rows).components_), atol=1e-4)


@pytest.mark.parametrize(("encoder", "size"), [(MEANS, None), (MEANS, 3), (PLACES, None)])
def test_a_picture_that_is_seen_while_acting(few_dots, out, encoder, size):
    about = encoded(few_dots, out, encoder, size=size).about
    assert (about.features, about.size < 5) == ({MEANS: 4, PLACES: 80}[encoder], True)
    loaded, pictures = load(out, allow_code=True), together(Demonstrations.read(few_dots), "camera")
    one_by_one = np.stack([loaded(picture) for picture in pictures])
    assert one_by_one.dtype == np.float32
    stored = together(Demonstrations.read(out), "camera_features")
    np.testing.assert_allclose(one_by_one, stored, rtol=1e-4, atol=1e-5)
    says = r"camera: is float64 \(20, 20, 2\); this encoder reads uint8 \(20, 20, 2\)"
    with pytest.raises(BadInput, match=says):
        loaded(pictures[0] / 255)


def test_a_second_camera_is_encoded_by_a_second_call(tmp_path, out):
    demos = followed(4)
    cameras = [dict.fromkeys(("camera", "wrist"), demo.observations["camera"]) for demo in demos]
    pairs = zip(demos, cameras, strict=True)
    both = [Demonstration(demo.name, own, demo.actions) for demo, own in pairs]
    Demonstrations(tuple(both)).write(tmp_path / "both.hdf5")
    encoded(tmp_path / "both.hdf5", tmp_path / "first.hdf5", size=1)
    encode(tmp_path / "first.hdf5", out, "wrist", MEANS, size=2, allow_code=True)
    for key, size in (("camera_features", 1), ("wrist_features", 2)):
        encoder = load(out, key, allow_code=True)
        stored = Demonstrations.read(out)[0].observations[key][0]
        np.testing.assert_allclose(encoder(both[0].observations["camera"][0]), stored, rtol=1e-4)
        assert encoder.about.size == size
    with pytest.raises(
        BadInput, match="there is no encoder of one observation alone; there is: camera_features, wrist_f"
    ):
        load(out)


def test_models_of_timm(monkeypatch):
    """Of a picture of the size that the model was trained with: what timm's own preprocessing gives."""
    timm, pil = pytest.importorskip("timm"), pytest.importorskip("PIL.Image")
    torch.manual_seed(0)
    network = timm.create_model("resnet18.a1_in1k", pretrained=False, num_classes=0).eval()
    monkeypatch.setattr(timm, "create_model", lambda name, *, pretrained, num_classes: network)
    backbone = Backbone("timm:resnet18.a1_in1k")
    pictures = np.random.default_rng(0).integers(0, 256, (2, 224, 224, 3), dtype=np.uint8)
    settings = timm.data.resolve_model_data_config(network) | {"crop_pct": 1.0}
    prepare = timm.data.create_transform(**settings, is_training=False)
    with torch.no_grad():
        expected = network(torch.stack([prepare(pil.fromarray(picture)) for picture in pictures])).numpy()
    np.testing.assert_allclose(backbone(pictures), expected, rtol=1e-4, atol=1e-5)
    assert backbone.try_out(pictures[:, ::3, ::2]) == 512


def test_the_command(few_dots, out):
    options = ("--observation", "camera", "--encoder", MEANS, "--allow-code", "--size", 3)
    arguments = ("encode", few_dots, *options)
    ended = done(*arguments, "--out", out)
    assert ended.out.startswith(f"{out}: obs/camera_features: 3 of 4 features, ")
    before = out.read_bytes()
    other = call(*arguments, "--out", out)
    assert (other.status, out.read_bytes()) == (2, before)
    assert f"{out}: is there already; remove it, or choose another --out" in other.err
    assert [path.name for path in out.parent.iterdir()] == ["out.hdf5"]


# --- what cannot be encoded ---------------------------------------------------------------------------------


OWN = "user_encoders:"


NO_KEY = "there is no observation 'camra' (did you mean 'camera'?); pictures are: camera"
MANY = "--size 129: encoder 'user_encoders:means' gives 4 features of 35 training pictures; take"
NO_ENCODER = "there is no encoder 'resnet18'; take timm:NAME, such as timm:resnet18.a1_in1k"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--observation", "camra"], NO_KEY),
        (["--size", "129"], MANY),
        (["--size", "60", "--encoder", PLACES], "gives 80 features of 35 training pictures; take at most 35"),
        (["--as", "place"], "obs/place is there already; choose another name with --as"),
        (["--encoder", "resnet18"], NO_ENCODER),
        (["--encoder", "no_such_module:encoder"], "cannot be loaded: No module named 'no_such_module'"),
        (["--encoder", f"{OWN}raises"], "fails on pictures [8, 20, 20, 2]: expected 224 x 224 pixels"),
        (["--encoder", f"{OWN}not_finite"], "gives features that are NaN or infinite"),
        (["--encoder", f"{OWN}noisy"], "gives other features when it is called again"),
        (["--encoder", f"{OWN}together"], "gives other features of a picture among others than alone"),
    ],
)
def test_what_cannot_be_used(few_dots, out, options, message):
    given = ["--observation", "camera", "--encoder", MEANS, "--allow-code", *options]
    refused(message, "encode", few_dots, *given, "--out", out)
    assert not list(out.parent.iterdir())


def test_timm_is_an_extra(few_dots, out, monkeypatch):
    monkeypatch.setitem(sys.modules, "timm", None)
    asked = ["--observation", "camera", "--encoder", "timm:resnet18.a1_in1k"]
    refused("pip install 'ddco-pyro[timm]'", "encode", few_dots, *asked, "--out", out)


def test_features_that_only_later_pictures_spoil(tmp_path, out):
    demos = followed(2)
    demos[1].observations["camera"][:] = 255
    demos.write(tmp_path / "bright.hdf5")
    with pytest.raises(BadInput, match="gives features that are NaN or infinite in float32"):
        encoded(tmp_path / "bright.hdf5", out, f"{OWN}later_not_finite")
    assert not out.exists()


def test_user_code_needs_permission(few_dots, out):
    asked = ["--observation", "camera", "--encoder", MEANS]
    refused("would import user code; pass --allow-code", "encode", few_dots, *asked, "--out", out)
    encoded(few_dots, out)
    with pytest.raises(BadInput, match="would import user code"):
        load(out)


def test_a_damaged_encoder(few_dots, out):
    encoded(few_dots, out)
    with h5py.File(out, "r+") as file:
        file["encoders/camera_features"].attrs["about"] = "{}"
    says = r"out\.hdf5: /encoders/camera_features is damaged .* encode the file again"
    with pytest.raises(BadInput, match=says):
        load(out, allow_code=True)
    with pytest.raises(BadInput, match="there is no encoder of one observation alone; there is: none"):
        load(few_dots)
