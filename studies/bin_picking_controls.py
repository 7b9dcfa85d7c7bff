"""Bin picking with other controls: joint angles, tooltip pose, rotation matrix (SM 1.4, "Coordinate Systems").

    python studies/bin_picking_controls.py [--seeds 3] [--controls joints pose matrix] [--bins 20] [--jobs 1]
        [--set KEY=VALUE]... [--summarize]

A cell is the DDCO policy of ``specs/bin_picking.yaml`` with controls of one form, fitted under a training seed and
rolled out on as many bins; it is kept once it is done. The demonstrator's motions are the same whatever the controls,
and so are the bins of a training seed. ``--summarize`` runs nothing. Writes ``controls.json`` and ``controls.md`` of
all cells that are done.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rates
from bin_picking import SPECS, concluded, evaluated
from cells import Cell, Settings, printed


class Form(NamedTuple):
    """A form of controls: the task that has it, how many numbers it has before the jaw, and what it is called."""

    task: str
    size: int
    called: str


FORMS = {
    "joints": Form("bin_picking", 6, "joint angles"),
    "pose": Form("bin_picking_pose", 6, "position and rotation vector"),
    "matrix": Form("bin_picking_matrix", 12, "position and rotation matrix"),
}
DEFAULTS = Settings({"bins": 20}, Path("runs/bin-picking-controls"))
CRITERIA = ("bins cleared", "grasp of exactly one", "recovery, recall", "categorisation")
PAPER = {
    "joints": ("-", "7 of 8", "2 of 2", "7 of 7"),
    "pose": ("-", "3 of 8", "5 of 5", "3 of 3"),
    "matrix": ("-", "2 of 8", "0 of 8", "0"),
}
"""By criterion: eight objects with each."""


@dataclass(frozen=True)
class Controlled(Cell):
    """A form of controls under a training seed."""

    script = "bin_picking_controls.py"
    controls: str
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """The bins, and how long fit and rollouts took."""
        return evaluated(SPECS["bin_picking"], self.seed, changes(self.controls), self.controls, settings, folder)


def changes(controls: str) -> list[str]:
    """What a form of controls changes in the spec."""
    form = FORMS[controls]
    numbers = f"{{name: {controls}, dims: {list(range(form.size))}, kind: gaussian}}"
    parts = f"[{numbers}, {{name: jaw, dims: [{form.size}], kind: binary}}]"
    return [f"task={form.task}", f"control.parts={parts}", "compare_with=[]"]


def page(summary: Mapping[str, Any], seconds: Sequence[Mapping[str, float]], made_by: str) -> str:
    """The results as Markdown: what was measured here, and below it the paper's."""
    lines = [made_by, "", f"| controls | {' | '.join(CRITERIA)} | objects brought into cups | held-out nats per step |"]
    lines += ["|---" * (len(CRITERIA) + 3) + "|"]
    for name, one in summary.items():
        cells = [rates.shown(one["criteria"][criterion]) for criterion in CRITERIA]
        likelihoods = ", ".join(f"{value:.2f}" for value in one["held_out"])
        lines.append(f"| {FORMS[name].called} | {' | '.join(cells)} | {one['delivered']:.0%} | {likelihoods} |")
        lines.append(f"| *paper* | {' | '.join(PAPER[name])} | - | - |")
    failures = list(next(iter(summary.values()))["failures"])
    ends = list(next(iter(summary.values()))["ends"])
    lines += ["", f"| controls | {' | '.join([*failures, *ends])} |", "|---" * (1 + len(failures) + len(ends)) + "|"]
    for name, one in summary.items():
        counts = [*one["failures"].values(), *one["ends"].values()]
        lines.append(f"| {FORMS[name].called} | {' | '.join(map(str, counts))} |")
    fits, rolled = ([one[part] for one in seconds] for part in ("fit", "rollouts"))
    lines += [
        "",
        "Rates with 95 % Wilson intervals, as in the [summary](summary.md); likelihoods are of controls in units of "
        "their own, by seed, and are not to be compared between rows. Below: attempts that failed, then how bins ended "
        "that were not cleared. The paper's numbers are of eight objects with each form.",
        f"A cell took {np.mean(fits):.0f} s to fit and {np.mean(rolled):.0f} s to roll out, on one thread.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--controls", nargs="+", choices=list(FORMS), default=list(FORMS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summarize", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("docs/results/bin_picking"))
    DEFAULTS.add_to(parser)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Do what is not done yet, and write what all cells that are done say together; the page."""
    settings = DEFAULTS.given(own)
    cells = [Controlled(controls, seed) for seed in range(own.seeds) for controls in own.controls]
    names = " ".join(own.controls)
    command = f"python studies/bin_picking_controls.py --seeds {own.seeds} --controls {names} {settings.words()}"
    return concluded(cells, settings, own, command, "controls", page)


if __name__ == "__main__":
    main()
