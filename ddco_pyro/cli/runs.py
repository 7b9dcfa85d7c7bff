"""What is done with finished runs: ``compare``, ``rollout`` and ``report``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from ddco_pyro.cli.options import AllowCode, RunPath, out_folder, written

FILMED = 3
"""Episodes of each method that ``rollout --video`` films."""

Jobs = Annotated[int, typer.Option(help="Processes that run episodes; -1 is one for each core.")]


def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; a run's baselines are some too.")
    ],
    out: Annotated[Path | None, written(out_folder, "The folder to write to; by default runs/compare-TIME.")] = None,
    allow_code: AllowCode = False,
) -> None:
    """Compare runs on the demonstrations that all of them held out, and on rollouts from the same initial states."""
    from ddco_pyro import comparison
    from ddco_pyro.cli import console
    from ddco_pyro.comparison import page
    from ddco_pyro.data.files import Output, check_outputs

    folder = out or Path("runs") / time.strftime("compare-%Y%m%d-%H%M%S")
    check_outputs([Output("--out", folder / name) for name in comparison.FILES], runs)
    compared = comparison.compare(runs, allow_code)
    console.comparison(page.HEAD, [page.cells(row) for row in compared.rows])
    if compared.agreement:
        console.comparison(page.AGREEMENT_HEAD, page.agreement_cells(compared), "agreement with labels, held out")
    if compared.rollouts:
        console.comparison(page.ROLLOUT_HEAD, page.rollout_cells(compared))
    print(page.verdict(compared))
    print(f"comparison: {comparison.write(compared, folder)}")


def rollout(
    run: RunPath,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes of each method; by default the spec's.")] = None,
    video: Annotated[bool, typer.Option("--video", help="Film the first episodes of each method.")] = False,
    jobs: Jobs = -1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Where RUN holds these very rollouts, show them again.")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Roll the model, its baselines and the spec's scripted policies out from the same initial states.

    An unfinished rollout of as many episodes is continued. The repetitions of fit --seeds are rolled
    out, too.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fit import load
    from ddco_pyro.fitting.rollouts import roll_out
    from ddco_pyro.fitting.seeds import roll_out_repetitions
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    number = episodes or fitted.spec.rollout.episodes
    _check_run(run, "rollouts.csv", "metrics.json")
    demos = fitted.demonstrations  # the report needs them: asked for before any episode
    with console.Progress() as progress:
        results = roll_out(fitted, number, FILMED if video else 0, progress, jobs, resume)
        roll_out_repetitions(fitted, progress, jobs)
    console.successes(results, fitted.name)
    print(f"report: {write_report(fitted, demos)}")


def report(run: RunPath, allow_code: AllowCode = False) -> None:
    """Write the report of a run again."""
    from ddco_pyro.fitting.fit import load
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    _check_run(run)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


def _check_run(run: Path, *names: str) -> None:
    """See that the report of a run, and these files of it, may be written."""
    from ddco_pyro.data.files import Output, check_outputs

    files = [Output("RUN", run / name, "file") for name in ("report.html", *names)]
    check_outputs([*files, Output("RUN", run / "figures", "folder")])
