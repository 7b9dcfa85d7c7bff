"""One cell of pushing from pictures: a method, its options, a number of demonstrations and a training seed.

    python studies/pushing_pictures_cell.py METHOD OPTIONS COUNT SEED [--updates 4000] [--episodes 5] [--runs DIR]

OPTIONS is 0 for a flat policy. Demonstrations and evaluation episodes are those of ``pushing_studies.py`` with the same
seeds. Pictures are drawn three times as fine as they are seen, 48 x 64, and reduced by means. Keeps a JSON with
held-out log-likelihoods, what came of each episode, without a limit and with 250 steps for each goal, and the seconds
that everything took.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
from cells import Cell, Settings
from ddco_tasks.pushing import environment as pushing
from pushing_cell import EVALUATION, HELD_OUT, HELD_OUT_SEED, LABELS, POOL, TRAINING, per_step, summary

from ddco_pyro.acting.lockstep import play
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import Transform
from ddco_pyro.fitting.building import Dimensions, baseline_spec, parameters
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.fitting.run import train
from ddco_pyro.simulation.cameras import Camera
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import Spec, load_spec, with_overrides

SPECS = Path(__file__).parents[1] / "specs"
SIZE, FINER = (48, 64), 3
SUPERVISOR = "scripted_noisy_0.3"

METHODS = ("ff", "ff_flat", "ff_hybrid", "ff_two", "ff_two_flat", "rnn", "rnn_flat", "rnn_hybrid")
"""``_flat``: as many parameters as the hierarchy beside it has with the options of its spec; ``ff_two``: of two
pictures side by side instead of one."""

DEFAULTS = Settings({"updates": 4000, "episodes": 5}, Path("runs/pushing-pictures"))
"""Gradient steps of a fit, and what each one plays."""


@dataclass(frozen=True)
class PictureCell(Cell):
    """A method with k options (0: flat), a number of demonstrations, and a training seed."""

    script = "pushing_pictures_cell.py"

    method: str
    options: int
    count: int
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit and play."""
        spec, own = spec_of(self, settings), settings.values
        demos = pool(settings.runs, self.seed)
        demos = demos.select(demos.names[: self.count])
        test, begun = held_out(settings.runs), time.perf_counter()
        size, before = Dimensions.of(demos), time.process_time()
        spec = spec if self.options else baseline_spec(spec, spec.compare_with[0], size)
        trained = train(spec, size, demos, checkpoints=folder)
        fitted, cpu = time.perf_counter(), time.process_time() - before
        found = Fit(spec, trained.hierarchy)
        likelihood = {name: per_step(found, each) for name, each in (("train", demos), ("held_out", test))}
        first = EVALUATION + 1000 * self.seed
        seeds = range(first, first + int(own["episodes"]))
        episodes, limited = (play(task, trained.hierarchy, spec.rollout, seeds) for task in (WATCHED, LIMITED))
        ended = time.perf_counter()
        return {
            "log_likelihood_per_step": likelihood,
            "parameters": parameters(trained.hierarchy),
            "steps": trained.training,
            "episodes": summary(episodes),
            "limited": summary(limited),
            "seconds": {"fit": fitted - begun, "fit_processor": cpu, "play": ended - fitted},
        }


def spec_of(cell: PictureCell, settings: Settings) -> Spec:
    """The spec of a cell, whose pictures are small already."""
    family = cell.method.partition("_")[0]
    kind = "_hybrid" if cell.method.endswith("_hybrid") else ""
    changed: dict[str, Any] = {"seed": cell.seed, "demonstrations.count": cell.count}
    changed |= {"observations.0.resize": None, "observations.0.frames": 2 if "_two" in cell.method else 1}
    if cell.options:
        changed["hierarchy.levels.0.count"] = cell.options
    spec = with_overrides(load_spec(SPECS / f"pushing_image_{family}{kind}.yaml", settings.overrides), changed)
    trained = cell.count - max(1, round(cell.count * spec.training.tune_fraction))
    epochs = int(np.ceil(settings.values["updates"] / np.ceil(trained / spec.training.batch_size)))
    return with_overrides(spec, {"training.epochs": epochs})


def _finely_drawn(environment: dm_env.Environment) -> np.ndarray:
    """The scene, drawn finer than it is seen and reduced by means: edges tell where things are between two pixels."""
    height, width = SIZE
    drawn = pushing.camera(FINER * height, FINER * width).draw(environment)
    return Transform(resize=SIZE)(drawn[None])[0]


CAMERA = Camera(SIZE, _finely_drawn)
WATCHED = replace(pushing.task, cameras={"camera": CAMERA})
SINGLE = replace(pushing.single, cameras={"camera": CAMERA})
LIMITED = replace(pushing.limited, cameras={"camera": CAMERA})


def pool(folder: Path, seed: int) -> Demonstrations:
    """All demonstrations of a training seed; a cell takes the first ones."""
    return recorded(folder, TRAINING + 1000 * seed, POOL)


def held_out(folder: Path) -> Demonstrations:
    """Demonstrations that nothing is trained on."""
    return recorded(folder, HELD_OUT_SEED, HELD_OUT)


def recorded(folder: Path, first: int, count: int) -> Demonstrations:
    """Demonstrations of one goal each from seeds ``first`` on, with pictures and labels in memory; kept in a file."""
    path = folder / "demonstrations" / f"{first}.hdf5"
    if not path.exists():
        seeds = range(first, first + count)
        episodes = [run_episode(SINGLE, SUPERVISOR, seed, observed=["camera"], keep=["camera"]) for seed in seeds]
        Demonstrations(tuple(one.record for one in episodes)).write(path)
    kept = Demonstrations.read(path, labels=LABELS)
    return replace(kept, demonstrations=tuple(map(_in_memory, kept)))


def _in_memory(demo: Demonstration) -> Demonstration:
    """So small that it need not be read from the file in each epoch."""
    return replace(demo, observations={key: np.asarray(values) for key, values in demo.observations.items()})


if __name__ == "__main__":
    PictureCell.main(__doc__, DEFAULTS, method=METHODS)
