"""PushT as the world of a study (``world: pusht:WORLD``): its own environment, and people's demonstrations.

The environment is made in ``runs/pusht/venv`` from ``pusht_requirements.txt``; ``pusht_gym.py`` runs in it.
"""

from __future__ import annotations

from pathlib import Path

from studies.apart import Apart, World
from studies.cells import ROOT
from studies.files import drawn

RUNS = ROOT / "runs" / "pusht"


class PushT(World):
    """``runs/pusht/pusht_human.hdf5`` has the demonstrations, of which every training seed draws some."""

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Draw demonstrations."""
        drawn(RUNS / "pusht_human.hdf5", seeds.start, count).write(path)


WORLD = PushT(Apart("pusht_gym.py", "pusht_requirements.txt", RUNS))
