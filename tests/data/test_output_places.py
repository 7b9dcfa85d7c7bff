"""Outputs are places: what may be written is asked for all outputs of a command before it does anything."""

import os
import shlex
import shutil
from pathlib import Path
from typing import NamedTuple

import h5py
import pytest
import toy_task
from command_line import call, done, refused
from odd_files import snapshot
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.training.data import demonstrations as of


@pytest.fixture(scope="module")
def inputs(toy_run, tmp_path_factory) -> Path:
    """What commands read, and odd places beside it."""
    folder = tmp_path_factory.mktemp("inputs")
    demonstrations(6).write(folder / "demos.hdf5")
    shutil.copytree(toy_run.folder, folder / "run")
    (folder / "toy.yaml").write_text(toy_task.SPEC.replace("task: toy", "task: toy\nseed: 1"))
    (folder / "folder").mkdir()
    (folder / "file").write_text("x")
    os.mkfifo(folder / "pipe")
    for name in ("demos.hdf5", "toy.yaml"):
        (folder / f"link-{name}").symlink_to(folder / name)
        (folder / f"hard-{name}").hardlink_to(folder / name)
    (folder / "link-run").symlink_to(folder / "run")
    (folder / "loop").symlink_to(folder / "loop")
    (folder / "linked").mkdir()
    for name in ("file", "folder", "linked"):
        (folder / "linked" / name).symlink_to(folder / name)
    return folder


class Command(NamedTuple):
    """Arguments before the place that is written, an input that it must not be, whether it is a folder."""

    arguments: str
    read: str
    folder: bool = False


WITHIN = "lies in {}, which this command reads"
ENCODED = "encode demos.hdf5 --observation camera --encoder timm:resnet18.a1_in1k --out"
COMMANDS = {
    "segment --csv": Command("segment run demos.hdf5 --csv", "demos.hdf5"),
    "segment of links --csv": Command("segment run linked --csv", "linked"),
    "segment --out": Command("segment run demos.hdf5 --out", "demos.hdf5"),
    "segment --elan": Command("segment run demos.hdf5 --elan", "run", folder=True),
    "export": Command("export run --out", "run", folder=True),
    "compare": Command("compare run run/baselines/flat --out", "run", folder=True),
    "fit": Command("fit toy.yaml --out", "toy.yaml", folder=True),
    "collect": Command("collect toy.yaml --out", "toy.yaml"),
    "init": Command("init demos.hdf5 --force --out", "demos.hdf5"),
    "encode": Command(ENCODED, "demos.hdf5"),
    "import": Command("import demos.hdf5 --out", "demos.hdf5"),
}

READ = "is what this command reads"
LONG = "x" * 300
NOWHERE = {
    "": "the name is empty; name a place",
    "a\0b": "is no name for a file",
    "a\nb": "is no name for a file",
    LONG: "File name too long",
    f"new/{LONG}": "File name too long",
    "file/below": "Not a directory",
    "loop": "Too many levels of symbolic links",
    "/proc/new": "cannot be written",
}
NO_FILE = {
    "folder": "is a folder; name a file",
    "folder/": "names a folder; name a file",
    "pipe": "is no regular file",
    "/dev/null": "is no regular file",
    ".": "names a folder; name a file",
    "x" * 240: "File name too long",  # that of the temporary file is
}
NO_FOLDER = {"file": "is a file; name a folder", "pipe": "is a file; name a folder"}


def places(command: Command) -> dict[str, str]:
    if command.read == "run":
        return NOWHERE | NO_FOLDER | dict.fromkeys(["run/new", "link-run/new"], WITHIN.format("run"))
    if command.read == "linked":
        return {"file": READ, "folder/new": WITHIN.format("linked")}
    of_run = dict.fromkeys(("run/model.safetensors", "run/new", "link-run/spec.yaml"), WITHIN.format("run"))
    read = dict.fromkeys((command.read, f"link-{command.read}", f"hard-{command.read}"), READ)
    read |= of_run if command.arguments.startswith("segment") else {}
    return NOWHERE | (NO_FOLDER if command.folder else NO_FILE | read)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_bad_place_is_refused_before_anything_is_done(inputs: Path, monkeypatch, name: str) -> None:
    monkeypatch.chdir(inputs)
    before = snapshot(inputs)
    for place, says in places(COMMANDS[name]).items():
        refused(says, *COMMANDS[name].arguments.split(), place)
    assert snapshot(inputs) == before


@pytest.mark.parametrize("second", ["a", "./a", "link"])
def test_two_outputs_of_one_name_are_refused(inputs: Path, tmp_path: Path, monkeypatch, second: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to("a")
    given = ("segment", inputs / "run", inputs / "demos.hdf5")
    says = f"--csv {Path(second)}: is also where --html is written; choose another place"
    refused(says, *given, "--html", "a", "--csv", second)
    refused("--elan new: and --csv new/a lie in one another", *given, "--csv", "new/a", "--elan", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


# --- what is there already ----------------------------------------------------------------------------------


@pytest.fixture
def file(toy_spec, tmp_path: Path) -> Path:
    path = tmp_path / "demos.hdf5"
    of(toy_spec).write(path)
    return path


def test_a_link_is_kept(toy_run, file: Path, tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "there.csv")
    ended = call("segment", toy_run.folder, file, "--html", tmp_path / "link.csv")
    assert (ended.status, ended.out) == (0, f"{tmp_path / 'link.csv'}\n")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "there.csv").read_text().startswith("<!doctype html>")


def test_no_file_but_a_labelled_copy_is_replaced(toy_run, file: Path, tmp_path: Path) -> None:
    """A file of somebody else, and a labelled copy of other demonstrations."""
    other, copy = tmp_path / "other.hdf5", tmp_path / "copy.hdf5"
    Demonstrations(Demonstrations.read(file, labels=["phase"]).demonstrations[:9]).write(other)
    done("segment", toy_run.folder, other, "--out", copy)
    for there in (other, copy):
        before = there.read_bytes()
        remedy = "choose another --out, or remove it"
        says = f"--out {there}: exists and is not a labelled copy of {file}; {remedy}"
        refused(says, "segment", toy_run.folder, file, "--out", there)
        assert there.read_bytes() == before


def test_a_labelled_copy_is_replaced(toy_run, file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.hdf5"
    done("segment", toy_run.folder, file, "--out", copy)
    with h5py.File(file, "r+") as opened:
        opened["data/demo_0"].attrs["note"] = "seen"
        opened["mask/exclude"] = [b"demo_1"]
    done("segment", toy_run.folder, file, "--out", copy)
    with h5py.File(copy) as opened:
        assert opened["data/demo_0"].attrs["note"] == "seen"
        assert opened["mask/exclude"][()].tolist() == [b"demo_1"]


def test_a_page_or_table_does_not_replace_demonstrations(toy_run, file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.hdf5"
    shutil.copy(file, other)
    for option in ("--html", "--csv", "--parquet"):
        refused(f"{option} {other}: is an HDF5 file", "segment", toy_run.folder, file, option, other)
    refused("is an HDF5 file, which this would replace", "init", file, "--force", "--out", other)
    assert other.read_bytes() == file.read_bytes()


def test_collect_takes_only_its_own_file_for_done(tmp_path: Path, cache) -> None:
    spec, out = tmp_path / "toy.yaml", tmp_path / "demos.hdf5"
    spec.write_text(toy_task.SPEC)
    for _ in range(2):
        assert done("collect", spec, "--out", out, "--set", "demonstrations.count=3").out == f"{out}\n"
    before = out.read_bytes()
    refused("is there already and does not hold these demonstrations", "collect", spec, "--out", out)
    assert out.read_bytes() == before
    demonstrations(12).write(out)
    refused("is there already and does not hold these demonstrations", "collect", spec, "--out", out)


# --- what is written ----------------------------------------------------------------------------------------


def test_a_name_that_is_a_formula_is_quoted_in_csv(toy_run, file: Path, tmp_path: Path) -> None:
    names = ["=cmd|' /C calc'!A0", "+1", "-2", "@SUM(A1)", "plain"]
    with h5py.File(file, "r+") as opened:
        for old, new in zip([*opened["data"]], names, strict=False):
            opened.move(f"data/{old}", f"data/{new.replace('/', '%')}")
    table = tmp_path / "a.csv"
    done("segment", toy_run.folder, file, "--csv", table)
    first = {line.split(",")[0] for line in table.read_text().splitlines()}
    assert {"'+1", "'-2", "'@SUM(A1)", "plain", "'=cmd|' %C calc'!A0"} <= first
    assert not [cell for cell in first if cell.startswith(("=", "+", "-", "@"))]


# --- what is said and what is asked for ---------------------------------------------------------------------


def test_a_rollout_asks_for_what_its_report_needs_first(toy_run, tmp_path: Path, monkeypatch) -> None:
    """Demonstrations that were moved are named before any episode is played; so is a report's bad place."""
    run, gone = shutil.copytree(toy_run.folder, tmp_path / "run"), tmp_path / "gone.hdf5"
    played: list[object] = []
    monkeypatch.setattr("ddco_pyro.fitting.rollouts.run_episodes", lambda *how: played.append(how))
    spec = (run / "spec.yaml").read_text()
    (run / "report.html").unlink(missing_ok=True)
    (run / "report.html").mkdir()
    refused(f"RUN {run}/report.html: is a folder; name a file", "rollout", run, "--episodes", 2)
    (run / "report.html").rmdir()
    (run / "spec.yaml").write_text(spec.replace("task: toy\n", "", 1).replace("path: null", f"path: {gone}"))
    refused(f"{gone}: there is no such file", "rollout", run, "--episodes", 2)
    assert not played


@pytest.mark.usefixtures("undecided")
def test_commands_are_printed_as_a_shell_takes_them(tmp_path: Path, monkeypatch) -> None:
    """Each is called again as it was printed, from a folder with an odd name."""
    folder = tmp_path / "it's $(odd)"
    folder.mkdir()
    monkeypatch.chdir(folder)
    demonstrations(6).write(folder / "a b.hdf5")
    said = call("inspect", "a b.hdf5").out.splitlines()[-1].partition("next: ")[2]
    assert shlex.split(said) == ["ddco-pyro", "init", "a b.hdf5", "--out", "a b.yaml"]
    said = call(*shlex.split(said)[1:]).out.partition("fit it with: ")[2]
    assert shlex.split(said) == ["ddco-pyro", "fit", "a b.yaml", "--out", "runs/a b"]
    said = Path("a b.yaml").read_text()
    assert "# Fit it:              ddco-pyro fit 'a b.yaml' --out runs/first\n" in said
    done("check", "a b.yaml")
