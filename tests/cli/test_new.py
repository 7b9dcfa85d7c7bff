"""From a file to a page in one command, on generated demonstrations whose skills are known."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import call, done, refused
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.data.planted import PHASES, pick_and_place
from ddco_pyro.training.data import train_and_valid


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """Demonstrations; beside them a spec as ``init`` writes it, with a budget of few epochs."""
    path = tmp_path_factory.mktemp("new") / "mine.hdf5"
    pick_and_place(12).write(path)
    spec = path.with_name("spec.yaml")
    done("init", path, "--out", spec)
    text = re.sub(r"epochs: \d+", "epochs: 6", spec.read_text())
    spec.write_text(re.sub(r"(?m)^compare_with:\n(  .*\n)*", "", text))
    return path


def quick(folder: Path, file: Path) -> None:
    folder.mkdir()
    shutil.copy(file.with_name("spec.yaml"), folder)


def test_one_command_makes_what_four_make(file: Path, tmp_path: Path) -> None:
    quick(tmp_path / "one", file)
    ended = done("new", file, "--out", tmp_path / "one")
    said = [line.split()[2] for line in ended.out.splitlines() if line.startswith("$ ddco-pyro ")]
    assert said == ["inspect", "fit", "segment"]  # the spec is there
    assert not re.findall("fit it with|^next: ", ended.out, re.MULTILINE)  # they are done already
    quick(tmp_path / "four", file)
    run = tmp_path / "four" / "run"
    done("fit", tmp_path / "four" / "spec.yaml", "--out", run)
    done("segment", run, file, "--html", tmp_path / "four" / "segments.html")
    one, four = (ddco_pyro.load(tmp_path / name / "run") for name in ("one", "four"))
    assert one.metrics.model_dump(exclude={"seconds"}) == four.metrics.model_dump(exclude={"seconds"})
    pages = [
        (tmp_path / name / "segments.html").read_text().replace(str(tmp_path / name), "")
        for name in ("one", "four")
    ]
    assert pages[0] == pages[1]
    before = (tmp_path / "one" / "run" / "model.safetensors").stat().st_mtime_ns
    done("new", file, "--out", tmp_path / "one")
    assert (tmp_path / "one" / "run" / "model.safetensors").stat().st_mtime_ns == before


def test_another_setting_of_the_report_draws_again_and_fits_nothing(file: Path, tmp_path: Path) -> None:
    quick(out := tmp_path / "out", file)
    spec, run = out / "spec.yaml", out / "run"
    done("new", file, "--out", out)
    before, text = (run / "model.safetensors").stat().st_mtime_ns, spec.read_text()
    spec.write_text(text.partition("report:")[0] + "report: {trajectory: goal}\n")
    done("new", file, "--out", out)
    assert "Drawings: observation “goal”." in (run / "report.html").read_text()
    done("report", run, "--set", "report.trajectory=[object, 0:2]")
    assert "Drawings: observation “object[0:2]”." in (run / "report.html").read_text()
    assert (run / "model.safetensors").stat().st_mtime_ns == before
    for change, message in {
        "report.trajectory=objekt": "there is no observation 'objekt' (did you mean 'object'?)",
        "report.trajectory=[object, 0:1]": "'object[0:1]' is 1 numbers",
        "seed=3": "is fitted; only settings of the report can change",
    }.items():
        refused(message, "report", run, "--set", change)
    assert [str(path) for path in ddco_pyro.load(run).spec.report.trajectory or ()] == ["object[0:2]"]
    assert call("report", run).status == call("new", file, "--out", out).status == 0
    spec.write_text(text + "seed: 3\n")
    assert "holds a run of another spec" in call("new", file, "--out", out).err


def test_a_folder_of_another_file_is_refused(file: Path, tmp_path: Path) -> None:
    quick(tmp_path / "out", file)
    other = tmp_path / "other.hdf5"
    pick_and_place(4).write(other)
    says = f"spec.yaml: is for {file}; choose another --out"
    ended = refused(says, "new", other, "--out", tmp_path / "out")
    ended = call("new", tmp_path / "none.hdf5", "--out", tmp_path / "new")
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_skills_are_found_and_named(tmp_path: Path) -> None:
    pick_and_place().write(tmp_path / "mine.hdf5")
    done("new", tmp_path / "mine.hdf5", "--out", tmp_path / "out")
    fit = ddco_pyro.load(tmp_path / "out" / "run")
    held_out = train_and_valid(fit.spec, fit.demonstrations)["valid"]
    (segments,) = fit.segment(held_out)
    phases = np.concatenate([demo.labels["phase"] for demo in held_out])
    assert normalized_mutual_info_score(phases, np.concatenate(segments)) > 0.8
    assert len(set(fit.names["option"]) & set(PHASES)) >= 3
