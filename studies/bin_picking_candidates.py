"""The classifier of grasp candidates: labelled images, its weights, and its precision on other images.

    python studies/bin_picking_candidates.py [--images 40] [--others 20] [--candidates 8] [--jobs 2]

An image is a pile of 3 to 8 objects; its labels are what came of simulated grasps at points drawn on what is seen, one
after another from the same pile: a person would have marked them by hand. Writes the weights that the task reads
(``tasks/bin_picking/grasp_classifier.json``), and ``docs/results/bin_picking/candidates.json`` and ``.md``. With no
images to label (``--images 0``) the weights that are there are measured.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import rates
from ddco_tasks import psm
from ddco_tasks.bin_picking import camera, candidates, supervisor
from ddco_tasks.bin_picking.environment import load
from ddco_tasks.bin_picking.physics import MOVE_TIME, SETTLE_TIME, Physics
from joblib import Parallel, delayed
from provenance import record, sentence, text
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from ddco_pyro.data.files import write_text
from ddco_pyro.simulation.episodes import rate

OUT = Path("docs/results/bin_picking")
TRAINING, TESTING = 310_000, 320_000
"""Seeds of the first labelled image, and of the first other one."""
HAND = 0.0004
"""Standard deviation of where the gripper is put, in each direction (m)."""


def labelled(seed: int, count: int) -> dict[str, Any]:
    """Features [N, F] of the grasps drawn on one image, and how many objects each lifted [N]."""
    environment = load(seed)
    environment.reset()
    physics: Physics = environment.physics
    random = np.random.RandomState(seed)
    mask = camera.masks(physics)[..., 0]
    drawn = candidates.draw(mask, random, count)
    before, joints, numbers = physics.get_state(), physics.true_joints(), []
    for candidate in drawn:
        physics.set_state(before)
        physics.place_arm(joints, supervisor.JAW_OPEN)
        numbers.append(lifted(physics, candidate, random))
    environment.close()
    inputs = [candidates.features(mask, candidate) for candidate in drawn]
    return {"features": np.array(inputs), "lifted": np.array(numbers)}


def lifted(physics: Physics, candidate: candidates.Candidate, random: np.random.RandomState) -> int:
    """How many objects are held after a grasp with true kinematics was lifted and shown."""
    grasp = np.array([*candidate.pixel, 0.0, 0.0, np.cos(candidate.turn), np.sin(candidate.turn)])
    offset = HAND * random.standard_normal(3)
    for way_point in supervisor.grasp_plan(grasp):
        pose = psm.Pose(way_point.pose.rotation, way_point.pose.position + offset)
        physics.move_to(physics.command(psm.inverse(pose)), supervisor.JAW_OPEN * way_point.open, np.zeros(6))
        physics.step(round((MOVE_TIME + SETTLE_TIME) / physics.timestep()))
    return len(physics.held())


def fitted(images: list[dict[str, Any]]) -> LogisticRegression:
    """The classifier: does a grasp take anything?"""
    inputs, numbers = joined(images)
    return LogisticRegression(max_iter=1000).fit(inputs, numbers > 0)


def as_it_is() -> LogisticRegression:
    """The task's classifier."""
    kept, model = candidates.Classifier.load(), LogisticRegression()
    model.coef_, model.intercept_ = kept.weights[None], np.array([kept.intercept])
    model.classes_ = np.array([False, True])
    return model


def joined(images: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Features and numbers of all grasps."""
    return np.vstack([one["features"] for one in images]), np.concatenate([one["lifted"] for one in images])


def measured(model: LogisticRegression, images: list[dict[str, Any]]) -> dict[str, Any]:
    """What came of all grasps drawn on images, and of the better half on each, from which the task takes its own."""
    inputs, numbers = joined(images)
    better = np.concatenate([_better_half(model, one) for one in images])
    return {
        "area under the curve": float(roc_auc_score(numbers > 0, model.predict_proba(inputs)[:, 1])),
        "all drawn": _counted(numbers),
        "better half": _counted(better),
    }


def _better_half(model: LogisticRegression, image: dict[str, Any]) -> np.ndarray:
    ranked = np.argsort(-model.predict_proba(image["features"])[:, 1], kind="stable")
    return np.asarray(image["lifted"][ranked[: len(ranked) // 2]])


def _counted(numbers: np.ndarray) -> dict[str, Any]:
    something = rate(int((numbers > 0).sum()), len(numbers))
    return {"takes something": something, "takes exactly one": rate(int((numbers == 1).sum()), len(numbers))}


def page(results: dict[str, Any], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", "| grasps on other images | takes something | takes exactly one |", "|---|---|---|"]
    for name in ("all drawn", "better half"):
        cells = [rates.shown(results["testing"][name][key]) for key in ("takes something", "takes exactly one")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    area = results["testing"]["area under the curve"]
    own = "" if results["training"] is None else f", on its own {results['training']:.2f}"
    lines += ["", f"Area under the curve on other images {area:.2f}{own}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--others", type=int, default=20)
    parser.add_argument("--candidates", type=int, default=8)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    sizes = f"--images {arguments.images} --others {arguments.others} --candidates {arguments.candidates}"
    command = f"python studies/bin_picking_candidates.py {sizes}"
    seeds = [*range(TRAINING, TRAINING + arguments.images), *range(TESTING, TESTING + arguments.others)]
    images = Parallel(n_jobs=arguments.jobs, verbose=5)(delayed(labelled)(seed, arguments.candidates) for seed in seeds)
    own, others = images[: arguments.images], images[arguments.images :]
    model = fitted(own) if own else as_it_is()
    if own:
        weights = {"weights": model.coef_[0].tolist(), "intercept": float(model.intercept_[0])}
        write_text(candidates.WEIGHTS, json.dumps(weights, indent=1) + "\n")
    made_by = record(command)  # with the weights, which are part of the task
    training = measured(model, own)["area under the curve"] if own else None
    results = {"training": training, "testing": measured(model, others)}
    shown = page(results, sentence(command, [made_by]))
    write_text(OUT / "candidates.json", text(results, [made_by]))
    write_text(OUT / "candidates.md", shown)
    print(shown)


if __name__ == "__main__":
    main()
