"""Bin picking with other options, fewer demonstrations, coarser pictures, or controls that are poses (SM 1.4).

    python studies/bin_picking_variants.py [--seeds 1] [--variants options-1 demonstrations-20 ...] [--bins 20]
        [--jobs 1] [--summarize]

Each variant is ``specs/bin_picking.yaml`` with one change, fitted with as many gradient steps, and plays the bins of
the same training seed. ``demonstrations-N`` has the flat policies beside the hierarchy, the others do not. The spec
itself, ``base``, is taken from the cells of ``bin_picking.py``. ``--summarize`` runs nothing. Writes ``variants.json``
and ``variants.md`` of all cells that are done.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rates
from bin_picking import DEFAULTS, OURS, SPECS, Fitted, beside, evaluated, summarize
from cells import Cell, Settings, described, printed, some
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.spec import load_spec

BASE = "base"
ALONE = "compare_with=[]"


def _fewer(count: int) -> list[str]:
    """So many demonstrations and as many gradient steps."""
    spec = load_spec(SPECS["bin_picking"])
    epochs = round(spec.training.epochs * spec.demonstrations.count / count)
    return [f"demonstrations.count={count}", f"training.epochs={epochs}"]


def _controls(task: str, numbers: int) -> list[str]:
    """A task whose controls are so many numbers and the jaw."""
    pose = f"{{name: pose, dims: {list(range(numbers))}, kind: gaussian}}"
    return [ALONE, f"task={task}", f"control.parts=[{pose}, {{name: jaw, dims: [{numbers}], kind: binary}}]"]


VARIANTS: dict[str, list[str]] = {
    **{f"options-{count}": [ALONE, f"hierarchy.levels.0.count={count}"] for count in (1, 2, 3, 5, 6, 8)},
    **{f"demonstrations-{count}": _fewer(count) for count in (10, 20, 40)},
    "controls-pose": _controls("bin_picking_pose", 6),
    "controls-matrix": _controls("bin_picking_matrix", 12),
    "pixels-28": [ALONE, "observations.0.resize=[13, 28]", "observations.0.augment.shift=1"],
}


@dataclass(frozen=True)
class Variant(Cell):
    """A change of the spec under a training seed."""

    script = "bin_picking_variants.py"
    variant: str
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """As of a cell of ``bin_picking.py``."""
        return evaluated(SPECS["bin_picking"], self.seed, VARIANTS[self.variant], OURS, settings, folder)


def page(rows: Mapping[str, Mapping[str, Any]], seconds: Mapping[str, Sequence[float]], made_by: str) -> str:
    """The results as Markdown, a row for each method of each variant."""
    shown = ("bins cleared", "grasp of exactly one", "recovery, recall", "categorisation")
    head = ["variant", "method", *shown, f"cleared by {OURS} minus this, by seed"]
    head += ["cleared, by seed", "held-out nats per step, by seed", "fits, s"]
    lines = [made_by, "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for variant, methods in rows.items():
        took = ", ".join(f"{one:.0f}" for one in seconds[variant])
        for name, one in methods.items():
            cells = [rates.shown(one["criteria"][criterion]) for criterion in shown]
            cells += [beside(one["paired"]), ", ".join(map(str, one["cleared by seed"]))]
            cells += [", ".join(f"{value:.2f}" for value in one["held_out"]), took]
            lines.append(f"| {' | '.join([variant, name, *cells])} |")
    lines += [
        "",
        "Rates, and differences, as in [summary.md](summary.md). Likelihoods of other controls are in units of their "
        "own. Fits: of all methods of the row's variant, on one thread.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summarize", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("docs/results/bin_picking"))
    DEFAULTS.add_to(parser)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Do what is not done yet, and write what all cells that are done say; the page."""
    settings = DEFAULTS.given(own)
    cells = some([Variant(variant, seed) for seed in range(own.seeds) for variant in own.variants])
    if not own.summarize:
        made_by = record(cells[0].command(settings))
        Parallel(n_jobs=own.jobs)(delayed(cell.run)(settings, made_by) for cell in cells)
    return write(own.out, own.variants, own.seeds, settings)


def write(out: Path, variants: Sequence[str], seeds: int, settings: Settings) -> str:
    """What all cells that are done say; the page."""
    known: dict[str, Sequence[Cell]] = {BASE: [Fitted("bin_picking", seed) for seed in range(seeds)]}
    known |= {variant: [Variant(variant, seed) for seed in range(seeds)] for variant in variants}
    found = {name: _kept(cells, settings) for name, cells in known.items()}
    found = {name: kept for name, kept in found.items() if kept}
    records = [one["provenance"][0] for kept in found.values() for one in kept]
    results = {name: [one["results"] for one in kept] for name, kept in found.items()}
    rows = {name: summarize(cells) for name, cells in results.items()}
    seconds = {name: [one["seconds"]["fit"] for one in cells] for name, cells in results.items()}
    command = f"python studies/bin_picking_variants.py --seeds {seeds} {settings.words()}"
    shown = page(rows, seconds, sentence(command, records))
    write_text(out / "variants.json", text(rows, records))
    write_text(out / "variants.md", shown)
    return shown


def _kept(cells: Sequence[Cell], settings: Settings) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for cell in cells if (path := cell.path(settings)).exists()]


if __name__ == "__main__":
    main()
