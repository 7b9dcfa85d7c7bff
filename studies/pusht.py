"""PushT as the world of a study (``world: pusht:WORLD``): an environment of its own, and people's demonstrations.

The environment is made in ``runs/pusht/venv`` from ``pusht_requirements.txt``; ``pusht_gym.py`` runs in it.
"""

from __future__ import annotations

from pathlib import Path

from apart import Apart, World

RUNS = Path(__file__).parents[1] / "runs" / "pusht"
WORLD = World(Apart("pusht_gym.py", "pusht_requirements.txt", RUNS))
