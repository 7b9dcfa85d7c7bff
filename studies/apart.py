"""A simulator with packages of its own: an environment for these, and the module that runs in it.

A module has two commands: ``collect TASK OUT.hdf5`` records demonstrations (``arena_recording.py``), and
``play TASK OUT.json NAME=EXPORTED...`` lets exported controllers act (``arena_playing.py``).
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ddco_pyro.data.files import only_one, write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.exporting import write_numpy
from ddco_pyro.fitting.fit import fit as fit_spec
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import with_overrides
from studies.arena_playing import write_chunk
from studies.cells import ROOT, Job
from studies.policies import KINDS, Policy, Settings, chunked, fit

HERE = ROOT / "studies"
INSTALLED = ".made"
"""In the environment: the pins that it was made from, once all of them are installed."""

BAD_INPUT = 2
"""The exit status of a module that cannot use what it was given."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
HELD_OUT = 20
"""The first demonstrations of a file are held out, whatever the others are used for."""


class Written(Protocol):
    """What an environment with numpy alone can play, beside a fit."""

    def write(self, folder: Path) -> None:
        """Write it for :func:`studies.arena_playing.exported`."""


@dataclass(frozen=True)
class Apart:
    """What is done by a module, and with which packages.

    :param script: its file name in this folder.
    :param pins: the file name of its requirements.
    :param runs: the folder of the environment and of the demonstrations.
    """

    script: str
    pins: str
    runs: Path

    def made(self) -> Path:
        """The Python of its environment, made where it is not there, or of other pins.

        :raises Failed: it cannot be made.
        """
        folder, pins = self.runs / "venv", HERE / self.pins
        python, marker = folder / "bin" / "python", folder / INSTALLED
        wanted = pins.read_text(encoding="utf-8")
        with only_one(folder, wait=True):
            if not marker.exists() or marker.read_text(encoding="utf-8") != wanted:
                quiet = ("-q", "--no-compile", "--no-deps")
                pip = [str(python), "-m", "pip", "install", *quiet, "-r", str(pins)]
                for command in ([sys.executable, "-m", "venv", "--clear", str(folder)], pip):
                    _run(command, f"{folder}: an environment with {pins.name} cannot be made")
                write_text(marker, wanted)
        return python

    def collected(self, task: str, **options: float | str) -> Path:
        """The task's demonstrations, recorded where they are not there, or were by other code or options.

        :param options: of the module's command ``collect``.
        :raises Failed: the simulator cannot be used, or its expert fails.
        """
        identity = [(HERE / name).read_text() for name in (self.script, self.pins)] + [task, options]
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:12]
        path = self.runs / "demonstrations" / task / f"{digest}.hdf5"
        with only_one(path.parent, wait=True):
            if not path.exists():
                self.run("collect", task, path, **options)
        return path

    def played(self, task: str, methods: Mapping[str, Fit | Written], **options: Any) -> dict[str, Any]:
        """What the module's command ``play`` writes about exported methods."""
        with tempfile.TemporaryDirectory() as folder:
            for name, one in methods.items():
                (Path(folder) / name).mkdir()
                place = Path(folder) / name
                write_numpy(one, place) if isinstance(one, Fit) else one.write(place)
            out, named = Path(folder) / "played.json", [f"{name}={folder}/{name}" for name in methods]
            self.run("play", task, out, *named, **options)
            return dict(json.loads(out.read_text()))

    def run(self, what: str, task: str, *arguments: str | Path, **options: Any) -> None:
        """Run a command of the module on one thread.

        :raises BadInput: it says that what it was given cannot be used; its last line.
        :raises Failed: it ended with another error; its last line.
        """
        script = f"studies.{Path(self.script).stem}"
        module = [str(self.made()), "-W", "ignore", "-P", "-m", script, what, task]
        pairs = [(f"--{key.replace('_', '-')}", str(value)) for key, value in options.items()]
        words = [word for pair in pairs for word in pair]
        _run([*module, *map(str, arguments), *words], f"{self.script} {what} {task}")


def _run(command: list[str], what: str) -> None:
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)}
    try:
        ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    except OSError as error:
        raise Failed(f"{what}: {command[0]}: {error.strerror}") from error
    if ended.returncode:
        said = ended.stderr.strip() or ended.stdout.strip() or f"exit status {ended.returncode}"
        line = said.splitlines()[-1].strip()
        raise (BadInput if ended.returncode == BAD_INPUT else Failed)(f"{what}: {line}")


Episodes = Sequence[Mapping[str, float]]
"""What each episode measures."""


class Peers(ABC):
    """A simulator whose methods are the policies of ``policies.py``; a cell may have other settings."""

    def __init__(self) -> None:
        self.methods = {name: partial(self._policy, settings) for name, settings in KINDS.items()}

    @abstractmethod
    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Episodes:
        """Episodes of a policy: success, and what else the simulator measures."""

    def _policy(self, settings: Settings, job: Job) -> dict[str, float]:
        policy = fit(job.demos, settings.given(job.settings), job.cell.seed, job.spec.observed)
        return means(self.play(job.cell.task, policy, job.starts, job.folder))


@dataclass(frozen=True)
class Chunked:
    """A fit whose control is a chunk of controls, as :class:`studies.arena_playing.Chunks` executes it."""

    fitted: Fit
    chunk: int
    executed: int

    def write(self, folder: Path) -> None:
        """Write it for :func:`studies.arena_playing.exported`."""
        write_numpy(self.fitted, folder)
        write_chunk(folder, self.chunk, self.executed)


class World(Peers):
    """A simulator apart as the world of a study; of its method ``chunked``, options emit chunks."""

    def __init__(self, simulator: Apart) -> None:
        super().__init__()
        self.simulator = simulator
        self.methods["chunked"] = self._chunked

    def _chunked(self, job: Job) -> dict[str, float]:
        """Settings are ``chunk``, ``executed``, and key paths of the spec."""
        spec = {key: value for key, value in job.settings.items() if "." in key}
        chunk, executed = job.settings["chunk"], job.settings["executed"]
        own, demos = with_overrides(job.spec, spec), chunked(job.demos, chunk)
        fitted = fit_spec(own, demos, out=job.folder / "fit", keep=False)
        return means(self.play(job.cell.task, Chunked(fitted, chunk, executed), job.starts, job.folder))

    def play(self, task: str, fitted: Fit | Written, starts: range, folder: Path) -> Episodes:
        """Episodes of the exported policy: success, steps, and what else the simulator measures."""
        played = self.simulator.played(task, {"policy": fitted}, first=starts.start, episodes=len(starts))
        return [{name: float(value) for name, value in one.items()} for one in played["episodes"]["policy"]]


def means(episodes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each measure."""
    return {name: float(np.mean([episode[name] for episode in episodes])) for name in episodes[0]}
