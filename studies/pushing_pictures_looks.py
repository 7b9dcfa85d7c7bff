"""What a policy that pushes from pictures looks at, in an episode in which it acts.

    python studies/pushing_pictures_looks.py METHOD OPTIONS COUNT SEED CHECKPOINTS [--updates 4000] [--episodes 5]
        [--runs DIR]

The cell of ``pushing_pictures_cell.py`` with these words; CHECKPOINTS is the folder of its fit, as that leaves it in
``RUNS/fits``, from which the networks are taken. Plays the cell's evaluation episodes. Writes ``looks.json``,
``looks.md`` and ``looks.png`` in ``docs/results/pushing_pictures``: of the first episode what the camera sees, paler,
under how much the control of the active option changes with each pixel, and the active option of every step; of each
episode how it went, and in which part of the steps the arm's tip is above what the camera sees; of options, in which
steps of the held-out demonstrations each is the most likely one, by what the supervisor does there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cells import described
from ddco_tasks.pushing import environment as pushing
from matplotlib.figure import Figure
from provenance import record, sentence, text
from pushing_cell import EVALUATION
from pushing_pictures_cell import DEFAULTS, METHODS, PictureCell, held_out, watched

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.saliency import Looking
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.figures import WIDTH, blank, save
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import Policy

OUT = Path("docs/results/pushing_pictures")
COLUMNS, ROWS = 6, 2
TOP = 0.55 + 12 * np.tan(np.deg2rad(7 / 2))
"""Of what is seen in the arm's plane (m): the camera ``side`` of ``pushing.xml``, its height, distance and angle."""


PHASES = ("approach", "push")
"""Of the supervisor, by their label."""


def phases(fit: Fit, demos: Demonstrations) -> dict[str, Any]:
    """NMI of the most likely options with the supervisor's phases, and the steps of each phase in each option."""
    (options,) = fit.segment(demos)
    segments = [row[: len(demo)] for row, demo in zip(options, demos, strict=True)]
    labels = [np.asarray(demo.labels["phase"]) for demo in demos]
    found = agreement(segments, labels)
    assert found is not None
    steps = {name: np.bincount(_of(segments, labels, number))[1:].tolist() for number, name in enumerate(PHASES)}
    return {"nmi": found.nmi, "steps": steps}


def _of(segments: Sequence[np.ndarray], labels: Sequence[np.ndarray], label: int) -> np.ndarray:
    return np.concatenate(segments)[np.concatenate(labels) == label]


def draw(frames: list[np.ndarray], choices: np.ndarray) -> Figure:
    """Pictures evenly over the steps, framed in the colour of the active option, and the options [T] below."""
    height, width = frames[0].shape[:2]
    shown = np.linspace(0, len(frames) - 1, COLUMNS * ROWS).round().astype(int)
    figure = blank(ROWS * (WIDTH / COLUMNS * height / width + 0.25) + 0.9)
    figure.set_layout_engine("constrained")
    grid = figure.add_gridspec(ROWS + 1, COLUMNS, height_ratios=[*[1.0] * ROWS, 0.15])
    for number, step in enumerate(shown):
        axes = figure.add_subplot(grid[number // COLUMNS, number % COLUMNS])
        axes.imshow(frames[step])
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"step {step}", fontsize=8)
        axes.spines[:].set(visible=True, linewidth=2, color=option_colour(int(choices[step])))
    strip = figure.add_subplot(grid[ROWS, :])
    for option in np.unique(choices):
        strip.bar(np.flatnonzero(choices == option), 1, 1, color=option_colour(int(option)), label=f"option {option}")
    strip.set(xlim=(-0.5, len(choices) - 0.5), yticks=[], xlabel="step")
    strip.legend(frameon=False, fontsize=7, ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def played(policy: Policy, seed: int) -> Episode:
    """An episode, of which the way of the arm's tip is kept."""
    return run_episode(watched(pushing.task), policy, seed, observed=["camera"], keep=["tip"])


def row_of(episode: Episode) -> dict[str, float]:
    """What became of an episode."""
    height = np.asarray(episode.record.observations["tip"])[:, 1]
    outcome = {name: episode.outcome[name] for name in ("goals", "topples")}
    return outcome | {"above the picture": float(np.mean(height > TOP)), "highest": float(height.max())}


def page(rows: list[dict[str, float]], found: dict[str, Any] | None, seed: int, caption: str, made_by: str) -> str:
    """The episodes as Markdown."""
    lines = [made_by, "", "| episode | goals | topples | steps with the tip above the picture | highest, m |"]
    lines.append("|---|--:|--:|--:|--:|")
    for number, row in enumerate(rows, seed):
        counts = f"{row['goals']:.0f} | {row['topples']:.0f}"
        lines.append(f"| {number} | {counts} | {row['above the picture']:.0%} | {row['highest']:.2f} |")
    lines += ["", f"The camera sees up to {TOP:.2f} m."]
    if found:
        each = "; ".join(f"{name} {', '.join(map(str, counts))}" for name, counts in found["steps"].items())
        lines += ["", f"Options and the supervisor's phases, held-out demonstrations: NMI {found['nmi']:.2f}."]
        lines += [f"Steps of each phase in each option: {each}."]
    return "\n".join([*lines, "", f"![{caption}](looks.png)"]) + "\n"


def main() -> None:
    """Draw the picture."""
    parser = described(__doc__)
    parser.add_argument("method", choices=METHODS)
    for name in ("options", "count", "seed"):
        parser.add_argument(name, type=int)
    parser.add_argument("checkpoints", type=Path)
    DEFAULTS.add_to(parser)
    own = parser.parse_args()
    if not list(own.checkpoints.glob("restart-*.safetensors")):
        parser.error(f"{own.checkpoints}: no fit is there; run pushing_pictures_cell.py with these words first")
    cell, settings = PictureCell(own.method, own.options, own.count, own.seed), DEFAULTS.given(own)
    words = f"{cell.method} {cell.options} {cell.count} {cell.seed} {own.checkpoints}"
    command = f"python studies/pushing_pictures_looks.py {words} {settings.words()}"
    made_by = record(command)
    torch.set_num_threads(1)
    spec, trained = cell.fitted(settings, cell.demonstrations(settings), own.checkpoints)
    acting, seed = Controller.from_spec(trained.hierarchy, spec.rollout), EVALUATION + 1000 * cell.seed
    looking = Looking(acting)
    first = played(looking, seed)
    episodes = [first, *(played(acting, seed + number) for number in range(1, int(settings.values["episodes"])))]
    choices = first.choices[:, 0] if cell.options else np.zeros(len(looking.frames), int)
    caption = f"What {cell.method} looks at, and the option that is active; episode {seed}"
    save(draw(looking.frames, choices), OUT / "looks.png", caption, "")
    rows = [row_of(episode) for episode in episodes]
    found = phases(Fit(spec, trained.hierarchy), held_out(own.runs, cell.seed)) if cell.options else None
    write_text(OUT / "looks.json", text({"episodes": rows, "phases": found}, [made_by]))
    write_text(OUT / "looks.md", page(rows, found, seed, caption, sentence(command, [made_by])))


if __name__ == "__main__":
    main()
