"""The command line as a user runs it: what it prints, how it ends, and what it says of bad input."""

import ast
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from unittest import mock

import pytest
import toy_task
import typer
from command_line import COMMAND, HERE, call, done, with_set
from killing import HANGS

import ddco_pyro
from ddco_pyro.cli import console
from ddco_pyro.cli.app import app
from ddco_pyro.drawing import words
from ddco_pyro.events import Counted, EpochEnded, TrainingBegan, TrainingEnded
from ddco_pyro.names import method
from ddco_pyro.spec import dump_spec, load_spec, spec_schema

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    path = tmp_path_factory.mktemp("specs") / "toy.yaml"
    path.write_text(toy_task.SPEC)
    return path


@pytest.fixture(scope="module")
def run(spec, tmp_path_factory):
    """A run that ``fit`` made, and how ``fit`` ended."""
    folder = tmp_path_factory.mktemp("runs") / "toy"
    short = ["--set", "training.epochs=2", "--set", "compare_with=[flat]"]
    return folder, call("fit", spec, "--out", folder, *short)


# --- what works ---------------------------------------------------------------------------------------------


def test_check_shows_defaults_shapes_and_parameters(spec):
    changes = ["hierarchy.levels.0.count=3", "compare_with=[flat]"]
    ended = call("check", spec, *with_set(*changes))
    assert (ended.status, ended.err) == (0, "")
    resolved = load_spec(spec, changes)
    assert ended.out.startswith(dump_spec(resolved))
    assert "patience: 20" in ended.out
    table = [[cell.strip() for cell in line.split("│")] for line in ended.out.splitlines() if "│" in line]
    sizes = (3 * (5 * 8 + 8 + 8 * 2 + 2), 3 * (5 + 1), 5 * 8 + 8 + 8 * 3 + 3)
    assert table == [
        ["observation offsets", "[4]"],
        ["observation visited", "[1]"],
        ["features", "5"],
        ["control", "[2]"],
        ["hierarchy.levels.0.policy", str(sizes[0])],
        ["hierarchy.levels.0.termination", str(sizes[1])],
        ["hierarchy.meta_policy", str(sizes[2])],
        ["all networks", str(sum(sizes))],
        ["compare_with.0: flat, hidden: [64]", str(5 * 64 + 64 + 64 * 2 + 2)],
    ]


def test_fit_writes_a_run_and_its_report(run):
    folder, ended = run
    assert ended.status == 0
    loaded = ddco_pyro.load(folder)
    assert loaded.spec.training.epochs == 2
    assert list(loaded.baselines) == ["flat"]
    assert (folder / "report.html").stat().st_size > 1000
    assert ended.out.splitlines()[-1] == f"report: {folder / 'report.html'}"
    for name, row in {"ddco": loaded.metrics, **loaded.metrics.comparison}.items():
        values = row.log_likelihood_per_step
        valid, train = (words.number(getattr(values, part), 3) for part in ("valid", "train"))
        assert re.search(rf"^ *{method(name)} +│ +{valid} +│ +{train}", ended.out, re.MULTILINE)


def test_rollout_and_its_report(run):
    folder, _ = run
    ended = done("rollout", folder, "--episodes", 1, "--video", "--jobs", 1)
    methods = ddco_pyro.load(folder).metrics.rollouts.methods
    assert list(methods) == ["open_loop", "supervisor", "flat", "ddco"]
    for name, one in methods.items():
        successes = one.measures["success"].successes
        assert re.search(rf"^ *{method(name)} +│ +{successes} of 1 \(", ended.out, re.MULTILINE)
    assert len(list((folder / "videos").glob("*.mp4"))) == 4
    again = call("rollout", folder, "--episodes", 1, "--video", "--jobs", 1, "--resume")
    # nothing is rolled out, so no progress is shown
    assert (again.status, again.out, again.err) == (0, ended.out, "")
    assert "open_loop" in (folder / "report.html").read_text()


COMMANDS = typer.main.get_command(app).commands


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_has_an_example_that_can_be_typed(command):
    ended = call(command, "--help")
    assert (ended.status, ended.err) == (0, "")
    (example,) = re.findall(rf"Example: ddco-pyro {command} (.*)", " ".join(ended.out.split()))
    assert COMMANDS[command].make_context(command, shlex.split(example)).params


EVERY_HELP = """
import sys
from ddco_pyro.cli.app import EXAMPLES, app
for example in EXAMPLES.values():
    app([example.split()[0], "--help"], standalone_mode=False)
"""


@pytest.mark.parametrize("columns", [20, 60])
def test_help_cuts_no_option_however_narrow_it_is(columns):
    own = {**os.environ, "COLUMNS": str(columns)}
    ended = subprocess.run([sys.executable, "-c", EVERY_HELP], capture_output=True, text=True, env=own)
    options = [name for command in COMMANDS.values() for one in command.params for name in one.opts]
    names = {name for name in options if name[:2] == "--"}
    assert {name for name in names if name not in ended.stdout} == set()
    assert "\\[" not in ended.stdout


def test_check_prints_the_schema():
    ended = done("check", "--schema")
    assert (json.loads(ended.out), ended.err) == (spec_schema(), "")


def test_version_is_the_packages():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    ended = call("--version")
    assert (ended.status, ended.out, ended.err) == (0, f"ddco-pyro {declared}\n", "")


def test_nothing_at_all_is_help():
    ended = call()
    assert ended == call("--help")
    assert [command for command in COMMANDS if f" {command} " not in ended.out] == []


# --- what does not ------------------------------------------------------------------------------------------


GRID = with_set("selection.grid.hierarchy.levels.0.count=[1, 2]")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "nowhere.yaml"], "nowhere.yaml: cannot be read: No such file or directory; check the"),
        (["check"], "name a spec, such as: ddco-pyro check specs/needle.yaml"),
        (["check", "SPEC", *with_set("training.epochs=many")], "training.epochs: must be a whole number"),
        (["check", "SPEC", *with_set("task=toi")], "no task is registered as 'toi'"),
        (["check", "SPEC", *with_set("observations=[pose]")], r"observations: there is no pose \(there are"),
        (["check", "--foo"], "No such option: --foo; see ddco-pyro check --help"),
        (["fit"], "Missing argument 'SPEC'; see ddco-pyro fit --help"),
        (["chekc"], "No such command 'chekc'.*; see ddco-pyro --help"),
        (["rollout", "RUN", "--episodes", "0"], "Invalid value for '--episodes': .*; see ddco-pyro rollout"),
        (["collect", "SPEC", *with_set("task=null", "demonstrations.path=x")], r"toy\.yaml: names no task"),
        (["fit", "SPEC", "--out", "RUN"], "holds a run of another spec; choose another --out or remove it"),
        (["fit", "RUN/spec.yaml", "--out", "RUN"], "holds a run of this spec already; show it with --resume"),
        (["select", "SPEC"], "selection.grid: is empty; name what to try, such as selection.grid: {.*}"),
        (["select", "SPEC", *GRID, "--jobs", "0"], "--jobs 0: give a number of processes, or -1 for one on"),
        (["compare", "RUN"], "one run alone cannot be compared; name at least two, such as RUN and RUN/base"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_refused_in_one_line(arguments, message, spec, run):
    names = {"SPEC": str(spec), "RUN": str(run[0]), "RUN/spec.yaml": str(run[0] / "spec.yaml")}
    ended = call(*(names.get(argument, argument) for argument in arguments))
    assert (ended.status, ended.out) == (2, "")
    assert re.fullmatch(f"ddco-pyro: .*{message}.*\n", ended.err)


WRONG = "{network: 'user_networks:Wrong', options: {how: swapped}}"


def test_an_own_network_of_another_shape_is_refused_before_any_work(spec, tmp_path, cache):
    line = (
        "ddco-pyro: compare_with.0.policy: network 'user_networks:Wrong' gives shape [2, 3, 2, 1]; "
        "it has to be a tensor [N, T, copies, outputs], here [2, 3, 1, 2]\n"
    )
    kept = sorted(cache.rglob("*"))
    override = f"compare_with=[{{kind: flat, policy: {WRONG}}}]"
    changed = ["--allow-code", *with_set(override, "demonstrations.seed=77")]
    assert call("check", spec, *changed) == (2, "", line)
    assert call("fit", spec, "--out", tmp_path / "run", *changed) == (2, "", line)
    assert not (tmp_path / "run").exists()
    assert sorted(cache.rglob("*")) == kept


def test_training_that_fails_says_why(spec, tmp_path):
    diverging = with_set("training.optimizer.lr=1e30", "compare_with=[]", "training.patience=null")
    ended = call("fit", spec, "--out", tmp_path / "run", *diverging)
    assert ended.status == 1
    *_, last = ended.err.splitlines()
    says = r"ddco-pyro: stage vq-1, epoch \d+: the log-likelihood of demo_\d+.* is not finite; look at"
    assert re.match(says, last)


UNEXPECTED = "unexpected ZeroDivisionError: two lines; --debug shows where it comes from"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ZeroDivisionError("two\nlines"), UNEXPECTED),
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_what_fails_otherwise_has_one_line_too(monkeypatch, spec, error, message):
    monkeypatch.setattr("ddco_pyro.training.data.dimensions", mock.Mock(side_effect=error))
    assert call("check", spec) == (1, "", f"ddco-pyro: {message}\n")


def test_a_scheduler_that_preempts_means_ctrl_c(monkeypatch, spec):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("ddco_pyro.training.data.dimensions", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert call("check", spec) == (1, "", "ddco-pyro: interrupted\n")
    assert signal.getsignal(signal.SIGTERM) is before


def test_debug_shows_the_traceback():
    for arguments in (["--debug", "check", "nowhere.yaml"], ["check", "nowhere.yaml", "--debug"]):
        ended = call(*arguments)
        assert ended.status == 2
        assert ended.err.startswith("Traceback (most recent call last):")
        assert ended.err.splitlines()[-1].startswith("ddco_pyro.spec.SpecError: nowhere.yaml: cannot be read")


# --- in a process of its own --------------------------------------------------------------------------------


def test_a_pipe_that_is_closed_ends_it_quietly():
    """As in ``ddco-pyro check --schema | head -1``, be what is printed short or long."""
    for arguments in (["check", "--schema"], ["--version"]):
        reading, writing = os.pipe()
        process = subprocess.Popen([COMMAND, *arguments], stdout=writing, stderr=subprocess.PIPE, text=True)
        os.close(writing)
        os.close(reading)
        assert process.communicate(timeout=HANGS)[1] == ""
        assert process.returncode == 1


def test_a_name_that_the_terminal_cannot_print_is_printed_all_the_same():
    name = os.fsdecode(b"gone \xc3\xa9\xff.yaml")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    ended = subprocess.run([COMMAND, "init", name], capture_output=True, env=environment)
    shown = name.encode("ascii", "backslashreplace").decode()
    assert ended.returncode == 2
    assert ended.stderr.decode() == f"ddco-pyro: {shown}: there is no such file or folder; check the path\n"


LIGHT = """
import runpy, sys
import ddco_pyro
for arguments in {lines!r}:
    sys.argv = ["ddco-pyro", *arguments]
    try:
        runpy.run_module("ddco_pyro.cli", run_name="__main__")
    except SystemExit as ended:
        print(ended.code, sorted(set({heavy}) & set(sys.modules)))
"""
HEAVY = ("h5py", "matplotlib", "pandas", "pyro", "scipy.stats", "sklearn", "sympy", "torch", "torch._dynamo")


def test_help_and_refusals_load_nothing_heavy():
    """Loading torch, pyro and scikit-learn takes seconds."""
    lines = [["fit", "--help"], ["check", "--schema"], ["check", "nowhere.yaml"]]
    program = LIGHT.format(lines=lines, heavy=HEAVY)
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert [line for line in ended.stdout.splitlines() if line[2:] == "[]"] == ["0 []", "0 []", "2 []"]


def test_check_finds_tasks_beside_it_and_loads_no_package_that_it_does_not_use(spec):
    """The toy task is found in the working folder.

    Sorting and indexing on torch's "meta" device import sympy; intervals import scipy.stats.
    """
    line = ["check", str(spec), "--allow-code", "--set", "task=toy_task:task"]
    program = LIGHT.format(lines=[line], heavy=HEAVY)
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=HERE, env=own)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "hierarchy.meta_policy" in ended.stdout
    assert set(ast.literal_eval(ended.stdout.splitlines()[-1].removeprefix("0 "))) <= {"h5py", "torch"}


# --- progress where there is no terminal --------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""
    now = [0.0]
    monkeypatch.setattr("ddco_pyro.cli.console.time.monotonic", lambda: now[0])
    return now


def test_plain_lines_come_now_and_then_and_at_the_end(clock, capsys):
    with console.Progress() as progress:
        for done in range(1, 8):
            progress(Counted("collecting demonstrations", 7, done=done))
            clock[0] += 4
    assert capsys.readouterr().err.splitlines() == [
        "collecting demonstrations: 4/7, 12 s left",
        "collecting demonstrations: 7/7, 0 s left",
    ]


@pytest.mark.parametrize(("epochs", "shown"), [(100, "3/100, 388 s left"), (None, "3")])
def test_a_fit_that_stops_early_says_so(clock, capsys, epochs, shown):
    """Where the number of epochs is open there is no time left."""
    with console.Progress() as progress:
        progress(TrainingBegan("ddco", epochs))
        for _ in range(3):
            clock[0] += 4
            progress(EpochEnded(0, "level-1", 1, 1.25, -0.5))
        progress(TrainingEnded("ddco"))
    assert capsys.readouterr().err.splitlines() == [
        f"training options: {shown}  level-1: training 1.250, tuning -0.500 nats/step",
        "training options: done after 3, 12 s",
    ]
