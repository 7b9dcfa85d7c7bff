"""A simulator that needs other packages than this project: an environment of its own, and the script that runs in it.

A script has two commands: ``collect TASK OUT.hdf5`` records demonstrations (``arena_recording.py``), and ``play TASK
OUT.json NAME=EXPORTED...`` lets exported controllers act (``arena_playing.py``).
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

import h5py
import numpy as np
from arena_playing import write_chunk
from policies import KINDS, Policy, Settings, chunked, fit

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import only_one, write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.exporting import write_numpy
from ddco_pyro.fitting.fit import fit as fit_spec
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import with_overrides
from ddco_pyro.study.cells import Job

HERE = Path(__file__).parent
INSTALLED = ".made"
"""In the environment: the pins that it was made from, once all of them are installed."""

BAD_INPUT = 2
"""The exit status of a script that cannot use what it was given."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
HELD_OUT = 20
"""The first demonstrations of a file are held out, whatever the others are used for."""


class Written(Protocol):
    """What an environment with numpy alone can play, beside a fit."""

    def write(self, folder: Path) -> None:
        """Write it for :func:`arena_playing.exported`."""


@dataclass(frozen=True)
class Apart:
    """What is done by a script, and with which packages.

    :param script: its file name in this folder.
    :param pins: the file name of its requirements.
    :param runs: the folder of the environment and of the demonstrations.
    """

    script: str
    pins: str
    runs: Path

    def made(self) -> Path:
        """The Python of its environment, made where it is not there.

        :raises Failed: it cannot be made.
        """
        return environment(self.runs / "venv", HERE / self.pins)

    def collected(self, task: str, **options: float | str) -> Path:
        """The task's demonstrations, recorded where they are not there, or were by other code or options.

        :param options: of the script's command ``collect``.
        :raises Failed: the simulator cannot be used, or its expert fails.
        """
        identity = [(HERE / name).read_text() for name in (self.script, self.pins)] + [task, options]
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:12]
        path = self.runs / "demonstrations" / task / f"{digest}.hdf5"
        with only_one(path.parent, wait=True):
            if not path.exists():
                self.collect(task, path, **options)
        return path

    def collect(self, task: str, path: Path, **options: float | str) -> None:
        """Record demonstrations of a task into a file, with options as :meth:`collected`."""
        run(self.made(), HERE / self.script, "collect", task, path, *_words(options))

    def played(self, task: str, methods: Mapping[str, Fit | Written], **options: Any) -> dict[str, Any]:
        """What the script's command ``play`` writes about exported methods."""
        with tempfile.TemporaryDirectory() as folder:
            for name, one in methods.items():
                (Path(folder) / name).mkdir()
                write_numpy(one, Path(folder) / name) if isinstance(one, Fit) else one.write(Path(folder) / name)
            out, named = Path(folder) / "played.json", [f"{name}={folder}/{name}" for name in methods]
            run(self.made(), HERE / self.script, "play", task, out, *named, *_words(options))
            return dict(json.loads(out.read_text()))

    def play(self, task: str, methods: dict[str, Fit], source: Path, episodes: int) -> dict[str, Any]:
        """Episodes of each exported method, and by how much its controls differ from its fit's on a demonstration.

        :raises Failed: the simulator cannot be used.
        """
        played = self.played(task, methods, episodes=episodes, recorded=source.resolve())
        keys = {key for one in methods.values() for key in one.spec.observed}
        demo = Demonstrations.read(source, sorted(keys)).select([played["demonstration"]])[0]
        played["differences"] = {
            name: float(np.abs(np.array(played["controls"][name]) - acted(one, demo.observations)).max())
            for name, one in methods.items()
        }
        return played


class Peers(ABC):
    """A simulator whose methods are the policies of ``policies.py``; a cell may have other settings than their kind."""

    def __init__(self) -> None:
        self.methods = {name: partial(self._policy, settings) for name, settings in KINDS.items()}

    @abstractmethod
    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """Episodes of a policy: success, and what else the simulator measures."""

    def _policy(self, settings: Settings, job: Job) -> dict[str, float]:
        policy = fit(job.demos, settings.given(job.settings), job.cell.seed, job.spec.observed)
        return means(self.play(job.cell.task, policy, job.starts, job.folder))


@dataclass(frozen=True)
class Chunked:
    """A fit whose control is a chunk of controls, as :class:`arena_playing.Chunks` executes it."""

    fitted: Fit
    chunk: int
    executed: int

    def write(self, folder: Path) -> None:
        """Write it for :func:`arena_playing.exported`."""
        write_numpy(self.fitted, folder)
        write_chunk(folder, self.chunk, self.executed)


class World(Peers):
    """A simulator apart as the world of a study; of its method ``chunked``, options emit chunks of controls."""

    def __init__(self, simulator: Apart) -> None:
        super().__init__()
        self.simulator = simulator
        self.methods["chunked"] = self._chunked

    def _chunked(self, job: Job) -> dict[str, float]:
        """Settings are ``chunk``, ``executed``, and key paths of the spec."""
        spec = {key: value for key, value in job.settings.items() if "." in key}
        chunk, executed = job.settings["chunk"], job.settings["executed"]
        fitted = fit_spec(with_overrides(job.spec, spec), chunked(job.demos, chunk), out=job.folder / "fit", keep=False)
        return means(self.play(job.cell.task, Chunked(fitted, chunk, executed), job.starts, job.folder))

    def play(self, task: str, fitted: Fit | Written, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """Episodes of the exported policy: success, steps, and what else the simulator measures."""
        played = self.simulator.played(task, {"policy": fitted}, first=starts.start, episodes=len(starts))
        return [{name: float(value) for name, value in one.items()} for one in played["episodes"]["policy"]]


def means(episodes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each measure."""
    return {name: float(np.mean([episode[name] for episode in episodes])) for name in episodes[0]}


def _words(options: Mapping[str, Any]) -> list[str]:
    """Options as words of a command."""
    return [word for key, value in options.items() for word in (f"--{key.replace('_', '-')}", str(value))]


def expert(source: Path) -> dict[str, Any]:
    """How often the expert succeeded, and which part of the steps each of its labels has."""
    with h5py.File(source) as file:
        return dict(json.loads(str(file.attrs["expert"])))


def acted(one: Fit, observations: dict[str, np.ndarray]) -> np.ndarray:
    """What a fit's controller does on recorded observations, [T, A]."""
    controller = one.controller()
    controller.reset(0)
    rows = (dict(zip(observations, row, strict=True)) for row in zip(*observations.values(), strict=True))
    return np.stack([controller.act(row) for row in rows])


def environment(folder: Path, pins: Path, python: str = sys.executable) -> Path:
    """The Python of the environment in ``folder``, which is made where it is not there, or of other pins.

    :raises Failed: it cannot be made; one line.
    """
    marker, wanted = folder / INSTALLED, pins.read_text(encoding="utf-8")
    with only_one(folder, wait=True):
        if not marker.exists() or marker.read_text(encoding="utf-8") != wanted:
            pip = [str(_python(folder)), "-m", "pip", "install", "-q", "--no-compile", "--no-deps", "-r", str(pins)]
            for command in ([python, "-m", "venv", "--clear", str(folder)], pip):
                _run(command, f"{folder}: an environment with {pins.name} cannot be made")
            write_text(marker, wanted)
    return _python(folder)


def run(python: Path, script: Path, *arguments: str | Path) -> None:
    """Run a script on one thread.

    :raises BadInput: it says that what it was given cannot be used; its last line.
    :raises Failed: it ended with another error; its last line.
    """
    command = [str(python), "-W", "ignore", str(script), *map(str, arguments)]
    _run(command, f"{script.name} {arguments[0]} {arguments[1]}", ONE_THREAD)


def _python(folder: Path) -> Path:
    return folder / "bin" / "python"


def _run(command: list[str], what: str, environment: dict[str, str] | None = None) -> None:
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | (environment or {})
        )
    except OSError as error:
        raise Failed(f"{what}: {command[0]}: {error.strerror}") from error
    if ended.returncode:
        said = (ended.stderr.strip() or ended.stdout.strip() or f"exit status {ended.returncode}").splitlines()
        raise (BadInput if ended.returncode == BAD_INPUT else Failed)(f"{what}: {said[-1].strip()}")
