"""Commands on finished runs: ``compare``, ``rollout``, ``report``, ``segment`` and ``export``."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ddco_pyro.cli import BRACKET, AllowCode, Overrides, RunPath, Wheres, option, where_of, written
from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput, refuse_unknown
from ddco_pyro.segmenting.formats import FORMATS, Asked, check_format, write_format

if TYPE_CHECKING:
    from ddco_pyro.exporting import Exported

FILMED = 3
"""Episodes of each method that ``rollout --video`` films."""

Best = Annotated[
    bool,
    option(
        "Act with the run's baseline that is likelier on held-out demonstrations than its model, by more "
        "than a standard error, if there is one.",
        "--best",
    ),
]
Jobs = Annotated[int, option("Processes that run episodes; -1 is one for each core.")]


def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; a run's baselines are runs, too.")
    ],
    out: Annotated[
        Path | None, written("folder", "The folder to write to; by default runs/compare-TIME.")
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Compare runs on demonstrations that all held out, and on rollouts from the same initial states."""
    from ddco_pyro import comparison
    from ddco_pyro.cli import console

    folder = out or Path("runs") / time.strftime("compare-%Y%m%d-%H%M%S")
    compared = comparison.compare(runs, allow_code)
    for table in (comparison.run_table, comparison.agreement_table, comparison.rollout_table):
        if (found := table(compared)) is not None:
            console.show(found)
    print(comparison.verdict(compared))
    print(f"comparison: {comparison.write(compared, folder)}")


def rollout(
    run: RunPath,
    episodes: Annotated[int | None, option("Episodes of each method; by default the spec's.", min=1)] = None,
    best: Best = False,
    video: Annotated[bool, option("Film the first episodes of each method.", "--video")] = False,
    jobs: Jobs = -1,
    resume: Annotated[
        bool, option("Where RUN holds these rollouts, finished, show them again.", "--resume")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Roll the model, its baselines and the spec's scripted policies out from the same initial states.

    The repetitions of fit --seeds are rolled out, too. With --best one model alone is rolled out, beside the
    scripted policies.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.fitting.rollouts import roll_out, roll_out_repetitions
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    number = episodes or fitted.spec.rollout.episodes
    _check_run(run, "rollouts.csv", "metrics.json")
    demos = fitted.demonstrations  # the report needs them: asked for before any episode
    with console.Progress() as progress:
        roll_out(fitted, number, FILMED if video else 0, progress, jobs, resume, best)
        if not best:
            roll_out_repetitions(fitted, progress, jobs)
    console.successes(fitted.metrics)
    print(f"report: {write_report(fitted, demos)}")


def report(run: RunPath, overrides: Overrides = [], allow_code: AllowCode = False) -> None:  # noqa: B006
    """Write a run's report again. RUN/spec.yaml keeps what --set changes, such as report.trajectory=KEY."""
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.fitting.run import claim
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code, overrides)
    _check_run(run, *(["spec.yaml"] if overrides else []))
    if overrides:
        claim(run, fitted.spec)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


def _check_run(run: Path, *names: str) -> None:
    """Check that the report of a run, and these files of the run, may be written."""
    files = [Output("RUN", run / name, "file") for name in ("report.html", *names)]
    check_outputs([*files, Output("RUN", run / "figures", "folder")])


# --- segment and export -------------------------------------------------------------------------------------


def _to(option: str) -> Any:
    """The option of a format."""
    form = FORMATS[option]
    return written(form.kind, form.text, rich_help_panel="Formats")


def segment(
    run: RunPath,
    demos: Annotated[
        Path,
        typer.Argument(metavar="DEMOS", help="Demonstrations: an HDF5 file, or a Minari or LeRobot dataset."),
    ],
    html: Annotated[Path | None, _to("--html")] = None,
    csv: Annotated[Path | None, _to("--csv")] = None,
    parquet: Annotated[Path | None, _to("--parquet")] = None,
    out: Annotated[Path | None, _to("--out")] = None,
    lerobot: Annotated[Path | None, _to("--lerobot")] = None,
    sarm: Annotated[Path | None, _to("--sarm")] = None,
    mimicgen: Annotated[Path | None, _to("--mimicgen")] = None,
    isaac: Annotated[Path | None, _to("--isaac")] = None,
    label_studio: Annotated[Path | None, _to("--label-studio")] = None,
    elan: Annotated[Path | None, _to("--elan")] = None,
    rerun: Annotated[Path | None, _to("--rerun")] = None,
    in_place: Annotated[bool, option("Write the labels into the HDF5 file itself.", "--in-place")] = False,
    same_order: Annotated[
        bool,
        option(
            "Leave demonstrations out of --mimicgen and --isaac if their options follow another order than "
            "most.",
            "--same-order",
        ),
    ] = False,
    level: Annotated[str | None, option("The level that gives the subtasks; the lowest by default.")] = None,
    wheres: Wheres = [],  # noqa: B006
    fps: Annotated[
        float | None, option("Steps per second; by default the control frequency that DEMOS says.", min=0.001)
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Label every step of demonstrations with a run's options, and write them in the formats that you name.

    DEMOS is changed with --in-place only.
    """
    given = locals()
    named = {form: given[form[2:].replace("-", "_")] for form in FORMATS} | {"--in-place": in_place and demos}
    places = {form: path for form, path in named.items() if path}
    if not places:
        labels = "labels for each step go to --out FILE (a copy) or with --in-place into DEMOS"
        raise BadInput(f"name what to write, such as --html PAGE or --csv FILE; {labels}")
    if out and in_place:
        raise BadInput("--out and --in-place exclude each other; keep one")
    if in_place:
        check_outputs([Output("--in-place", demos, "file")])
    from ddco_pyro.cli import console
    from ddco_pyro.data.sources import open_source
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.segmenting.segments import segments

    fit = load(run, allow_code)
    if level is not None and fit.names:
        refuse_unknown("level", level, fit.names, place="--level: ")
    with open_source(demos, where=where_of(wheres)) as source, console.Progress() as progress:
        subtasks = level or next(iter(fit.names), "")
        asked = [Asked(option, path, fit, source, subtasks, same_order) for option, path in places.items()]
        if fit.names:  # without options, segments() refuses the run
            for each in asked:
                check_format(each)
        segmented = segments(fit, source, progress, intervals=html is not None)
        segmented = replace(segmented, frequency=fps or segmented.frequency)
        for line in segmented.unlike:
            print(f"note: unlike the demonstrations of the fit: {line}", file=sys.stderr)
        for each in asked:
            print(write_format(each, segmented))


def export(
    run: RunPath,
    out: Annotated[Path | None, written("folder", "The folder to write.")] = None,
    lerobot: Annotated[
        Path | None, written("folder", "The folder of a LeRobot policy, for lerobot_policy_ddco.")
    ] = None,
    best: Best = False,
    onnx: Annotated[
        bool, option(f"Write ONNX too (pip install 'ddco-pyro{BRACKET}export]').", "--onnx")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Write the controller as files that do not need this library: numpy with a runner, and ONNX.

    Every form is loaded again and acts in three synthetic episodes, by the
    loop of runner.py. It must choose the options of the run's controller,
    with probabilities within 1e-6. Controls must be within 1e-6 of the
    largest of 1, their spread, and their distance from their mean, or
    within four times the error of float32 in the run's networks where that
    is more. Otherwise nothing is written.
    """
    from ddco_pyro.exporting import export as write
    from ddco_pyro.fitting.fitted import load

    if not (out or lerobot):
        raise BadInput("name what to write: --out FOLDER or --lerobot FOLDER")
    fit = load(run, allow_code)
    fit = fit.best if best else fit
    if lerobot:
        from ddco_pyro.exporting import export_policy

        _say_exported(export_policy(fit, lerobot))
        print(f"{lerobot}: use it with: lerobot-eval --policy.path={lerobot} --env.type=...")
    if out is None:
        return
    exported = write(fit, out, onnx)
    _say_exported(exported)
    form = next(iter(exported))
    again = shlex.join(["python", str(out / "runner.py"), str(out), *([] if form == "numpy" else [form])])
    print(f"{out}: try it with: {again}")


def _say_exported(exported: Exported) -> None:
    for form, (difference, seconds) in exported.items():
        print(f"{form}: largest difference {difference:.1e}, a step takes {1e3 * seconds:.3f} ms")
