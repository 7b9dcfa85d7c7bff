"""A study of toy cells: what is done, kept and written; intervals against simulation and cases worked by hand."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cells
import numpy as np
import pytest
import study
from cells import Cell, Settings, described
from table import RESULTS, Row, add, over_seeds, read, shown, spread

from ddco_pyro.errors import BadInput, Failed

DEFAULTS = Settings({"episodes": 3, "noise": 0.5}, Path("unused"))


@dataclass(frozen=True)
class Toy(Cell):
    """Says what it was given."""

    script = "toy.py"

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
        return {"product": self.seed * settings.values["noise"]}

    def rows(self, results):
        yield Row("toy", self.task, "ddco", None, self.seed, "product", results["product"])


def run(monkeypatch, tmp_path, words):
    """Run it with these words; what has been done so far."""
    monkeypatch.setattr("sys.argv", ["toy.py", *words, "--runs", f"{tmp_path}/runs", "--out", f"{tmp_path}/toy.csv"])
    parser = described("A toy.")
    parser.add_argument("--tasks", nargs="*", default=["a", "b"])
    study.main("toy", parser, DEFAULTS, lambda own: [Toy(task, seed) for task in own.tasks for seed in (2, 4)])
    return (tmp_path / "runs" / "done").read_text().split()


def test_cells_are_done_once_and_their_numbers_are_in_the_table(tmp_path, monkeypatch, capsys):
    add(tmp_path / "toy.csv", [Row("toy", "old", "ddco", 10, 0, "product", 7.0)])
    whole = ["a-2", "a-4", "b-2", "b-4"]
    assert run(monkeypatch, tmp_path, ["--noise", "0.25", "--set", "a=1"]) == whole
    assert [row[1:] for row in read(tmp_path / "toy.csv")] == [
        ("old", "ddco", 10, 0, "product", 7.0),
        *((task, "ddco", None, seed, "product", 0.25 * seed) for task in "ab" for seed in (2, 4)),
    ]
    # t(0.975, 1) = 12.7062 times the standard error 0.25
    assert "| toy | a | ddco |  | 0.75 [-2.43, 3.93] |" in capsys.readouterr().out
    assert run(monkeypatch, tmp_path, ["--noise", "0.25", "--set", "a=1"]) == whole
    assert run(monkeypatch, tmp_path, ["--tasks", "a"]) == [*whole, "a-2", "a-4"]  # other settings
    assert [row.value for row in read(tmp_path / "toy.csv")] == [7.0, 1.0, 2.0, 0.5, 1.0]


@pytest.mark.parametrize(("task", "line", "status"), [("impossible", "it cannot be done", 1), ("bad", "bad input", 2)])
def test_what_cannot_be_done_is_one_line(tmp_path, monkeypatch, capsys, task, line, status):
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, tmp_path, ["--tasks", task])
    assert (ended.value.code, capsys.readouterr().err.splitlines()[-1]) == (status, line)
    assert not (tmp_path / "toy.csv").exists()


def test_a_study_without_cells_says_so(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, tmp_path, ["--tasks"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "toy.py: there is nothing to do: a list or a number is empty or 0\n"


def test_a_cell_by_itself_is_the_studys(tmp_path, monkeypatch, capsys):
    run(monkeypatch, tmp_path, ["--tasks", "a", "--noise", "0.25"])
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["toy.py", "a", "4", "--noise", "0.25", "--runs", f"{tmp_path}/runs"])
    Toy.main("A cell.", DEFAULTS)
    assert json.loads(capsys.readouterr().out)["product"] == 1.0
    assert (tmp_path / "runs" / "done").read_text() == "a-2\na-4\n"


def test_a_result_named_like_a_setting_is_refused(tmp_path):
    with pytest.raises(ValueError, match="results are named like settings: seed"):  # it would be done each time
        cells.kept(tmp_path / "cell.json", {"seed": 3}, lambda: {"seed": [1.0]})


def test_intervals_hold_the_mean_in_95_percent_of_studies():
    random, draws = np.random.default_rng(0), 4000
    found = [over_seeds(values.tolist())["interval"] for values in random.normal(3.0, 0.5, (draws, 5))]
    held = np.mean([low <= 3.0 <= high for low, high in found])
    assert abs(held - 0.95) < 3 * np.sqrt(0.95 * 0.05 / draws)


def test_a_single_seed_has_no_interval():
    assert spread(over_seeds([0.25]), "{:.0%}") == "25%"
    assert spread(over_seeds([]), "{:.0%}") == "-"
    assert shown([Row("a", "b", "c", 5, 0, "d", 0.5)]).endswith("| a | b | c | 5 | 0.5 |\n")


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.csv")), ids=lambda path: path.stem)
def test_a_table_is_tidy_and_is_written_as_it_is_read(path, tmp_path):
    rows = read(path)
    assert len({row[:-1] for row in rows}) == len(rows)
    add(tmp_path / "again.csv", rows)
    assert (tmp_path / "again.csv").read_text() == path.read_text()
    with path.open() as file:
        assert tuple(next(csv.reader(file))) == Row._fields
    assert path.with_suffix(".md").exists()
