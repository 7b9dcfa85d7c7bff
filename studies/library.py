"""Libraries of Meta-World's tasks, and new tasks that begin with them (``world: library:WORLD``).

python -m studies.library    # records their demonstrations and fits them, into runs/metaworld
"""

from __future__ import annotations

from dataclasses import replace

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import only_one
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.library import dimensions_for, prior_of
from ddco_pyro.spec import load_spec, parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.loop import StageTraining
from ddco_pyro.training.restarts import Trainer
from ddco_pyro.training.stages import Stage
from studies.apart import means
from studies.cells import ROOT, Job
from studies.sawyer import RUNS, SIMULATOR, MetaWorld

TASKS = (
    "pick-place-v3",
    "assembly-v3",
    "shelf-place-v3",
    "stick-pull-v3",
    "hammer-v3",
    "disassemble-v3",
    "basketball-v3",
    "hand-insert-v3",
    "sweep-into-v3",
    "drawer-open-v3",
)
"""The tasks on which something here was chosen: those of the library."""

EACH, SEEDS = 10, range(70_000_000, 70_000_500)
"""Demonstrations of each task, and the seeds of the expert's episodes."""

SPEC = ROOT / "specs" / "metaworld_library.yaml"

LIBRARIES = {"library": (), "library_clusters": ("training.starts=[vq_controls]",)}
"""The run of each study, library.yaml and library_again.yaml, and what it changes in the spec."""

CHOOSING = ("levels.0.termination.", "meta_policy.")
"""What is trained where options are frozen."""


class NewTasks(MetaWorld):
    """Meta-World, with options of a library that are frozen as a method of its own."""

    def __init__(self) -> None:
        super().__init__(SIMULATOR)
        self.methods |= {"frozen": self._frozen, "pooled": self._pooled}

    def _frozen(self, job: Job) -> dict[str, float]:
        """Options stay as in the library; terminations and the meta-policy are drawn towards it."""
        spec = with_overrides(job.spec, {"training.library": job.settings})
        train = job.demos.select(job.demos.masks["train"])
        trainer = Trainer(spec, dimensions_for(spec, job.demos), train, train, library=prior_of(spec))
        model, restart = trainer.data.hierarchy(0), Restart(Progress(0))
        stage = Stage("gates", None, None, CHOOSING)
        training = StageTraining(trainer.data, model, stage, restart, last=True)
        while not training.converged:
            training.epoch(None)
        training.end(None)
        return means(self.play(job.cell.task, Fit(spec, model), job.starts, job.folder))

    def _pooled(self, job: Job) -> dict[str, float]:
        """Agreement in the cell's task of a fit of its demonstrations and of the library's other tasks."""
        others = [demo for task, each in recorded().items() if task != job.cell.task for demo in each]
        folder = job.folder.parents[1] / "demonstrations"
        (file,) = folder.glob(f"{job.cell.task}-*.hdf5")  # with all it has
        own = [_named(demo, job.cell.task) for demo in Demonstrations.read(file).select(job.demos.names)]
        held_out = tuple(f"{job.cell.task}_{name}" for name in job.demos.masks["valid"])
        path = job.folder / "pooled.hdf5"
        Demonstrations((*own, *others), {"valid": held_out}).write(path)
        spec = parse_spec(read_yaml(starting_spec(inspect(path), path).text))
        found = fit(with_overrides(spec, job.settings), path, out=job.folder / "fit").metrics.agreement
        scores = found and found.valid and found.valid[0]
        return {"nmi": scores.nmi} if scores else {}


WORLD = NewTasks()


def recorded() -> dict[str, list[Demonstration]]:
    """The library's demonstrations of each task, recorded where they are not there."""
    found = {}
    for task in TASKS:
        path = RUNS / "library_demonstrations" / f"{task}.hdf5"
        with only_one(path.parent, wait=True):
            if not path.exists():
                WORLD.collect(task, SEEDS, EACH, path)
        found[task] = [_named(demo, task) for demo in Demonstrations.read(path)]
    return found


def make() -> None:
    """Fit options and baselines of each library to all of its tasks together."""
    demos = [demo for each in recorded().values() for demo in each]
    for name, changes in LIBRARIES.items():
        fit(load_spec(SPEC, changes), Demonstrations(tuple(demos)), RUNS / name)


def _named(demo: Demonstration, task: str) -> Demonstration:
    return replace(demo, name=f"{task}_{demo.name}", attributes={**demo.attributes, "task": task})


if __name__ == "__main__":
    make()
