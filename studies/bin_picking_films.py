"""Films of how trials of bin picking end: a success, and each way to fail, with the active option shown.

    python studies/bin_picking_films.py RUN [--bins 20] [--start 950000] [--films DIR]

RUN is the folder of a fit of ``specs/bin_picking.yaml``, such as ``studies/bin_picking.py`` makes. Rolls out bins from
``--start`` on until every ending has been seen, or all have been. Of each ending the first trial is filmed, in DIR
(``runs/bin-picking-films``). Writes ``docs/results/bin_picking/films.json``, ``films.md`` and ``films.png``, a row of
pictures for each film.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bin_picking_trials import ENDINGS, Bin, rolled
from cells import printed
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from provenance import record, sentence, text

from ddco_pyro.data.files import whole_file, write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.simulation.episodes import Episode
from ddco_pyro.simulation.film import write_film
from ddco_pyro.simulation.task import find_task

OUT = Path("docs/results/bin_picking")
SHOWN = 8  # pictures of a film on the sheet
PART = (slice(50, 280), slice(75, 420))  # of a frame, where something happens
SMALLER = 2  # by how much they are reduced
COLOURS = 128  # of the sheet: a third of the size


def part(episode: Episode, steps: slice) -> Episode:
    """Some steps of a filmed episode, with the frame after the last of them."""
    frames, choices = episode.frames[steps.start : steps.stop + 1], episode.choices[steps]
    return replace(episode, frames=frames, choices=choices)


def endings(fit: Fit, seeds: range) -> Iterator[tuple[str, Episode]]:
    """How each trial ended, and its part of the bin's episode."""
    task = find_task(str(fit.spec.task))
    for seed in seeds:
        played: Bin = rolled(fit, task, seed, film=True)
        for trial in played.trials:
            yield played.ending(trial), part(played.episode, trial.steps)


def chosen(found: Iterator[tuple[str, Episode]]) -> tuple[dict[str, Episode], Counter[str]]:
    """The first trial of each ending, those of :data:`ENDINGS` first, and how many trials ended in each way until all
    of those had been seen.
    """
    first: dict[str, Episode] = {}
    counts: Counter[str] = Counter()
    for name, trial in found:
        counts[name] += 1
        first.setdefault(name, trial)
        if first.keys() >= set(ENDINGS):
            break
    return {name: first[name] for name in dict.fromkeys([*ENDINGS, *first]) if name in first}, counts


def sheet(trials: Mapping[str, Episode], path: Path) -> None:
    """A row of pictures for each trial, evenly over its frames, each framed in the colour of the active option."""
    figure = Figure(figsize=(1.2 * SHOWN, 0.95 * len(trials)), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for row, (name, trial) in zip(figure.subplots(len(trials), SHOWN, squeeze=False), trials.items(), strict=True):
        times = np.unique(np.linspace(0, len(trial.frames) - 1, SHOWN).round().astype(int))
        row[0].set_ylabel(name.replace(" to ", "\nto ").replace(" over ", "\nover "), fontsize=6)
        for axes, t in zip(row, times, strict=False):
            axes.imshow(trial.frames[t][PART][::SMALLER, ::SMALLER])
            active = t < len(trial.choices)
            axes.set_title(f"{t}: option {trial.choices[t, 0]}" if active else "end", fontsize=5, pad=2)
            axes.spines[:].set(color=option_colour(int(trial.choices[t, 0])) if active else "black", linewidth=2)
        for axes in row:
            axes.set(xticks=[], yticks=[])
        for axes in row[len(times) :]:
            axes.axis("off")
    canvas.draw()
    with whole_file(path) as temporary:
        Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(COLOURS).save(temporary, "png")


def page(results: Mapping[str, Any], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", "| a trial ends with | trials | film, of the bin with seed |", "|---|--:|---|"]
    lines += [f"| {name} | {one['trials']} | {one.get('bin', '-')} |" for name, one in results.items()]
    lines += ["", "![the films, a row for each](films.png)"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--bins", type=int, default=20)
    parser.add_argument("--start", type=int, default=950_000)
    parser.add_argument("--films", type=Path, default=Path("runs/bin-picking-films"))
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Play, write the films, and what came of it; the page."""
    command = f"python studies/bin_picking_films.py {own.run} --bins {own.bins} --start {own.start}"
    made_by = record(command)
    torch.set_num_threads(1)
    trials, counts = chosen(endings(load(own.run), range(own.start, own.start + own.bins)))
    for name, trial in trials.items():
        write_film(own.films / f"{name.replace(' ', '_')}.mp4", trial)
    results: dict[str, Any] = {name: {"trials": counts[name]} for name in dict.fromkeys([*ENDINGS, *counts])}
    for name, trial in trials.items():
        results[name]["bin"] = trial.seed
    sheet(trials, OUT / "films.png")
    shown = page(results, sentence(command, [made_by]))
    write_text(OUT / "films.json", text(results, [made_by]))
    write_text(OUT / "films.md", shown)
    return shown


if __name__ == "__main__":
    main()
