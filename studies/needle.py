"""Success and held-out log-likelihood on the needle task over training seeds and numbers of demonstrations (SM 1.3).

    python studies/needle.py [--counts 100] [--seeds 10] [--episodes 200] [--fits NAME ...] [--jobs 2]
        [--set KEY=VALUE]...

Every seed has demonstrations of its own; with fewer of them the first are used. The specs of the hierarchy, of the flat
and of the per-timestep policy are fitted to them, the first two also with the time step as an observation
(``ddco_clock``, ``flat_clock``). All are rolled out from the same starts. ``--set`` changes the hierarchy's spec.
A cell (model, number, seed) that was done with these settings is not done again. Adds its numbers to
``docs/results/needle.csv``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import study
from study import Cell, Row, Settings, described

from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.spec import Spec, load_spec

OURS = "ddco"
ALL = 100
"""The demonstrations of a training seed."""
DEMONSTRATIONS, APART, STARTS = 40_000, 1_000, 730_000
"""Seeds: of the first seed's first demonstration, from one training seed to the next, and of the first start."""
STEP = "observations=[gripper_pose, jaw, needle_ellipse, step]"
FITS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "ddco": ("specs/needle.yaml", "", ("compare_with=[flat_equal]",)),
    "flat": ("specs/needle_flat.yaml", "", ()),
    "per_timestep": ("specs/needle_per_timestep.yaml", "", ()),
    "ddco_clock": ("specs/needle.yaml", "_clock", ("compare_with=[]", STEP)),
    "flat_clock": ("specs/needle_flat.yaml", "_clock", (STEP,)),
}
"""Each model as its own spec has it: file, what stands behind the names of its methods, and what is changed."""
DEFAULTS = Settings({"episodes": 200}, Path("runs/needle"))


@dataclass(frozen=True)
class NeedleCell(Cell):
    """A model, how many demonstrations it is trained on, and the training seed."""

    model: str
    count: int
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """The measures of every method that the spec fits, and those of the scripted policies in the first cell."""
        scripted = () if (self.model, self.seed, self.count) == (OURS, 0, ALL) else ("rollout.policies=[]",)
        changes = settings.overrides if self.model.startswith(OURS) else ()
        fitted = fit(spec_of(self.model, self.seed, self.count, (*scripted, *changes)), out=folder)
        roll_out(fitted, int(settings.values["episodes"]), jobs=1)
        metrics = fitted.metrics.model_dump()
        models = {fitted.name: metrics} | metrics["comparison"]
        return {
            "methods": {name: one["measures"] for name, one in metrics["rollouts"]["methods"].items()},
            "nats": {name: one["log_likelihood_per_step"] for name, one in models.items()},
            "converged": {name: one["training"]["converged"] for name, one in models.items()},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Measures of the episodes, and likelihoods."""
        suffix = FITS[self.model][1]
        for method, measures in results["methods"].items():
            for measure, one in measures.items():
                if one["trials"]:
                    value = one["mean"] if "mean" in one else one["rate"]
                    yield Row("needle", "needle", f"{method}{suffix}", self.count, self.seed, measure, value)
        for method, parts in results["nats"].items():
            for part, measure in (("valid", "nats"), ("train", "nats, training")):
                yield Row("needle", "needle", f"{method}{suffix}", self.count, self.seed, measure, parts[part])


def spec_of(model: str, seed: int, count: int, changes: Sequence[str] = ()) -> Spec:
    """The spec of one of :data:`FITS` for so many demonstrations of a training seed, with further changes."""
    file, _, own = FITS[model]
    first = DEMONSTRATIONS + APART * seed
    left_out = ", ".join(f"demo_{first + number}" for number in range(count, ALL))
    data = (f"demonstrations.seed={first}", f"demonstrations.exclude=[{left_out}]")
    return load_spec(file, [f"seed={seed}", *data, f"rollout.seed={STARTS}", *own, *changes])


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a seed before another."""
    return [NeedleCell(*one) for one in ((name, count, seed) for seed, count, name in
            itertools.product(range(own.seeds), own.counts, own.fits))]  # fmt: skip


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[ALL])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--fits", nargs="+", default=list(FITS), choices=FITS)
    study.main("needle", parser, DEFAULTS, cells)


if __name__ == "__main__":
    main()
