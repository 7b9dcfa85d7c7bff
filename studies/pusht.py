"""PushT as the world of a study (``world: pusht:WORLD``): an environment of its own, and the method ``chunked``.

The environment is made in ``runs/pusht/venv`` from ``pusht_requirements.txt``; ``pusht_gym.py`` runs in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from apart import Apart, World, means
from arena_playing import write_chunk
from policies import chunked

from ddco_pyro.exporting import write_numpy
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import with_overrides
from ddco_pyro.study.cells import Job

RUNS = Path(__file__).parents[1] / "runs" / "pusht"


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


class PushT(World):
    """PushT, with people's demonstrations in a file."""

    def __init__(self, simulator: Apart) -> None:
        super().__init__(simulator)
        self.methods["chunked"] = self._chunked

    def _chunked(self, job: Job) -> dict[str, float]:
        """Options with a chunk of controls as the control; settings are ``chunk``, ``executed``, and key paths."""
        spec = {key: value for key, value in job.settings.items() if "." in key}
        chunk, executed = job.settings["chunk"], job.settings["executed"]
        fitted = fit(with_overrides(job.spec, spec), chunked(job.demos, chunk), out=job.folder / "fit", keep=False)
        return means(self.play(job.cell.task, Chunked(fitted, chunk, executed), job.starts, job.folder))


WORLD = PushT(Apart("pusht_gym.py", "pusht_requirements.txt", RUNS))
