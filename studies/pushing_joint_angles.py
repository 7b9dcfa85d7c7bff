"""Trajectories in joint-angle space: the supervisor's by the goal's side, a fitted hierarchy's by its active option.

    python studies/pushing_joint_angles.py [--demonstrations 40] [--seed 0] [--seeds 5] [--options 2 4] [--runs DIR]
        [--out DIR]

After the paper's figure of backhand and forehand (SM 1.1). The hierarchies are cells of ``pushing_studies.py``, which
are fitted if they have not been. Writes ``joint_angles.png``, and ``joint_angles.json``: how far option and side agree
in rollouts, and how far the segments of held-out demonstrations agree with the supervisor's side, phase and both.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from ddco_tasks.pushing import environment as pushing
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from provenance import record, text
from pushing_cell import EVALUATION, LABELS, Cell, fit_made_by, fitted, held_out, pool, spec_of
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import whole_file, write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.episodes import play

EPISODES = 3
SIDES = ("goal on the left (backhand)", "goal on the right (forehand)")
PROJECTIONS = ((0, 1), (0, 2))
JOINTS = ("shoulder", "elbow", "wrist")

Coloured = tuple[np.ndarray, np.ndarray]
"""Joint angles [T, 3] and the choice at each step [T]."""


def draw(panels: dict[str, tuple[Sequence[Coloured], dict[int, str]]]) -> Figure:
    """One row of projections for each panel, coloured by the choice."""
    figure = Figure(figsize=(9, 3.6 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    for row, (title, (trajectories, names)) in zip(
        figure.subplots(len(panels), len(PROJECTIONS), squeeze=False), panels.items(), strict=True
    ):
        for axes, (across, up) in zip(row, PROJECTIONS, strict=True):
            for choice, name in names.items():
                points = np.concatenate([angles[choices == choice] for angles, choices in trajectories])
                axes.plot(points[:, across], points[:, up], ".", ms=1.2, color=option_colour(choice), label=name)
            axes.set(xlabel=f"{JOINTS[across]} (rad)", ylabel=f"{JOINTS[up]} (rad)", title=title)
        row[-1].legend(markerscale=8, fontsize=8)
    return figure


def segments(options: int, seed: int, arguments: argparse.Namespace) -> tuple[Demonstrations, np.ndarray]:
    """The held-out demonstrations, and the option of the most likely path at each step, one after the other."""
    cell = Cell("DDCO MLP", options, arguments.demonstrations, seed)
    spec = spec_of(cell)
    demos = held_out(arguments.runs, spec)
    (found,) = Fit(spec, fitted(cell, arguments.runs, arguments.made_by)).segment(demos)
    return demos, found[found >= 0]


def together(demos: Demonstrations, label: str) -> np.ndarray:
    """A label of the supervisor at each step, one demonstration after the other."""
    return np.concatenate([one.labels[label] for one in demos])


def agreement(options: int, seed: int, arguments: argparse.Namespace) -> dict[str, float]:
    """NMI of the most likely segments of the held-out demonstrations with the supervisor's labels, with the side alone
    in the steps in which it pushes and in those in which it approaches, and there with the way the shoulder turns.
    """
    demos, chosen = segments(options, seed, arguments)
    side, pushes = together(demos, "side"), together(demos, "phase") == 1
    turns = np.concatenate([one.actions[:, 0] for one in demos]) > 0
    pairs = {name: (together(demos, name), chosen) for name in LABELS} | {
        "side_while_pushing": (side[pushes], chosen[pushes]),
        "side_while_approaching": (side[~pushes], chosen[~pushes]),
        "shoulder_while_approaching": (turns[~pushes], chosen[~pushes]),
    }
    return {name: float(normalized_mutual_info_score(*pair)) for name, pair in pairs.items()}


def pushing_steps(arguments: argparse.Namespace) -> Coloured:
    """Joint angles and option of the steps of the held-out demonstrations in which the supervisor pushes."""
    demos, chosen = segments(2, arguments.seed, arguments)
    pushes = together(demos, "phase") == 1
    return np.concatenate([one.observations["joint_angles"] for one in demos])[pushes], chosen[pushes]


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="whose rollouts are drawn")
    parser.add_argument("--seeds", type=int, default=5, help="whose segments are compared")
    parser.add_argument("--options", type=int, nargs="+", default=(2, 4))
    parser.add_argument("--runs", type=Path, default=Path("runs/pushing-studies"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/pushing"))
    arguments = parser.parse_args()
    arguments.made_by = record(
        "python studies/pushing_joint_angles.py"
        f" --demonstrations {arguments.demonstrations} --seed {arguments.seed} --seeds {arguments.seeds}"
        f" --options {' '.join(map(str, arguments.options))}"
    )
    torch.set_num_threads(1)
    cell = Cell("DDCO MLP", 2, arguments.demonstrations, arguments.seed)
    hierarchy, first = fitted(cell, arguments.runs, arguments.made_by), EVALUATION + 1000 * arguments.seed
    keep = ("joint_angles", "goal_from_box")
    episodes = play(
        pushing.task, Controller.from_spec(hierarchy, spec_of(cell).rollout), range(first, first + EPISODES), keep=keep
    )
    ours = [(one.record.observations["joint_angles"], one.choices[:, 0]) for one in episodes]
    sides = np.concatenate([one.record.observations["goal_from_box"][:, 0] > 0 for one in episodes])
    options = np.concatenate([choices for _, choices in ours])
    demos = pool(arguments.runs, spec_of(cell))[: arguments.demonstrations]
    goals = [(one.observations["joint_angles"], one.observations["goal_from_box"][:, 0] > 0) for one in demos]
    shown = [(angles, 1 + right) for angles, right in goals]
    names = {number: f"option {number}" for number in np.unique(options)}
    figure = draw(
        {
            f"{len(demos)} demonstrations": (shown, dict(enumerate(SIDES, 1))),
            "held-out demonstrations, pushing steps": ([pushing_steps(arguments)], names),
            f"DDCO MLP, {EPISODES} episodes": (ours, names),
        }
    )
    with whole_file(arguments.out / "joint_angles.png") as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    found = {
        "segments_nmi": {
            str(k): [agreement(k, seed, arguments) for seed in range(arguments.seeds)] for k in arguments.options
        },
        "pushing_share": float(np.mean(together(held_out(arguments.runs, spec_of(cell)), "phase"))),
        "goals": [one.outcome["goals"] for one in episodes],
        "nmi_option_side": float(normalized_mutual_info_score(sides, options)),
        "goal_on_the_right_given_option": {int(o): float(sides[options == o].mean()) for o in np.unique(options)},
    }
    used = [
        Cell("DDCO MLP", k, arguments.demonstrations, seed)
        for k in arguments.options
        for seed in range(arguments.seeds)
    ]
    records = [arguments.made_by, *(fit_made_by(one, arguments.runs) for one in used)]
    write_text(arguments.out / "joint_angles.json", text(found, records))
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
