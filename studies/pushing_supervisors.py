"""What the supervisors of the pushing task achieve, and how well their controls can be predicted from the state.

    python studies/pushing_supervisors.py [--seeds 5] [--slow-seeds 3] [--demonstrations 40] [--jobs 2] [--out DIR]

Writes ``supervisors.json`` and ``supervisors.md``: goals and topples in 2000 steps over seeds, and the held-out R² of a
nearest-neighbour regressor and of a neural network on demonstrations of one goal each, split by demonstration, for the
planning supervisor with and without the measures that make its plans functions of the state.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from ddco_tasks.pushing import environment as pushing
from ddco_tasks.pushing.planner import Planner
from ddco_tasks.pushing.supervisor import SHAKIER, WayPoints, policy
from joblib import Parallel, delayed
from provenance import record, sentence, text
from scipy import stats
from sklearn.model_selection import GroupKFold
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.data.files import write_text
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import Task

SLOW = ("supervisor_every_step", "supervisor_every_step_noisy")
MINDS = {
    "way points": lambda: WayPoints(),
    "repeatable plans": lambda: Planner(),
    "plain planner": lambda: Planner(repeatable=False),
    "plain planner, every step": lambda: Planner("every_step", repeatable=False),
}
OBSERVATIONS = ("joint_angles", "tip", "box_from_tip", "goal_from_box", "goal")
HANDS = (0.0, SHAKIER[0])  # rad/s: exact, and as in the demonstrations of the studies
FOLDS = 5


def play(name: str, seed: int) -> dict[str, float]:
    """Counts of one episode of 2000 steps, and control steps per second of wall time."""
    start = time.perf_counter()
    episode = run_episode(pushing.task, name, seed)
    return {**episode.outcome, "steps_per_second": len(episode.record) / (time.perf_counter() - start)}


def demonstrate(mind: str, noise: float, seed: int) -> tuple[Demonstration, float]:
    """A demonstration of one goal, and whether it succeeded."""
    task: Task = dataclasses.replace(pushing.single, policies={mind: policy(MINDS[mind], noise)})
    episode = run_episode(task, mind, seed)
    return episode.record, episode.outcome["success"]


def predictability(demonstrations: list[Demonstration]) -> dict[str, dict[str, Any]]:
    """Held-out R² of the controls, variance-weighted over joints, mean over folds with a 95 % t interval."""
    inputs = np.concatenate([np.hstack([one.observations[key] for key in OBSERVATIONS]) for one in demonstrations])
    controls = np.concatenate([one.actions for one in demonstrations])
    groups = np.concatenate([np.full(len(one), number) for number, one in enumerate(demonstrations)])
    models = {
        "nearest neighbours": KNeighborsRegressor(5, weights="distance"),
        "network": MLPRegressor(hidden_layer_sizes=(128, 128), early_stopping=True, max_iter=300, random_state=0),
    }
    scores: dict[str, list[float]] = {name: [] for name in models}
    for train, test in GroupKFold(FOLDS).split(inputs, groups=groups):
        for name, model in models.items():
            fitted = make_pipeline(StandardScaler(), model).fit(inputs[train], controls[train])
            scores[name].append(float(r_squared(controls[test], fitted.predict(inputs[test]))))
    return {name: mean(values) for name, values in scores.items()}


def r_squared(true: np.ndarray, predicted: np.ndarray) -> float:
    """1 − residual over total sum of squares, all joints together."""
    return float(1.0 - np.sum((true - predicted) ** 2) / np.sum((true - true.mean(axis=0)) ** 2))


def mean(values: list[float]) -> dict[str, Any]:
    """Mean with its 95 % t interval."""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    centre = float(np.mean(values))
    return {"mean": centre, "interval": [float(centre - half), float(centre + half)], "trials": len(values)}


def measure_supervisors(arguments: argparse.Namespace) -> dict[str, Any]:
    """Goals, topples and speed of every scripted policy of the task."""
    found = {}
    for name in pushing.task.policies:
        seeds = range(arguments.slow_seeds if name in SLOW else arguments.seeds)
        outcomes = Parallel(n_jobs=arguments.jobs)(delayed(play)(name, seed) for seed in seeds)
        measures = ("goals", "topples", "lost", "steps_per_second")
        found[name] = {key: mean([one[key] for one in outcomes]) for key in measures}
        print(name, found[name], flush=True)
    return found


def measure_predictability(arguments: argparse.Namespace) -> dict[str, Any]:
    """How well the controls of each mind can be predicted, with an exact and an inexact hand."""
    results = {}
    for mind, noise in itertools.product(arguments.minds, HANDS):
        seeds = range(arguments.demonstrations)
        found = Parallel(n_jobs=arguments.jobs)(delayed(demonstrate)(mind, noise, seed) for seed in seeds)
        row = predictability([record for record, _ in found])
        row["success"] = {"mean": float(np.mean([success for _, success in found])), "trials": len(found)}
        results[f"{mind}, hand {noise} rad/s"] = row
        print(mind, noise, row, flush=True)
    return results


PARTS = {"supervisors": measure_supervisors, "predictability": measure_predictability}


def table(results: dict[str, Any]) -> str:
    """The numbers as Markdown."""
    lines = []
    if "supervisors" in results:
        lines += [made_by(results, "supervisors"), ""]
        lines += ["Mean and 95 % t interval over seeds of an episode of 2000 steps.", ""]
        lines += [
            "| supervisor | goals | topples | lost | control steps per second | seeds |",
            "|---|---|---|---|---|---|",
        ]
        for name, one in results["supervisors"].items():
            cells = [spread(one[key], "{:.1f}") for key in ("goals", "topples", "lost")]
            speed = f"{one['steps_per_second']['mean']:.0f}"
            lines.append(f"| {' | '.join([name, *cells, speed, str(one['goals']['trials'])])} |")
        lines.append("")
    if "predictability" in results:
        lines += [made_by(results, "predictability"), ""]
        lines += [f"Held-out R² of the controls, mean and 95 % t interval over {FOLDS} folds by demonstration.", ""]
        lines += ["| supervisor | nearest neighbours | network | success | demonstrations |", "|---|---|---|---|---|"]
        for name, one in results["predictability"].items():
            cells = [spread(one[key], "{:.2f}") for key in ("nearest neighbours", "network")]
            success = one["success"]
            lines.append(f"| {' | '.join([name, *cells, format(success['mean'], '.2f'), str(success['trials'])])} |")
    return "\n".join(lines) + "\n"


def made_by(results: dict[str, Any], part: str) -> str:
    """The line that says what made a part."""
    one = results[f"{part}_made_by"]
    return sentence(one["command"], [one])


def spread(one: dict[str, Any], form: str) -> str:
    """A mean and its interval in a few characters."""
    low, high = one["interval"]
    return f"{form.format(one['mean'])} [{form.format(low)}, {form.format(high)}]"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--slow-seeds", type=int, default=3, help="for the policies that plan at every step")
    parser.add_argument("--demonstrations", type=int, default=40)
    parser.add_argument("--minds", nargs="+", default=tuple(MINDS), choices=MINDS, help="whose controls are predicted")
    parser.add_argument("--parts", nargs="+", default=tuple(PARTS), choices=PARTS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/results/pushing"))
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    path = arguments.out / "supervisors.json"
    results: dict[str, Any] = json.loads(path.read_text())["results"] if path.exists() else {}
    for part in arguments.parts:
        results[f"{part}_made_by"] = record(shlex.join(["python", *sys.argv]))
        results[part] = PARTS[part](arguments)
    write_text(path, text(results, (results[f"{part}_made_by"] for part in PARTS if part in results)))
    write_text(path.with_suffix(".md"), table(results))
    print(table(results))


if __name__ == "__main__":
    main()
