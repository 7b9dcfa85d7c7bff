"""The command ``study``: methods compared over training seeds and tasks."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ddco_pyro.cli import AllowCode, out_folder, written
from ddco_pyro.data.files import Output, check_outputs, write_text
from ddco_pyro.errors import BadInput, Failed, command
from ddco_pyro.jobs import Workers


class Action(StrEnum):
    """The actions of ``study``."""

    RUN = "run"
    STATUS = "status"
    REPORT = "report"
    RENDER = "render"


def study(
    action: Annotated[
        Action, typer.Argument(metavar="ACTION", help="run, status, report or render.", show_default=False)
    ],
    files: Annotated[
        list[Path],
        typer.Argument(metavar="STUDY", help="The study, a YAML file; for render the pages.", show_default=False),
    ],
    out: Annotated[
        Path | None, written(out_folder, "The folder of the study's results; by default runs/studies/STUDY.")
    ] = None,
    to: Annotated[
        Path | None, written(out_folder, "The folder of table, page and figures; by default that of the results.")
    ] = None,
    studies: Annotated[Path, typer.Option(help="The folder of the studies that render quotes.")] = Path("studies"),
    jobs: Annotated[int, typer.Option(help="Processes that do cells; -1 is one for each core.")] = -1,
    check: Annotated[
        bool, typer.Option("--check", help="With render: change nothing, and fail if a page differs.")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Compare methods over training seeds and tasks, as a YAML file declares it.

    run does the cells that are not done, and may be killed and called again; status counts cells; report writes the
    table, the page and the figures. render brings the numbers that pages quote up to date with the tables.
    """
    if action is Action.RENDER:
        _render(files, studies, check)
        return
    if len(files) > 1:
        raise BadInput(f"{files[1]}: one study at a time")
    workers = Workers(jobs)
    from ddco_pyro.cli import console
    from ddco_pyro.drawing.page import Table
    from ddco_pyro.study.cells import Folder
    from ddco_pyro.study.declaration import Study

    declared = Study.load(files[0], allow_code)
    folder = Folder(declared, out or Path("runs/studies") / declared.name)
    check_outputs([Output("--out", folder.path, "folder")], [files[0]])
    if action is Action.RUN:
        folder.state()  # or something is wrong with its data or files
        with console.Progress() as progress:
            folder.run(workers, progress)
    state = folder.state()
    if action is Action.REPORT:
        from ddco_pyro.study import report

        place = to or folder.path
        check_outputs([Output("--to", place / name, "file") for name in report.FILES])
        print(f"report: {report.write(folder, state, place)}")
        return
    rows: dict[tuple[str, str, int], list[int]] = {}
    for cell in state.cells:
        counts = rows.setdefault((cell.part, cell.method, cell.demonstrations), [0, 0, 0])
        counts[0 if cell in state.done else 1 if cell in state.failed else 2] += 1
    shown = [[part, method, str(count), *map(str, counts)] for (part, method, count), counts in rows.items()]
    console.show(Table(["part", "method", "demonstrations", "done", "failed", "missing"], shown, {0, 1}))
    for reason, count in (
        Counter(one.failed for one in state.failed.values()).items() if action is Action.STATUS else ()
    ):
        console.say(f"failed, {count} cells: {reason}")
    done, total = len(state.done), len(state.cells)
    again = ["--out", folder.path] if out else []
    code = ["--allow-code"] if allow_code else []
    print(f"{done} of {total} cells are done; next: "
          f"{command('study', 'report' if done == total else 'run', files[0], *again, *code)}")  # fmt: skip
    if action is Action.RUN and state.failed:
        raise Failed(f"{len(state.failed)} of {total} cells failed; the same command tries them again")


def _render(pages: list[Path], studies: Path, check: bool) -> None:
    """Bring the quoted numbers of pages up to date.

    :raises Failed: with ``check``, a page differs.
    """
    from ddco_pyro.study.report import render

    for page in pages:
        try:
            text = page.read_text(encoding="utf-8")
        except OSError as error:
            raise BadInput(f"{page}: cannot be read: {error.strerror}; check the path") from error
        now = render(text, studies, page.parent)
        if now != text and check:
            raise Failed(f"{page}: differs from the tables; write it with: {command('study', 'render', page)}")
        if now != text:
            write_text(page, now)
        print(f"{page}: {'changed' if now != text else 'unchanged'}")
