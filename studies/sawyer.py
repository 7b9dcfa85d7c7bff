"""Meta-World as the world of a study (``world: sawyer:WORLD``): an environment of its own.

The environment in ``runs/metaworld/venv`` is of ``arena_requirements.txt``; it runs ``arena_metaworld.py``.
"""

from __future__ import annotations

from pathlib import Path

from studies.apart import Apart, World

RUNS = Path(__file__).parents[1] / "runs" / "metaworld"
SIMULATOR = Apart("arena_metaworld.py", "arena_requirements.txt", RUNS)
NOISE = 0.1
"""Standard deviation of the noise on the expert's controls."""


class MetaWorld(World):
    """Tasks of Meta-World v3 with their scripted experts."""

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the first successful episodes of the expert with noise on its controls."""
        options = {"number": count, "held_out": 1, "first": seeds.start, "attempts": len(seeds)}
        options["noise"] = NOISE
        self.simulator.run("collect", task, path, **options)


WORLD = MetaWorld(SIMULATOR)
