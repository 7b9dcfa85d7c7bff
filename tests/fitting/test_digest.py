"""A run folder knows its demonstrations: what goes on from it, or shows it, refuses others in one line."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from command_line import call, done
from killing import Interrupting
from odd_files.hdf5 import instead
from selecting import DATA, data_at, two_skills

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting import digest as fitted_to
from ddco_pyro.fitting.digest import difference, digest
from ddco_pyro.spec import Spec, parse_spec

REFUSED = (
    "{folder}: is a run of other demonstrations ({what}); bring back those that it was fitted to, or choose "
    "another --out for these"
)


def labelled() -> Demonstrations:
    """With a label that is used, one that is not, and a mask."""
    demos = two_skills()
    labels = [
        {"phase": (np.arange(len(one)) > 3).astype(int), "other": np.zeros(len(one), int)} for one in demos
    ]
    records = tuple(replace(one, labels=own) for one, own in zip(demos, labels, strict=True))
    return Demonstrations(records, {"valid": demos.names[:3], "few": demos.names[:2]})


def spec_of(path: Path, **training: object) -> Spec:
    data = {key: value for key, value in DATA.items() if key != "selection"}
    return parse_spec(
        {
            **data,
            "demonstrations": {"path": str(path), "labels": "phase"},
            "compare_with": [{"kind": "flat", "policy": {"network": "linear"}}],
            "training": {**DATA["training"], "epochs": 4, **training},
        }
    )


def edited(path: Path, edit: Callable[[h5py.File], object]) -> None:
    with h5py.File(path, "r+") as file:
        edit(file)


OBS = "data/demo_4/obs"


def both_of(file: h5py.File) -> None:
    for key in ("place", "turn"):
        file[f"{OBS}/{key}"][0, 0] = 7.0


def renamed(file: h5py.File) -> None:
    for n in (4, 5):
        file.move(f"data/demo_{n}", f"data/new_{n}")


CHANGES: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "a control": (lambda file: file["data/demo_4/actions"].write_direct(np.ones((9, 2))), "actions changed"),
    "an observation": (lambda file: file[f"{OBS}/turn"].__setitem__((0, 0), 7.0), "obs/turn changed"),
    "two observations": (both_of, "obs/place and obs/turn changed"),
    "a label": (lambda file: file["data/demo_4/labels/phase"].__setitem__(0, 5), "labels/phase changed"),
    "the mask": (lambda file: instead(file, "mask/valid", [b"demo_7"]), "mask/valid changed"),
    "no mask": (lambda file: file.__delitem__("mask/valid"), "mask/valid changed"),
    "one more": (lambda file: file.copy("data/demo_4", file["data"], "demo_99"), "demo_99 is new"),
    "others": (renamed, "demo_4 and 1 more are missing and new_4 and 1 more are new"),
}
"""What of a file changes, and how that is said."""

SAME: tuple[Callable[[h5py.File], object], ...] = (
    lambda file: file["data/demo_4/labels/other"].__setitem__(0, 5),  # a label that is not used
    lambda file: instead(file, "mask/few", [b"demo_7"]),
    lambda file: file.__setitem__("data/demo_4/obs/more", np.zeros((9, 1))),
    lambda file: instead(file, "data/demo_4/obs/turn", file["data/demo_4/obs/turn"][()].astype(np.float32)),
)
"""What makes no difference to a fit: turns are 1 and -1 in any type."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spec, its demonstrations, their run, and one that was interrupted; nobody changes them."""
    folder = tmp_path_factory.mktemp("finished")
    labelled().write(folder / "demos.hdf5")
    ddco_pyro.fit(spec_of(folder / "demos.hdf5"), out=folder / "run")
    with pytest.raises(KeyboardInterrupt):
        ddco_pyro.fit(spec_of(folder / "demos.hdf5"), out=folder / "interrupted", on_event=Interrupting(2))
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def changing(finished: Path):
    """The same folder, whose file may be changed by a test; it is brought back."""
    before = (finished / "demos.hdf5").read_bytes()
    yield finished
    (finished / "demos.hdf5").write_bytes(before)


@pytest.mark.parametrize("change", CHANGES)
def test_a_run_of_a_file_that_has_changed_is_not_continued(changing: Path, change: str) -> None:
    edit, what = CHANGES[change]
    edited(changing / "demos.hdf5", edit)
    before = contents(changing)
    for name in ("run", "interrupted"):
        with pytest.raises(BadInput) as refused:
            ddco_pyro.fit(changing / name / "spec.yaml", out=changing / name)
        assert str(refused.value) == REFUSED.format(folder=changing / name, what=what)
    assert contents(changing) == before


def test_a_run_of_a_file_that_has_changed_is_not_shown(changing: Path) -> None:
    edit, what = CHANGES["a control"]
    edited(changing / "demos.hdf5", edit)
    run, before = changing / "run", contents(changing)
    for folder, command in (
        (run, ["fit", run / "spec.yaml", "--out", run, "--resume"]),
        (run, ["report", run]),
        (run / "baselines" / "flat", ["report", run / "baselines" / "flat"]),
        (run, ["compare", run, run / "baselines" / "flat", "--out", changing / "compared"]),
    ):
        assert call(*command) == (2, "", f"ddco-pyro: {REFUSED.format(folder=folder, what=what)}\n")
    assert contents(changing) == before


def test_what_makes_no_difference_is_not_refused(changing: Path, tmp_path: Path) -> None:
    for edit in SAME:
        edited(changing / "demos.hdf5", edit)
    run = shutil.copytree(changing / "interrupted", tmp_path / "run")
    ddco_pyro.fit(run / "spec.yaml", out=run)
    assert (run / "model.safetensors").read_bytes() == (changing / "run" / "model.safetensors").read_bytes()


def test_a_selection_of_a_file_that_has_changed_is_not_continued(tmp_path: Path) -> None:
    """Its labels too, which no score depends on, but the fit of what is chosen does."""
    data = data_at(tmp_path, labelled())
    data["demonstrations"] |= {"labels": "phase"}
    data["selection"] = {"folds": 2, "grid": {"training.epochs": [1, 2]}}
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(data))
    command = ("select", tmp_path / "spec.yaml", "--out", tmp_path / "run", "--jobs", "1")
    done(*command)
    edited(tmp_path / "demos.hdf5", CHANGES["a label"][0])
    before = contents(tmp_path)
    says = REFUSED.format(folder=tmp_path / "run", what="labels/phase changed")
    assert call(*command, "--resume")[::2] == (2, f"ddco-pyro: {says}\n")
    assert contents(tmp_path) == before


def test_a_run_of_another_version_is_to_be_fitted_again(finished: Path, tmp_path: Path) -> None:
    said = "this run was written by version 2 of the run folder's format, and version 5 is read here"
    for name in ("run", "interrupted"):
        run = shutil.copytree(finished / name, tmp_path / name)
        digest = json.loads((run / "demonstrations.json").read_text()) | {"format": 2}
        (run / "demonstrations.json").write_text(json.dumps(digest))
        if name == "run":  # whose spec has other keys
            (run / "spec.yaml").write_text("a_former_key: 1\n" + (run / "spec.yaml").read_text())
        command = ("report", run) if name == "run" else ("fit", run / "spec.yaml", "--out", run, "--resume")
        assert call(*command) == (2, "", f"ddco-pyro: {run}: {said}: fit again\n")


def test_the_digest_sees_every_number() -> None:
    first, second = two_skills(3), two_skills(3)
    assert difference(digest(first), digest(second)) == ""
    second[2].observations["place"][1, 0] = np.nextafter(second[2].observations["place"][1, 0], 2)
    assert difference(digest(first), digest(second)) == "obs/place changed"
    backwards = Demonstrations(first.demonstrations[::-1])
    assert difference(digest(first), digest(backwards)) == "their order differs"


def test_pictures_are_read_once_and_again_where_their_file_changed(few_dots: Path, tmp_path, monkeypatch):
    """What is in the file decides, not when it was written: a copy is the same, an edit is not."""
    read = []
    monkeypatch.setattr(fitted_to, "blocks", lambda array: read.append(array) or [np.asarray(array)])

    def pictures(path: Path, known: fitted_to.Digest | None) -> tuple[fitted_to.Digest, int]:
        read.clear()
        found = digest(Demonstrations.read(path), known)
        return found, sum(not isinstance(array, np.ndarray) for array in read)

    kept, number = pictures(few_dots, None)
    assert number == len(kept.files) * 6 > 0
    every = number
    again, number = pictures(few_dots, kept)
    assert (again, number) == (kept, 0)
    path = Path(shutil.copyfile(few_dots, tmp_path / "copy.hdf5"))
    copied, number = pictures(path, kept)
    assert (difference(kept, copied), number) == ("", every)
    edited(path, lambda file: file["data/demo_3/obs/camera"].__setitem__((0, 0, 0, 0), 9))
    assert difference(copied, pictures(path, copied)[0]) == "obs/camera changed"
