"""A study of toy cells: what is done, kept and written."""

import csv
from dataclasses import dataclass
from pathlib import Path

import pytest

from ddco_pyro.data.files import only_one
from studies import study
from studies.page import RESULTS
from studies.statistics import COLUMNS, read_tidy
from studies.study import Cell, Row, Settings, add, described

DEFAULTS = Settings({"episodes": 3, "noise": 0.5}, Path("unused"))


@dataclass(frozen=True)
class Toy(Cell):
    """Says what it was given."""

    task: str
    seed: int

    @property
    def name(self):
        return f"{self.task}-{self.seed}"

    def results(self, settings, folder):
        done = settings.runs / "done"
        done.parent.mkdir(parents=True, exist_ok=True)
        with only_one(folder), done.open("a") as file:  # as a fit there does
            file.write(f"{self.name}\n")
        return {"product": self.seed * settings.values["noise"]}

    def rows(self, results):
        yield Row("toy", self.task, "ddco", None, self.seed, "product", results["product"])


def run(monkeypatch, tmp_path, words):
    """Run it with these words; what has been done so far."""
    places = ("--runs", f"{tmp_path}/runs", "--out", f"{tmp_path}/toy.csv")
    monkeypatch.setattr("sys.argv", ["toy.py", *words, *places])
    parser = described("A toy.")
    parser.add_argument("--tasks", nargs="*", default=["a", "b"])
    study.main(
        "toy", parser, DEFAULTS, lambda own: [Toy(task, seed) for task in own.tasks for seed in (2, 4)]
    )
    return (tmp_path / "runs" / "done").read_text().split()


def test_cells_are_done_once_and_their_numbers_are_in_the_table(tmp_path, monkeypatch, capsys):
    add(tmp_path / "toy.csv", [Row("toy", "old", "ddco", 10, 0, "product", 7.0)])
    whole = ["a-2", "a-4", "b-2", "b-4"]
    assert run(monkeypatch, tmp_path, ["--noise", "0.25"]) == whole
    assert [row[1:] for row in read_tidy(tmp_path / "toy.csv").itertuples(index=False)] == [
        ("old", "ddco", "10", "0", "product", 7.0),
        *((task, "ddco", "", str(seed), "product", 0.25 * seed) for task in "ab" for seed in (2, 4)),
    ]
    assert "toy.csv: has the numbers of 4 cells" in capsys.readouterr().out
    assert run(monkeypatch, tmp_path, ["--noise", "0.25"]) == whole
    assert run(monkeypatch, tmp_path, ["--tasks", "a"]) == [*whole, "a-2", "a-4"]  # other settings
    assert [*read_tidy(tmp_path / "toy.csv").value] == [7.0, 1.0, 2.0, 0.5, 1.0]


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.csv")), ids=lambda path: path.stem)
def test_a_table_is_tidy_and_is_written_as_it_is_read(path, tmp_path):
    table = read_tidy(path)
    assert not table.duplicated(COLUMNS[:-1]).any()
    add(tmp_path / "again.csv", table.itertuples(index=False))
    assert (tmp_path / "again.csv").read_text() == path.read_text()
    with path.open() as file:
        assert next(csv.reader(file)) == COLUMNS == [*Row._fields]
    assert any((folder / f"{path.stem}.md").exists() for folder in (RESULTS, RESULTS.parent))
