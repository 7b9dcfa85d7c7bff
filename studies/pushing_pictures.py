"""Pushing from pictures (paper §5.1, SM 1.2, SM 1.5): goals against demonstrations, the same of pictures as the
camera has them beside small ones (``large``), against options, and augmentation.

    python studies/pushing_pictures.py demonstrations|large|options|augmentation [--seeds 3]
        [--methods ff ff_flat ...] [--counts 80 40 20 10] [--options 1 2 4] [--updates 4000] [--episodes 5]
        [--set KEY=VALUE]... [--summarize] [--jobs 1] [--runs DIR]

Demonstrations and evaluation episodes are those of ``pushing.py`` with the same seeds. Pictures are drawn three times
as fine as they are seen, 48 x 64, and reduced by means. ``ff_large`` sees all of 480 x 640, which takes a GPU, or 4 s
of processor time for each gradient step. All pictures have to be in memory, 0.9 MB each (``DDCO_PYRO_MEMORY=18GB``
allows 80 demonstrations). Fits are done on a GPU where there is one. A cell that was done with these settings
is not done again. Adds its numbers to ``docs/results/pushing_pictures.csv``.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
import study
from ddco_tasks.pushing import environment as pushing
from pushing import EVALUATION, HELD_OUT, HELD_OUT_SEED, LABELS, POOL, TRAINING, per_step, summary
from study import Cell, Row, Settings, described

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import Transform
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.cameras import Camera
from ddco_pyro.simulation.episodes import play, run_episode
from ddco_pyro.simulation.task import Task
from ddco_pyro.spec import Spec, load_spec, with_overrides
from ddco_pyro.training.devices import device_of
from ddco_pyro.training.networks import Dimensions, baseline_spec, parameters
from ddco_pyro.training.restarts import Trainer, train_model

SPECS = Path(__file__).parents[1] / "specs"
SIZE, FINER, LARGE = (48, 64), 3, (480, 640)
SUPERVISOR = "scripted_noisy_0.3"

METHODS = {
    **dict.fromkeys(("ff", "ff_flat", "ff_two", "ff_two_flat", "ff_large", "ff_large_flat"), "pushing_image_ff"),
    **dict.fromkeys(("rnn", "rnn_flat"), "pushing_image_rnn"),
    **{"ff_hybrid": "pushing_image_ff_hybrid", "rnn_hybrid": "pushing_image_rnn_hybrid"},
}
"""The spec of each method. ``_flat``: as many parameters as the hierarchy beside it has with the options of its spec;
``ff_two``: of two pictures side by side instead of one; ``ff_large``: of pictures as the camera has them."""

REDUCING = [{"filters": 16, "kernel": 5, "stride": 5}, {"filters": 16, "kernel": 5, "stride": 2, "padding": 2}]
"""Two convolutions before those of the spec, by which pictures of ``LARGE`` have maps of ``SIZE``: a network of
``ff_large`` learns to reduce its pictures."""

DEVELOPMENT = 7
"""The first training seed by which nothing but settings is chosen."""

DEFAULTS = Settings({"updates": 4000, "episodes": 5}, Path("runs/pushing-pictures"))
"""Gradient steps of a fit, and what each one plays."""


@dataclass(frozen=True)
class PictureCell(Cell):
    """A method with k options (0: flat), a number of demonstrations, and a training seed."""

    method: str
    options: int
    count: int
    seed: int

    def __post_init__(self) -> None:
        """:raises BadInput: a flat policy has options, or a hierarchy has none."""
        flat = self.method.endswith("_flat")
        if self.options != 0 if flat else self.options < 1:
            allowed = "0, as it is a flat policy" if flat else "1 or more; flat policies are methods of their own"
            raise BadInput(f"{self.method} with {self.options} options: it has to be {allowed}")

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit and play."""
        device_of(spec_of(self, settings).training)  # what is wrong is said before anything is drawn
        own, tasks = settings.values, (watched(pushing.task, self.camera), watched(pushing.limited, self.camera))
        demos, test = self.demonstrations(settings), held_out(settings.runs, self.seed, self.camera)
        begun, before = time.perf_counter(), time.process_time()
        spec, trained = self.fitted(settings, demos, folder)
        fitted, cpu = time.perf_counter(), time.process_time() - before
        found = Fit(spec, trained.hierarchy)
        likelihood = {name: per_step(found, each) for name, each in (("train", demos), ("held_out", test))}
        first = EVALUATION + 1000 * self.seed
        seeds = range(first, first + int(own["episodes"]))
        controller = Controller.from_spec(trained.hierarchy, spec.rollout)
        observed = trained.hierarchy.encoder.shapes
        episodes, limited = (play(task, controller, seeds, observed) for task in tasks)
        ended = time.perf_counter()
        return {
            "std": spec.control.std,
            "log_likelihood_per_step": likelihood,
            "parameters": parameters(trained.hierarchy),
            "steps": trained.summary,
            "unlimited": summary(episodes),
            "limited": summary(limited),
            "seconds": {"fit": fitted - begun, "fit_processor": cpu, "play": ended - fitted},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Means over episodes, and the likelihoods."""
        method = self.method + (f", k = {self.options}" if self.options else "")
        named = "pushing_pictures", f"σ = {results['std']:g}", method, self.count, self.seed
        own, limited = results["unlimited"], results["limited"]
        yield Row(*named, "goals", float(np.mean(own["goals"])))
        yield Row(*named, "goals, 250 steps each", float(np.mean(limited["goals"])))
        yield Row(*named, "topples", float(np.mean(own["topples"])))
        yield Row(*named, "nats", results["log_likelihood_per_step"]["held_out"])
        yield Row(*named, "nats, training", results["log_likelihood_per_step"]["train"])
        if own["dwell"] is not None:
            yield Row(*named, "steps an option lasts", own["dwell"])
            yield Row(*named, "steps under own control", own["own_control"])

    @property
    def camera(self) -> Camera:
        """What it sees."""
        return Camera(LARGE, pushing.camera(*LARGE).draw) if self.method.startswith("ff_large") else CAMERA

    def demonstrations(self, settings: Settings) -> Demonstrations:
        """What is trained with."""
        if self.camera is CAMERA:
            demos = pool(settings.runs, self.seed)
            return demos.select(demos.names[: self.count])
        return drawn(self.camera, TRAINING + 1000 * self.seed, self.count)

    def fitted(self, settings: Settings, demos: Demonstrations, folder: Path) -> tuple[Spec, Trainer]:
        """The fit, which is done only once."""
        spec, size = spec_of(self, settings), Dimensions.of(demos)
        spec = spec if self.options else baseline_spec(spec, spec.compare_with[-1], size)
        return spec, train_model(spec, size, demos, checkpoints=folder)


def spec_of(cell: PictureCell, settings: Settings) -> Spec:
    """The spec of a cell, whose pictures are small already."""
    changed: dict[str, Any] = {"seed": cell.seed, "demonstrations.count": cell.count}
    if cell.options:
        changed["hierarchy.levels.0.count"] = cell.options
    changed |= {"observations.0.resize": None, "observations.0.frames": 2 if "_two" in cell.method else 1}
    base = load_spec(SPECS / f"{METHODS[cell.method]}.yaml", ["training.device=auto", *settings.overrides])
    if cell.method.startswith("ff_large"):
        changed |= _large(base)
    spec = with_overrides(base, changed)
    trained = cell.count - max(1, round(cell.count * spec.training.tune_fraction))
    epochs = int(np.ceil(settings.values["updates"] / np.ceil(trained / spec.training.batch_size)))
    return with_overrides(spec, {"training.epochs": epochs})


def _large(spec: Spec) -> dict[str, Any]:
    """What a spec is changed to where its pictures are ten times as large, in the hierarchy and in its baseline."""
    layers = [layer.model_dump(exclude_defaults=True) for layer in spec.hierarchy.trunk.of["camera"].layers]
    places = ("hierarchy.trunk", "compare_with.0.policy")
    shift = LARGE[0] // SIZE[0] * spec.observations[0].augment.shift
    return {f"{place}.of.camera.layers": REDUCING + layers for place in places} | {
        "observations.0.augment.shift": shift
    }


def _finely_drawn(environment: dm_env.Environment) -> np.ndarray:
    """The scene, drawn finer than it is seen and reduced by means: edges tell where things are between two pixels."""
    height, width = SIZE
    drawn = pushing.camera(FINER * height, FINER * width).draw(environment)
    return Transform(resize=SIZE)(drawn[None])[0]


CAMERA = Camera(SIZE, _finely_drawn)


def watched(task: Task, camera: Camera = CAMERA) -> Task:
    """The task with a camera that policies may look at."""
    return replace(task, cameras={"camera": camera})


def pool(folder: Path, seed: int) -> Demonstrations:
    """All demonstrations of a training seed; a cell takes the first ones."""
    return recorded(folder, TRAINING + 1000 * seed, POOL)


def held_out(folder: Path, seed: int, camera: Camera = CAMERA) -> Demonstrations:
    """Demonstrations that nothing is trained on; others for a development seed."""
    first = HELD_OUT_SEED + 1000 * (seed >= DEVELOPMENT)
    return recorded(folder, first, HELD_OUT) if camera is CAMERA else drawn(camera, first, HELD_OUT)


def recorded(folder: Path, first: int, count: int) -> Demonstrations:
    """Demonstrations of one goal each from seeds ``first`` on, with pictures and labels in memory; kept in a file."""
    path = folder / "demonstrations" / f"{first}.hdf5"
    if not path.exists():
        drawn(CAMERA, first, count).write(path)
    kept = Demonstrations.read(path, labels=LABELS)
    return replace(kept, demonstrations=tuple(map(_in_memory, kept)))


def drawn(camera: Camera, first: int, count: int) -> Demonstrations:
    """Demonstrations of one goal each from seeds ``first`` on, in memory and nowhere else."""
    task, seeds = watched(pushing.single, camera), range(first, first + count)
    episodes = [run_episode(task, SUPERVISOR, seed, observed=["camera"], keep=["camera"]) for seed in seeds]
    return Demonstrations(tuple(one.record for one in episodes))


def _in_memory(demo: Demonstration) -> Demonstration:
    """So small that it need not be read from the file in each epoch."""
    return replace(demo, observations={key: np.asarray(values) for key, values in demo.observations.items()})


STUDIES = {
    "demonstrations": ("ff_flat", "ff", "rnn_flat", "rnn", "ff_two_flat", "ff_two"),
    "large": ("ff_flat", "ff_large_flat", "ff", "ff_large"),
    "options": ("ff", "rnn"),
    "augmentation": ("ff", "ff_hybrid", "rnn", "rnn_hybrid"),
}
"""The methods of each."""
OWN_OPTIONS = {"ff": 2, "rnn": 4}
"""What the supplement says; the text has them the other way round."""
COUNT = 40
"""Demonstrations where their number is not what is varied."""


def cells(own: argparse.Namespace) -> Sequence[PictureCell]:
    """All of a study, one seed after the other."""
    methods = [name for name in STUDIES[own.study] if name in own.methods]
    if own.study in ("options", "augmentation"):
        grid = itertools.product(range(own.seeds), own.options, methods)
        return [PictureCell(name, options, COUNT, seed) for seed, options, name in grid]
    grid = itertools.product(range(own.seeds), own.counts, methods)
    return [PictureCell(name, own_options(name), count, seed) for seed, count, name in grid]


def own_options(method: str) -> int:
    """How many a method has where their number is not what is varied."""
    return 0 if method.endswith("_flat") else OWN_OPTIONS[method.partition("_")[0]]


def main() -> None:
    """Run one study."""
    parser = described(__doc__)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--counts", type=int, nargs="+", default=[80, 40, 20, 10])
    parser.add_argument("--options", type=int, nargs="+", default=[1, 2, 4])
    study.main("pushing_pictures", parser, DEFAULTS, cells)


if __name__ == "__main__":
    main()
