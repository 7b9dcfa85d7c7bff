"""Methods compared over training seeds and tasks, as a YAML file declares it.

    python -m studies run|status|report studies/NAME.yaml [--out FOLDER] [--jobs 2]
    python -m studies render [--check] README.md docs/results/*.md

``run`` does the cells that are not done, and may be killed and called again. ``status`` counts cells.
``report`` writes ``table.csv`` and prints contrasts and means. ``render`` brings the generated tables of
pages up to date; with ``--check`` it changes nothing, and fails where a page differs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from ddco_pyro.cli.console import Progress
from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.jobs import Workers
from studies import page
from studies.cells import ROOT, Folder, State
from studies.declaration import Study
from studies.study import described, printed


def render(paths: Sequence[Path], check: bool) -> str:
    """Bring the generated tables of pages up to date.

    :raises Failed: with ``check``, a page differs.
    """
    for path in paths:
        if not path.is_file():
            raise BadInput(f"{path}: is missing; check the path")
        text = path.read_text(encoding="utf-8")
        if (now := page.render(text)) != text and check:
            raise Failed(f"{path}: differs from the results; write it with: python -m studies render {path}")
        if now != text:
            write_text(path, now)
    return f"{len(paths)} pages agree with the results"


def study(action: str, paths: Sequence[Path], out: Path | None, jobs: int) -> str:
    """Do the cells of a study, count them, or report what they say.

    :raises Failed: cells failed.
    """
    if len(paths) > 1:
        raise BadInput(f"{paths[1]}: one study at a time")
    declared, workers = Study.load(paths[0]), Workers(jobs)
    folder = Folder(declared, out or ROOT / "runs" / "studies" / declared.path.stem)
    state = folder.state()
    if action == "run":
        with Progress() as progress:
            state = folder.run(workers, progress)
    lines = [page.report(folder, state)] if action == "report" else []
    text = "\n".join([*lines, *told(folder, state)])
    if action == "run" and state.failed:
        raise Failed(f"{text}\nthe same command tries failed cells again")
    return text


def told(folder: Folder, state: State) -> Iterator[str]:
    """The cells of a study, a line each: what is missing or wrong, commits, chosen points, and those done."""
    declared = folder.study.declared
    values = ", ".join(f"{measure} {value:g}" for measure, value in declared.failed.items()) or "nothing"
    for what, found in (
        ("missing", Counter(cell.method for cell in state.missing)),
        (f"failed, and count {values}", Counter(one.failed for one in state.failed.values())),
        ("not converged", Counter(cell.method for cell, one in state.done.items() if not one.converged)),
        ("commits", Counter(one.code for one in state.done.values() if one.code)),
    ):
        if found:
            yield f"{what}: {', '.join(f'{name} ({count})' for name, count in found.items())}"
    of_test = [cell for cell in state.cells if cell.part == "test"]
    chosen = dict.fromkeys(declared.label(cell.of, cell.point, "") for cell in of_test)
    if declared.choose and chosen:
        yield f"the points with the highest {declared.choose} in development: {', '.join(chosen)}"
    yield f"{len(state.done)} of {len(state.cells)} cells are done"


def main() -> None:
    """Do what the command line says."""
    parser = described(__doc__)
    parser.add_argument("action", choices=["run", "status", "report", "render"])
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--out", type=Path, help="the folder of the results; by default runs/studies/NAME")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one for each core")
    parser.add_argument("--check", action="store_true")
    own = parser.parse_args()
    if own.action == "render":
        printed(lambda: render(own.files, own.check))
    else:
        printed(lambda: study(own.action, own.files, own.out, own.jobs))


if __name__ == "__main__":
    main()
