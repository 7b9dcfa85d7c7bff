"""The notebooks: pairs that say the same, with outputs, without logic, and runnable from a fresh clone."""

import ast
import importlib
import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from killing import HANGS
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
QUICK = ("06_pushing",)
SMALL = "demonstrations.count=12 demonstrations.seed=0 training.epochs=4 selection.folds=2"


def sources(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def test_every_one_is_a_pair_and_has_its_number():
    names = [path.stem for path in NOTEBOOKS]
    assert names == sorted(path.stem for path in (ROOT / "notebooks").glob("*.py"))
    assert [name[:2] for name in names] == [f"{number:02d}" for number in range(1, len(names) + 1)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_pair_says_the_same(path):
    assert sources(nbformat.read(path, as_version=4)) == sources(jupytext.read(path.with_suffix(".py")))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_outputs_and_no_logic(path):
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    drawn = {"image/png", "image/svg+xml"}
    assert any(drawn & {*output.get("data", {})} for cell in code for output in cell.outputs)
    assert not any(output.output_type == "error" for cell in code for output in cell.outputs)
    tree = ast.parse("\n".join(cell.source for cell in code))
    assert not any(isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Lambda) for node in ast.walk(tree))
    assert not re.search(r"/(home|root|tmp|work)/", path.read_text())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_imports_of_the_library_is_there(path):
    for node in ast.walk(ast.parse(path.with_suffix(".py").read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("ddco_pyro"):
            module = importlib.import_module(node.module)
            assert [one.name for one in node.names if not hasattr(module, one.name)] == []


MARKS = {path: () if path.stem in QUICK else pytest.mark.slow for path in NOTEBOOKS}


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem, marks=own) for path, own in MARKS.items()])
def test_each_runs_on_small_data_from_a_fresh_clone(path, tmp_path, cache, monkeypatch):
    """No data of anybody else's lies beside the repository; fits are made anew."""
    own = {"NOTEBOOK_RUNS": str(tmp_path / "runs"), "NOTEBOOK_METAWORLD": str(tmp_path / "none")}
    own["MUJOCO_GL"] = "egl"
    for name, value in (own | {"NOTEBOOK_SMALLER": SMALL}).items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=HANGS, resources={"metadata": {"path": str(path.parent)}}).execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
