"""What results say of the code that made them, in a small project of which every dependency is known."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import provenance
import pytest
from provenance import ROOT, code, outdated, record, records_of, results, sentence, sources, text, tree

COMMAND = "python benchmarks/study.py --seeds 2"
FILES = {
    "pyproject.toml": '[project.entry-points."ddco_pyro.tasks"]\n'
    'toy = "ddco_tasks.toy:task"\nother = "ddco_tasks.other:task"\n',
    "benchmarks/study.py": '"""A study of "other"."""\nimport helper\nimport json\nimport provenance\n'
    'from ddco_pyro import first\nSPEC = "toy"\n',
    "benchmarks/helper.py": "NAME = 'helped.json'\n",
    "benchmarks/helped.json": "{}",
    "benchmarks/unrelated.py": "",
    "studies/provenance.py": "import unrelated\n",
    "ddco_pyro/__init__.py": "",
    "ddco_pyro/first.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ddco_pyro.typed import T\n"
    "def run(x):\n    from ddco_pyro.room import second\n    return second\n",
    "ddco_pyro/typed.py": "",
    "ddco_pyro/unused.py": "",
    "ddco_pyro/report/__init__.py": "import ddco_pyro.unused\n",
    "ddco_pyro/room/__init__.py": "",
    "ddco_pyro/room/second.py": "from . import third\nfrom ..above import value\nimport ddco_pyro.report\n",
    "ddco_pyro/room/third.py": "",
    "ddco_pyro/above.py": "value = 1\n",
    "specs/toy.yaml": "demonstrations: {task: toy}\n",
    "specs/other.yaml": "task: other\n",
    "tasks/__init__.py": "",
    "tasks/toy.py": "scene = 'toy.xml'\nnothing = 'absent.xml'\n",
    "tasks/toy.xml": "<mujoco/>",
    "tasks/other.py": "",
    "tests/support/needed.py": "",
    "docs/results/study.md": f"Command: `{COMMAND}`\n\n| a |\n",
    "docs/results/study.json": "[1, 2]",
    "docs/results/README.md": "Not a result.\n",
}
DEPENDED_ON = [
    "benchmarks/helped.json",
    "benchmarks/helper.py",
    "benchmarks/study.py",
    "ddco_pyro/__init__.py",
    "ddco_pyro/above.py",
    "ddco_pyro/first.py",
    "ddco_pyro/room/__init__.py",
    "ddco_pyro/room/second.py",
    "ddco_pyro/room/third.py",
    "specs/toy.yaml",
    "tasks/__init__.py",
    "tasks/toy.py",
    "tasks/toy.xml",
]


@pytest.fixture
def project(tmp_path):
    """A project that is no git checkout."""
    for name, content in FILES.items():
        write(tmp_path, name, content)
    return tmp_path


def write(root, name, content):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def git(root, *arguments):
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    ended = subprocess.run(["git", "-C", root, *who, *arguments], check=True, capture_output=True, text=True)
    return ended.stdout.strip()


def commit(root):
    """Commit everything; the commit's short name."""
    git(root, "add", "-A")
    git(root, "commit", "-q", "--allow-empty", "-m", "all")
    return git(root, "rev-parse", "--short", "HEAD")


@pytest.fixture
def checkout(project):
    git(project, "init", "-q")
    commit(project)
    return project


# --- what a command depends on ----------------------------------------------------------------------------------------


def test_a_command_depends_on_what_its_script_imports_and_names(project):
    assert list(sources(tree(project), COMMAND)) == DEPENDED_ON


def test_a_command_may_name_specs_too(project):
    more = {"specs/other.yaml", "tasks/other.py"}
    assert set(sources(tree(project), f"{COMMAND} --specs other")) == {*DEPENDED_ON, *more}
    assert set(sources(tree(project), f"{COMMAND} specs/other.yaml")) == {*DEPENDED_ON, *more}


@pytest.mark.parametrize(
    ("name", "content", "same"),
    [
        ("ddco_pyro/above.py", '"""What this is."""\n\n# Why.\nvalue = (\n    1\n)\n', True),
        ("ddco_pyro/above.py", "value = 2\n", False),
        ("ddco_pyro/above.py", "value = True\n", False),
        ("ddco_pyro/above.py", "value = 1\nother = 1\n", False),
        ("tasks/toy.xml", "<mujoco model='toy'/>", False),
        ("specs/toy.yaml", "demonstrations: {task: toy, count: 3}\n", False),
        ("ddco_pyro/unused.py", "value = 2\n", True),
        ("ddco_pyro/typed.py", "value = 2\n", True),
        ("docs/results/study.md", "other", True),
    ],
)
def test_the_hash_changes_with_what_is_executed_alone(project, name, content, same):
    before = code(sources(tree(project), COMMAND))
    write(project, name, content)
    assert (code(sources(tree(project), COMMAND)) == before) is same


# --- what is written, and found out of date ---------------------------------------------------------------------------


def test_a_record_names_the_commit_and_whether_the_code_was_as_in_it(checkout):
    name = git(checkout, "rev-parse", "--short", "HEAD")
    expected = {
        "command": COMMAND,
        "commit": name,
        "dirty": False,
        "code": code(sources(tree(checkout), COMMAND)),
        "files": len(DEPENDED_ON),
    }
    assert record(COMMAND, checkout) == expected
    write(checkout, "docs/results/study.md", "new")  # a result that is being written is not code
    write(checkout, "ddco_pyro/unused.py", "new = 1")
    assert record(COMMAND, checkout) == expected
    write(checkout, "ddco_pyro/above.py", "value = 2")
    changed = record(COMMAND, checkout)
    assert (changed["commit"], changed["dirty"]) == (name, True)
    assert changed["code"] != expected["code"]


def test_a_record_without_git_has_the_hash_alone(project):
    one = record(COMMAND, project)
    assert (one["commit"], one["dirty"], one["code"]) == (None, None, code(sources(tree(project), COMMAND)))
    assert sentence(COMMAND, [one]) == f"Made by `{COMMAND}` at an unknown commit."


def test_results_older_than_their_code_are_named_with_the_number_of_changed_files(checkout):
    name = git(checkout, "rev-parse", "--short", "HEAD")
    write(checkout, "docs/results/study.json", text([1, 2], [record(COMMAND, checkout)]))
    assert outdated(checkout) == []
    write(checkout, "ddco_pyro/above.py", "value = 1  # as before\n")
    commit(checkout)
    assert outdated(checkout) == []
    write(checkout, "ddco_pyro/above.py", "value = 2\n")
    write(checkout, "ddco_pyro/room/third.py", "from ddco_pyro import unused\n")
    commit(checkout)
    files = len(DEPENDED_ON) + 1
    assert outdated(checkout) == [
        f"docs/results/study: older than its code: since commit {name} 3 of {files} files have changed"
    ]


def test_results_that_say_nothing_or_whose_script_is_gone_are_named(checkout):
    assert outdated(checkout) == ["docs/results/study: unknown: it does not say which code made it"]
    write(checkout, "docs/results/study.json", text([1, 2], [record(COMMAND, checkout)]))
    (checkout / "benchmarks/study.py").unlink()
    assert outdated(checkout) == ["docs/results/study: unknown: benchmarks/study.py is gone"]


# --- this project -----------------------------------------------------------------------------------------------------


def test_every_result_says_what_made_it():
    made = [result for result in results(ROOT) if result.is_relative_to(ROOT / "docs")]
    assert len(made) > 10
    assert [result for result in made if not records_of(result) or None in records_of(result)] == []
    for page in (ROOT / "docs" / "results").rglob("*.md"):
        if page.stem != "README":
            assert re.search(r"^Made by `[^`]+`.* commit [0-9a-f]{7,}", page.read_text(), re.MULTILINE), page


def test_the_check_is_a_warning(capsys, monkeypatch, project):
    monkeypatch.setattr(provenance, "ROOT", project)
    monkeypatch.setattr("sys.argv", ["provenance.py"])
    provenance.main()
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith("no git checkout: ")
    assert rest[1:] == ["  docs/results/study: unknown: it does not say which code made it"]


def test_the_check_imports_nothing_heavy():
    script = "import sys, provenance; print(*sys.modules)"
    folder = Path(provenance.__file__).parent
    said = subprocess.run([sys.executable, "-c", script], cwd=folder, check=True, capture_output=True, text=True).stdout
    assert "yaml" in said.split()
    assert not {"torch", "numpy", "ddco_pyro"} & set(said.split())
