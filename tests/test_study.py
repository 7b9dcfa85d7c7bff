"""A study of toy cells: what is done, kept and written, and by which words that can be had again."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from cells import Cell, Settings, described
from study import Study

from ddco_pyro.errors import BadInput, Failed

DEFAULTS = Settings({"episodes": 3, "noise": 0.5}, Path("unused"))


@dataclass(frozen=True)
class Toy(Cell):
    """Says what it was given."""

    script = "provenance.py"  # any that there is

    task: str
    seed: int

    def results(self, settings, folder):
        if self.task == "impossible":
            raise Failed("it cannot be done")
        if self.task == "bad":
            raise BadInput("bad input")
        done = settings.runs / "done"
        done.parent.mkdir(parents=True, exist_ok=True)
        with done.open("a") as file:
            file.write(f"{self.name}\n")
        return {"product": self.seed * settings.values["noise"], "folder": folder.name}


SHOWN = SimpleNamespace(
    summarize=lambda cells: {cell["task"]: cell["product"] for cell in cells},
    page=lambda summary, made_by: f"{made_by}\n{summary}\n",
    draw=lambda summary, path: path.write_text("a picture"),
)


def run(monkeypatch, tmp_path, words):
    """Run it with these words; what has been done so far."""
    monkeypatch.setattr("sys.argv", ["toy.py", *words, "--runs", f"{tmp_path}/runs", "--out", f"{tmp_path}/out"])
    parser = described("A toy.")
    parser.add_argument("--tasks", nargs="*", default=["a", "b"])
    parser.add_argument("--seed", type=int, default=4)
    simulator = SimpleNamespace(made=lambda: None)

    def chosen(own):
        return [Toy(task, own.seed) for task in own.tasks]

    Study("toy", ("tasks", "seed"), chosen, lambda _: simulator, SHOWN, DEFAULTS, jobs=1).main(parser)
    return (tmp_path / "runs" / "done").read_text().split()


def test_cells_are_done_once_and_by_the_words_on_the_page_again(tmp_path, monkeypatch):
    assert run(monkeypatch, tmp_path, ["--noise", "0.25", "--set", "a=1"]) == ["a-4", "b-4"]
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert written["results"] == {"a": 1.0, "b": 1.0}
    page = (tmp_path / "out" / "summary.md").read_text()
    command = "python studies/toy.py --tasks a b --seed 4 --episodes 3 --noise 0.25 --set 'a=1'"
    assert page.startswith(f"Made by `{command}` at commit")
    assert (tmp_path / "out" / "toy.png").exists()
    assert run(monkeypatch, tmp_path, shlex.split(command)[2:]) == ["a-4", "b-4"]
    assert (tmp_path / "out" / "summary.md").read_text() == page
    assert run(monkeypatch, tmp_path, ["--noise", "0.5"]) == ["a-4", "b-4"] * 2
    assert len(list((tmp_path / "runs" / "cells").iterdir())) == 2


@pytest.mark.parametrize(("task", "line", "status"), [("impossible", "it cannot be done", 1), ("bad", "bad input", 2)])
def test_what_cannot_be_done_is_one_line(tmp_path, monkeypatch, capsys, task, line, status):
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, tmp_path, ["--tasks", task])
    assert (ended.value.code, capsys.readouterr().err.splitlines()[-1]) == (status, line)
    assert not (tmp_path / "out").exists()


def test_a_study_without_cells_says_so(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, tmp_path, ["--tasks"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "toy.py: there is nothing to do: a list or a number is empty or 0\n"


def test_a_cell_by_itself_is_the_studys(tmp_path, monkeypatch, capsys):
    run(monkeypatch, tmp_path, ["--tasks", "a", "--noise", "0.25"])
    capsys.readouterr()
    command = Toy("a", 4).command(Settings({"episodes": 3, "noise": 0.25}, tmp_path))
    assert command == "python studies/provenance.py a 4 --episodes 3 --noise 0.25"
    monkeypatch.setattr("sys.argv", [*shlex.split(command)[1:], "--runs", f"{tmp_path}/runs"])
    Toy.main("A cell.", DEFAULTS)
    assert json.loads(capsys.readouterr().out)["results"]["product"] == 1.0
    assert (tmp_path / "runs" / "done").read_text() == "a-4\n"
