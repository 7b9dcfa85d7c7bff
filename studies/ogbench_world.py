"""OGBench's manipulation tasks as worlds of a study: the goal is observed (``SHOWN``), or not (``HIDDEN``).

Its environment ``runs/ogbench/venv`` is of ``ogbench_requirements.txt``; it runs ``ogbench_manipspace.py``.
"""

from __future__ import annotations

from pathlib import Path

from studies.apart import Apart, World

RUNS = Path(__file__).parents[1] / "runs" / "ogbench"
NOISE = 0.1
"""Up to which an episode draws the level of the noise on its controls, as in OGBench's script."""


class ManipSpace(World):
    """Tasks with their scripted oracles, whose phases are labels, and OGBench's own five goals of each.

    :param goal: whether policies observe where all objects are at the end.
    """

    def __init__(self, goal: bool) -> None:
        super().__init__(Apart("ogbench_manipspace.py", "ogbench_requirements.txt", RUNS))
        self.goal = goal

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the first episodes in which the oracle reaches all its targets."""
        options = {"number": count, "held_out": 1, "first": seeds.start, "attempts": len(seeds)}
        self.simulator.run("collect", task, path, **options, noise=NOISE, goal=int(self.goal), labels="phase")


SHOWN, HIDDEN = ManipSpace(goal=True), ManipSpace(goal=False)
