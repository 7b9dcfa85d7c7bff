"""User code (``module:name``) is imported only where allowed, and nothing before that is known."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import toy_task
import yaml
from command_line import call, refused, with_set

import ddco_pyro
from ddco_pyro.spec import SpecError, user_code, with_overrides
from ddco_pyro.training.data import demonstrations

MODULE = """
from pathlib import Path

(Path(__file__).parent / "imported").touch()
from user_networks import Own as Network
from toy_task import task
"""
TASK, NETWORK = "careless:task", "careless:Network"


@pytest.fixture
def imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that is there once the module ``careless``, which could be imported, has been."""
    (tmp_path / "careless.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "careless", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "imported"


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "toy.yaml"
    path.write_text(toy_task.SPEC)
    return path


OWN = f"{{network: '{NETWORK}'}}"
PLACES = [
    (f"task={TASK}", "task"),
    (f"demonstrations.task={TASK}", "demonstrations.task"),
    (f"hierarchy.levels.0.policy.network={NETWORK}", "hierarchy.levels.0.policy.network"),
    (f"hierarchy.meta_policy.network={NETWORK}", "hierarchy.meta_policy.network"),
    (
        f"hierarchy.meta_policy={{network: branches, of: {{offsets: {OWN}}}}}",
        "hierarchy.meta_policy.of.offsets.network",
    ),
    (f"compare_with=[flat, {{kind: flat, policy: {OWN}}}]", "compare_with.1.policy.network"),
    (f"selection.grid.task=[toy, '{TASK}']", "selection.grid.task"),
    (
        f"selection.grid.hierarchy.levels.0.policy.network=[mlp, '{NETWORK}']",
        "selection.grid.hierarchy.levels.0.policy.network",
    ),
    (f"selection.grid.hierarchy.levels=[[{{count: 1, policy: {OWN}}}]]", "selection.grid.hierarchy.levels"),
]
WORK = ["check", "collect", "fit", "select"]


CASES = [*(("check", *one) for one in PLACES), *((command, *PLACES[2]) for command in WORK[1:])]


@pytest.mark.parametrize(("command", "override", "place"), CASES, ids=lambda value: value)
def test_a_spec_that_names_code_is_refused(spec, imported: Path, command: str, override: str, place: str):
    name = TASK if place.endswith("task") else NETWORK
    before = sorted(imported.parent.iterdir())
    said = f"{spec}: {place}: would import user code ({name}); pass --allow-code if you trust it (in Python: "
    said += "allow_code"
    assert refused(said, command, spec, *with_set(override)).out == ""
    assert sorted(imported.parent.iterdir()) == before


@pytest.mark.parametrize("override", [PLACES[0][0], PLACES[1][0], PLACES[2][0]])
def test_what_is_allowed_is_imported(spec: Path, imported: Path, override: str) -> None:
    ended = call("check", spec, "--allow-code", *with_set(override, "demonstrations.seed=500"))
    assert (ended.status, ended.err) == (0, "")
    assert imported.exists()


# --- run folders --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "override"),
    [
        (("rollout", "RUN"), PLACES[0][0]),
        (("report", "RUN"), PLACES[2][0]),
        (("segment", "RUN", "DEMOS", "--csv", "a.csv"), PLACES[2][0]),
        (("export", "RUN", "--out", "controller"), PLACES[2][0]),
        (("compare", "RUN/baselines/flat", "RUN"), PLACES[2][0]),
    ],
    ids=lambda value: value[0],
)
def test_a_run_that_names_code_is_refused(
    toy_run: Any, toy_spec: Any, imported: Path, command: tuple[str, ...], override: str
) -> None:
    run, demos = imported.parent / "run", imported.parent / "demos.hdf5"
    shutil.copytree(toy_run.folder, run)
    demonstrations(toy_spec).write(demos)
    path, _, name = override.partition("=")
    (run / "spec.yaml").write_text(yaml.safe_dump(with_overrides(toy_spec, {path: name}).model_dump()))
    before = sorted(imported.parent.rglob("*"))
    ended = call(*(one.replace("RUN", str(run)).replace("DEMOS", str(demos)) for one in command))
    line = f"ddco-pyro: {run / 'spec.yaml'}: {path}: would import user code ({name}); pass --allow-code if "
    line += "you trust it"
    assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
    assert ended.err.startswith(line)
    with pytest.raises(SpecError, match="would import user code"):
        ddco_pyro.load(run)
    assert sorted(imported.parent.rglob("*")) == before


def test_a_baseline_in_a_run_that_names_code_which_the_run_does_not(
    toy_run: Any, toy_spec: Any, imported: Path
) -> None:
    run = imported.parent / "run"
    shutil.copytree(toy_run.folder, run)
    other = run / "baselines" / "flat" / "spec.yaml"
    baseline = {"kind": "flat", "policy": {"network": NETWORK}}
    other.write_text(yaml.safe_dump(yaml.safe_load(other.read_text()) | {"baseline": baseline}))
    refused(f"{other}: baseline.policy.network: would import user code ({NETWORK})", "report", run)
    assert not imported.exists()


# --- what is no user code -----------------------------------------------------------------------------------


def test_what_is_built_in_or_registered_is_no_user_code(toy_spec: Any) -> None:
    assert user_code(toy_spec) == {}
    assert user_code(with_overrides(toy_spec, {"task": "needle"})) == {}
    assert user_code(with_overrides(toy_spec, {"task": "toy_task:task"})) == {"task": "toy_task:task"}


@pytest.mark.slow
def test_the_working_folder_is_searched_only_where_code_is_allowed(spec: Path, tmp_path: Path) -> None:
    """Else what lies there could register itself, or stand in for an optional package that is missing."""
    folder = tmp_path / "hostile"
    about = folder / "careless-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "careless.py").write_text(MODULE)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: careless\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[ddco_pyro.tasks]\nharmless = careless:task\n")
    command = [Path(sys.executable).with_name("ddco-pyro"), "check", spec, *with_set("task=harmless")]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "no task is registered as 'harmless'" in ended.stderr
    assert not (folder / "imported").exists()
    ended = subprocess.run([*command, "--allow-code"], cwd=folder, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert (folder / "imported").exists()
