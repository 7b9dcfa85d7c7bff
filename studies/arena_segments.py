"""Agreement of segments with phases: options beside segmentation without a hierarchy."""

from __future__ import annotations

from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Scores as Measures
from ddco_pyro.segmenting.baselines import BASELINES, segment
from ddco_pyro.training.data import parts

OURS = "ddco"
MEASURES = ("nmi", "ari", "accuracy", "iou", "f1_10", "f1_25", "f1_50", "edit", "boundary_f1_1", "boundary_f1_3",
            "boundary_f1_5")  # fmt: skip
Scores = dict[str, float]


def scored(fitted: Fit, labels: str) -> dict[str, Scores]:
    """Measures on held-out demonstrations of the lowest level's options and of every baseline with as many kinds."""
    train, valid = parts(fitted.spec, fitted.demonstrations).values()
    hierarchy, truth = fitted.spec.hierarchy, [demo.labels[labels] for demo in valid]
    assert hierarchy is not None  # it is what init writes
    count, observations = hierarchy.levels[0].count, fitted.spec.observations
    segments = {OURS: fitted.segment(valid)[0]}
    segments |= {name: segment(name, train, valid, count, fitted.spec.seed, observations) for name in BASELINES}
    return {name: flat(agreement(own, truth)) for name, own in segments.items()}


def flat(measures: Measures | None) -> Scores:
    """Each measure as a number, options matched globally where they are."""
    assert measures is not None  # every step of the arena has a phase
    both = dict(measures) | dict(measures.matched_globally)
    return {name: float(both[name]) for name in MEASURES}
