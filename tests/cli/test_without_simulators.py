"""One's own demonstrations need no simulator: the commands run where none can be imported."""

import json
import subprocess
import sys

import pytest
from random_demonstrations import of_states

from ddco_pyro.data.planted import pick_and_place

HIDDEN = ("cv2", "dm_control", "dm_env", "gymnasium", "mujoco", "ompl")
WITHOUT = f"""
import importlib.metadata, json, sys
find = importlib.metadata.MetadataPathFinder.find_distributions
importlib.metadata.MetadataPathFinder.find_distributions = lambda context: (
    found for found in find(context) if found.name.replace("-", "_") not in {HIDDEN}
)
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {HIDDEN}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name.partition(".")[0])
sys.meta_path.insert(0, Hidden())
from ddco_pyro.cli.app import main
commands = json.loads(sys.argv[1])
for command in commands:
    sys.argv = ["ddco-pyro", *command]
    try:
        main()
    except SystemExit as ended:
        print(f"status {{ended.code}}", file=sys.stderr)
"""


def call(folder, *commands):
    """How commands end, in turn in a process that cannot import a simulator: a line each of stderr."""
    command = [sys.executable, "-c", WITHOUT, json.dumps(commands)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1000)
    return ended.stderr.splitlines()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    of_states([10] * 12).write(folder / "mine.hdf5")
    return folder


@pytest.fixture(scope="module")
def said(folder):
    """What the commands say, of one's own file and of a task that needs a simulator."""
    (folder / "task.yaml").write_text(
        "task: needle\ndemonstrations: {count: 2}\nobservations: [gripper_pose]\n"
        "hierarchy: {levels: [{count: 2}]}\n"
    )
    quick = ("--set", "training.epochs=2", "--set", "compare_with=[]")
    return call(
        folder,
        ("init", "mine.hdf5", "--out", "mine.yaml"),
        ("fit", "mine.yaml", "--out", "run", *quick),
        ("segment", "run", "mine.hdf5", "--html", "segments.html"),
        ("export", "run", "--lerobot", "controller"),
        *((command, "task.yaml", "--out", f"{command}.out") for command in ("collect", "fit")),
    )


def test_from_a_file_to_an_export(folder, said):
    ends = [line for line in said if line.startswith("status ")]
    assert ends == [*["status 0"] * 4, *["status 2"] * 2], said
    assert (folder / "segments.html").exists()
    assert (folder / "run" / "report.html").exists()
    assert (folder / "controller" / "weights.npz").exists()


@pytest.mark.slow
def test_the_demo_has_generated_demonstrations(folder):
    """A spec that is there already, here one with a small budget, is kept."""
    out, small = folder / "demo", "\ntraining: {epochs: 2}\n"
    pick_and_place(8).write(out / "pick_and_place.hdf5")
    known = "demonstrations: {path: demo/pick_and_place.hdf5}\nobservations: [gripper, jaw]\n"
    levels = "hierarchy: {levels: [{count: 2, policy: {network: linear}}], meta_policy: {network: linear}}"
    (out / "spec.yaml").write_text(known + levels + small)
    said = call(folder, ("demo", "--out", "demo"))
    assert said[-1] == "status 0", said
    assert (out / "segments.html").exists()


def test_a_task_names_the_missing_package(said):
    refused = [line for line in said if "the package" in line]
    assert len(refused) == 2
    for line in refused:
        assert "task 'needle' needs the package" in line
        assert "which is not installed here" in line
