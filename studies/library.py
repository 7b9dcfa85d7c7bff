"""Libraries of Meta-World's tasks, and new tasks that begin with them (``world: library:WORLD``).

python -m studies.library    # records their demonstrations and fits them, into runs/metaworld
"""

from __future__ import annotations

from dataclasses import replace

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.library import dimensions_for, prior_of
from ddco_pyro.spec import load_spec, with_overrides
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
        self.methods["frozen"] = self._frozen

    def _frozen(self, job: Job) -> dict[str, float]:
        """Options stay as in the library; terminations and the meta-policy are drawn towards it."""
        spec = with_overrides(job.spec, {"training.library": job.settings})
        train = job.demos.select(job.demos.masks["train"])
        trainer = Trainer(spec, dimensions_for(spec, job.demos), train, train, library=prior_of(spec))
        model, restart = trainer.data.hierarchy(0), Restart(Progress(0))
        training = StageTraining(trainer.data, model, Stage("gates", None, None, CHOOSING), restart, last=True)
        while not training.converged:
            training.epoch(None)
        training.end(None)
        return means(self.play(job.cell.task, Fit(spec, model), job.starts, job.folder))


WORLD = NewTasks()


def make() -> None:
    """Record the demonstrations, and fit options and baselines of each library to all of its tasks together."""
    files = {task: RUNS / "library_demonstrations" / f"{task}.hdf5" for task in TASKS}
    for task, path in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            WORLD.collect(task, SEEDS, EACH, path)
    demos = [_named(demo, task) for task, path in files.items() for demo in Demonstrations.read(path)]
    for name, changes in LIBRARIES.items():
        fit(load_spec(SPEC, changes), Demonstrations(tuple(demos)), RUNS / name)


def _named(demo: Demonstration, task: str) -> Demonstration:
    return replace(demo, name=f"{task}_{demo.name}", attributes={**demo.attributes, "task": task})


if __name__ == "__main__":
    make()
