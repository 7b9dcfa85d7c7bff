"""Methods compared over training seeds and tasks, as a YAML file declares it.

    python -m studies run|status|report studies/NAME.yaml [--out FOLDER] [--jobs 2]
    python -m studies render [--check] README.md docs/results/*.md

``run`` does the cells that are not done, and may be killed and called again. ``status`` counts cells. ``report`` writes
``table.csv`` and prints contrasts and means. ``render`` brings the generated tables of pages up to date; with
``--check`` it changes nothing, and fails where a page differs.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from ddco_pyro.cli.console import Progress
from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.jobs import Workers
from studies import page
from studies.cells import ROOT, Folder
from studies.declaration import Study
from studies.study import described, printed


def done(own: argparse.Namespace) -> str:
    """Do what is asked for; what is to be printed."""
    if own.action == "render":
        for path in own.files:
            if not path.is_file():
                raise BadInput(f"{path}: is missing; check the path")
            text = path.read_text(encoding="utf-8")
            if (now := page.render(text)) != text and own.check:
                raise Failed(f"{path}: differs from the results; write it with: python -m studies render {path}")
            if now != text:
                write_text(path, now)
        return f"{len(own.files)} pages agree with the results"
    if len(own.files) > 1:
        raise BadInput(f"{own.files[1]}: one study at a time")
    study, workers = Study.load(own.files[0]), Workers(own.jobs)
    folder = Folder(study, own.out or ROOT / "runs" / "studies" / study.path.stem)
    state = folder.state()
    if own.action == "report":
        return page.report(folder, state)
    if own.action == "run":
        with Progress() as progress:
            state = folder.run(workers, progress)
    lines = [f"failed, {n} cells: {why}" for why, n in Counter(one.failed for one in state.failed.values()).items()]
    missing = Counter(f"{cell.part}, {cell.method}" for cell in state.missing)
    lines += [f"missing, {n} cells: {named}" for named, n in missing.items()]
    lines.append(f"{len(state.done)} of {len(state.cells)} cells are done")
    if own.action == "run" and state.failed:
        raise Failed("\n".join([*lines, "the same command tries failed cells again"]))
    return "\n".join(lines)


def main() -> None:
    """Do what the command line says."""
    parser = described(__doc__)
    parser.add_argument("action", choices=["run", "status", "report", "render"])
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--out", type=Path, help="the folder of the results; by default runs/studies/NAME")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one for each core")
    parser.add_argument("--check", action="store_true")
    own = parser.parse_args()
    printed(lambda: done(own))


if __name__ == "__main__":
    main()
