"""``make release-check``: install an sdist or a wheel into its own environment; use it without a clone."""

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
TORCH_CPU = "https://download.pytorch.org/whl/cpu/torch/"

INSTALLED = """
import sys, ddco_pyro
from importlib.metadata import entry_points
from importlib.resources import files
assert ddco_pyro.__file__.startswith(sys.prefix), ddco_pyro.__file__
for point in entry_points(group="ddco_pyro.tasks"):
    assert str(files(point.module)).startswith(sys.prefix), point
from ddco_pyro.data.planted import pick_and_place
pick_and_place(12).write("mine.hdf5")
"""


def check(file: Path, packages: Path | None) -> None:
    """Install a file, run ``new`` on generated demonstrations and ``demo``, each from an empty folder.

    :param packages: a folder with the dependencies, which are then not installed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "venv", with_pip=True)
        binaries = folder / "venv" / "bin"
        theirs = ("PYTHONPATH", "VIRTUAL_ENV")
        environment = {key: value for key, value in os.environ.items() if key not in theirs}

        def run(*command: str | Path) -> None:
            print("$", *command, flush=True)
            subprocess.run([binaries / command[0], *command[1:]], cwd=folder, env=environment, check=True)

        if packages:
            (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
            (site / "dependencies.pth").write_text(f"{packages.resolve()}\n")
            run("pip", "install", "-q", "--no-deps", file.resolve())
        else:
            places = ("--find-links", TORCH_CPU, "-c", ROOT / "constraints.txt")
            run("pip", "install", "-q", *places, file.resolve())
        run("python", "-c", INSTALLED)
        run("ddco-pyro", "--version")
        run("ddco-pyro", "new", "mine.hdf5", "--out", "new", "--no-open")
        run("ddco-pyro", "demo", "--out", "demo", "--no-open")
        for made in ("new/segments.html", "new/run/report.html", "demo/report.html"):
            assert (folder / made).stat().st_size > 10_000, made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="+")
    instead = "a folder with the dependencies, instead of installing them"
    parser.add_argument("--packages", type=Path, help=instead)
    given = parser.parse_args()
    for one in given.files:
        check(one, given.packages)
        print(f"{one.name}: installs and works without a clone", file=sys.stderr)
