"""What cannot be encoded is one clear line with exit code 2, and nothing is written."""

from __future__ import annotations

import json

import pytest
from command_line import call
from dots import followed

from ddco_pyro.data.files import Damaged
from ddco_pyro.encoding import Encoding, encode, load
from ddco_pyro.errors import BadInput

OWN = "user_encoders:"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.hdf5"


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
    ended = call("encode", few_dots, "--observation", "camera", "--allow-code", *options, "--out", out)
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert message in ended.err
    assert not list(out.parent.iterdir())


def test_what_was_not_written_here_stays(few_dots, out):
    out.write_bytes(b"mine")
    assert call("encode", few_dots, "--observation", "camera", "--out", out).status == 2
    assert out.read_bytes() == b"mine"
    out.unlink()
    out.mkdir()
    ended = call("encode", few_dots, "--observation", "camera", "--out", out)
    assert (ended.status, ended.err) == (2, f"ddco-pyro: --out {out}: is a folder; name a file\n")
    out.rmdir()
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
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert "would import user code; pass --allow-code" in ended.err
    assert not list(out.parent.iterdir())
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
