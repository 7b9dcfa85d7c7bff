"""A machine without what cameras are drawn with: one line that says what to install, before all else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ddco_tasks.opengl import PACKAGES, advice

ROOT = Path(__file__).parents[2]
NO_DRIVER = {"__EGL_VENDOR_LIBRARY_DIRS": "/nowhere"}
LIBRARIES = {
    "libEGL.so.1 cannot be loaded": ("libEGL",),
    "libOpenGL.so.0 cannot be loaded": ("libOpenGL", "libGL.so", "libGLES"),
}
"""What is said where these are not installed."""

WITHOUT = """
import ctypes, sys
original = ctypes.CDLL.__init__
def refuse(self, name, *arguments, **options):
    if str(name).startswith({missing!r}):
        raise OSError(f"{{name}}: cannot open shared object file: No such file or directory")
    original(self, name, *arguments, **options)
ctypes.CDLL.__init__ = refuse
"""


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)


def ended(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    own = os.environ | environment
    return subprocess.run(command, env=own, cwd=ROOT, capture_output=True, text=True, check=False)


LOOKING = "import runpy; runpy.run_path('tasks/opengl.py', run_name='__main__')"
CHECKING = "sys.argv = ['ddco-pyro', 'check', 'specs/needle.yaml']; "
CHECKING += "from ddco_pyro.cli.app import main; main()"


@pytest.mark.parametrize("cause", LIBRARIES)
@pytest.mark.parametrize(
    ("script", "head"),
    [
        pytest.param(LOOKING, "", id="looking"),
        pytest.param(CHECKING, "ddco-pyro: ", id="checking", marks=pytest.mark.slow),
    ],
)
def test_without_opengl_libraries_one_line_names_the_packages(cause: str, script: str, head: str) -> None:
    found = ended(sys.executable, "-c", WITHOUT.format(missing=LIBRARIES[cause]) + script)
    assert (found.returncode, found.stdout) == (1, "")
    assert found.stderr.splitlines() == [f"{head}{advice(cause)}"]
    assert f"apt-get install {PACKAGES}" in advice(cause)


@pytest.mark.parametrize(
    "own", [{}, NO_DRIVER | {"MUJOCO_GL": "osmesa"}, NO_DRIVER | {"DISPLAY": ":0"}], ids=str
)
def test_where_the_tasks_can_draw_nothing_is_said(own: dict[str, str]) -> None:
    """Another renderer, or a display, is taken to work."""
    found = ended(sys.executable, "tasks/opengl.py", **own)
    assert (found.returncode, found.stdout, found.stderr) == (0, "", "")


def test_the_demo_looks_for_opengl_before_it_installs_anything(tmp_path: Path) -> None:
    for name in ("Makefile", "pyproject.toml", "setup.py", "constraints.txt", "tasks/opengl.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    found = ended("make", "-C", tmp_path, "demo", **NO_DRIVER, PIP_NO_INDEX="1")
    assert found.returncode == 2
    assert advice("EGL has no device that starts") in found.stderr.splitlines()
    assert not (tmp_path / ".venv").exists()
