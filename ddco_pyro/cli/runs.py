"""Commands on finished runs: ``compare``, ``rollout``, ``report``, ``segment`` and ``export``."""

from __future__ import annotations

import shlex
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ddco_pyro.cli import AllowCode, AllowExternal, RunPath, out_file, out_folder, written
from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput, command

if TYPE_CHECKING:
    from ddco_pyro.data.sources import Source
    from ddco_pyro.events import OnEvent
    from ddco_pyro.fitting.fitted import Fit
    from ddco_pyro.segmenting import Segmented

FILMED = 3
"""Episodes of each method that ``rollout --video`` films."""

Jobs = Annotated[int, typer.Option(help="Processes that run episodes; -1 is one for each core.")]


def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; a run's baselines are runs, too.")
    ],
    out: Annotated[Path | None, written(out_folder, "The folder to write to; by default runs/compare-TIME.")] = None,
    allow_code: AllowCode = False,
) -> None:
    """Compare runs on the demonstrations that all of them held out, and on rollouts from the same initial states."""
    from ddco_pyro.cli import console
    from ddco_pyro.comparison import compare as compare_runs
    from ddco_pyro.comparison import page

    folder = out or Path("runs") / time.strftime("compare-%Y%m%d-%H%M%S")
    check_outputs([Output("--out", folder / name) for name in page.FILES], runs)
    compared = compare_runs(runs, allow_code)
    for table in (page.run_table(compared), page.agreement_table(compared), page.rollout_table(compared)):
        if table is not None:
            console.show(table)
    print(page.verdict(compared))
    print(f"comparison: {page.write(compared, folder)}")


def rollout(
    run: RunPath,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes of each method; by default the spec's.")] = None,
    video: Annotated[bool, typer.Option("--video", help="Film the first episodes of each method.")] = False,
    jobs: Jobs = -1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Where RUN holds these rollouts, finished, show them again.")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Roll the model, its baselines and the spec's scripted policies out from the same initial states.

    An unfinished rollout of as many episodes is continued. The repetitions of fit --seeds are rolled
    out, too.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.fitting.rollouts import roll_out
    from ddco_pyro.fitting.seeds import roll_out_repetitions
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    number = episodes or fitted.spec.rollout.episodes
    _check_run(run, "rollouts.csv", "metrics.json")
    demos = fitted.demonstrations  # the report needs them: asked for before any episode
    with console.Progress() as progress:
        roll_out(fitted, number, FILMED if video else 0, progress, jobs, resume)
        roll_out_repetitions(fitted, progress, jobs)
    console.successes(fitted.metrics)
    print(f"report: {write_report(fitted, demos)}")


def report(run: RunPath, allow_code: AllowCode = False) -> None:
    """Write the report of a run again."""
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    _check_run(run)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


def name(
    run: RunPath,
    names: Annotated[
        str | None,
        typer.Argument(metavar="[NAMES]", help="The names of options 1 to k, with commas between.", show_default=False),
    ] = None,
    level: Annotated[str | None, typer.Option(help="Name of their level; by default the lowest.")] = None,
    allow_code: AllowCode = False,
) -> None:
    """Name the options of a level in RUN/names.yaml; without NAMES, show the options with their shares and lengths."""
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.report.options import use_table

    fitted = load(run, allow_code)
    if names is not None:
        check_outputs([Output("RUN", run / "names.yaml", "file")])
        fitted.name_options(level or next(iter(fitted.names), ""), names.split(","))
    elif not fitted.names or (level and level not in fitted.names):
        raise BadInput(f"{run}: has no {f'level {level!r}' if fitted.names else 'options'}; name another")
    console.show(use_table(fitted, [level] if level else None))
    if names is not None:
        allowed = ["--allow-code"] if allow_code else []
        print(f"{run / 'names.yaml'}: show them with: {command('report', run, *allowed)}")


def _check_run(run: Path, *names: str) -> None:
    """Check that the report of a run, and these files of the run, may be written."""
    files = [Output("RUN", run / name, "file") for name in ("report.html", *names)]
    check_outputs([*files, Output("RUN", run / "figures", "folder")])


# --- segment and export -----------------------------------------------------------------------------------------------


class LeRobotFormat(StrEnum):
    """Forms of subtasks, by the first version of LeRobot that reads them."""

    LANGUAGE = "0.6"
    SUBTASK_INDEX = "0.4"


NO_LABELS = "labels go into HDF5 files only; name --csv, --parquet, --html or --lerobot"


def segment(
    run: RunPath,
    demos: Annotated[
        Path, typer.Argument(metavar="DEMOS", help="Demonstrations: an HDF5 file, or a Minari or LeRobot dataset.")
    ],
    out: Annotated[
        Path | None,
        written(out_file, "A copy of the HDF5 file with labels for each step.", show_default=False),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Let --out replace a file that is no labelled copy of DEMOS.")
    ] = False,
    in_place: Annotated[bool, typer.Option("--in-place", help="Write the labels into the HDF5 file itself.")] = False,
    csv: Annotated[Path | None, written(out_file, "A table with a row for each step.", show_default=False)] = None,
    parquet: Annotated[Path | None, written(out_file, "The same table as Parquet.", show_default=False)] = None,
    html: Annotated[
        Path | None, written(out_file, "A page with the timeline of every demonstration.", show_default=False)
    ] = None,
    lerobot: Annotated[
        Path | None,
        written(out_folder, "A copy of the LeRobot dataset with options as subtasks.", show_default=False),
    ] = None,
    lerobot_format: Annotated[
        LeRobotFormat,
        typer.Option("--lerobot-format", help="Subtasks as LeRobot reads them from 0.6 on, or in 0.4 and 0.5."),
    ] = LeRobotFormat.LANGUAGE,
    level: Annotated[
        str | None, typer.Option(help="The level that gives the subtasks; the lowest by default.", show_default=False)
    ] = None,
    baselines: Annotated[
        bool,
        typer.Option(
            "--baselines",
            help="Write the labels of k-means, mixtures, hidden Markov models, change points, equal lengths and "
            "gripper changes beside the options; measure the agreement of all with the file's labels "
            "(pip install 'ddco-pyro\\[segments]').",
        ),
    ] = False,
    gripper: Annotated[
        int, typer.Option(help="The control dimension of the gripper for --baselines, from 0; by default the last.")
    ] = -1,
    allow_external: AllowExternal = False,
    allow_code: AllowCode = False,
) -> None:
    """Label every step of demonstrations with a run's options: as a page, a table, labels in HDF5, or subtasks.

    DEMOS is changed with --in-place only.
    """
    if not (out or in_place or csv or parquet or html or lerobot or baselines):
        raise BadInput(
            "name what to write: --html PAGE, --csv FILE or --parquet FILE; labels for each step go to --out FILE (a "
            "copy) or with --in-place into DEMOS; --lerobot FOLDER is an annotated copy of a LeRobot dataset; "
            "--baselines measures agreement with labels"
        )
    if out and in_place:
        raise BadInput("--out and --in-place exclude each other; keep one")
    labelled = demos if in_place else out
    if labelled and demos.is_dir():
        raise BadInput(f"{demos}: {NO_LABELS}")
    if labelled and allow_external:  # a copy lacks the other files, and labels could go into them
        again = command("import", demos, "--allow-external", "--out", "whole.hdf5")
        raise BadInput(f"{demos}: labels go into whole files only; first: {again}")
    from ddco_pyro.cli import console
    from ddco_pyro.data.sources import open_source
    from ddco_pyro.drawing.shown import stored_pictures
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.segmenting import beside_baselines, chosen_names, recorded, segments
    from ddco_pyro.segmenting.agreement import agreement_table, level_agreements
    from ddco_pyro.segmenting.baselines import BASELINES, check_installed
    from ddco_pyro.segmenting.files import check_copy, check_labels, write_csv, write_labels, write_parquet
    from ddco_pyro.segmenting.page import followed, write_page

    named = {"--csv": csv, "--parquet": parquet, "--html": html}
    files = [Output(option, path) for option, path in named.items() if path]
    labels = [Output("--in-place" if in_place else "--out", labelled, "file")] if labelled else []
    copies = [Output("--lerobot", lerobot, "folder")] if lerobot else []
    check_outputs([*labels, *files, *copies], [run] if in_place else [run, demos])
    if out and not overwrite:
        check_copy(demos, out)
    fit = load(run, allow_code)
    with open_source(demos, external=allow_external) as source, console.Progress("segmenting") as progress:
        if labelled and source.format != "robomimic":
            raise BadInput(f"{demos}: {NO_LABELS}")
        if labelled and fit.spec.hierarchy:
            levels = [level.name for level in fit.spec.hierarchy.levels]
            beside = [f"{level}_{name}" for level in levels for name in BASELINES] if baselines else []
            check_labels(demos, [*levels, *beside], chosen_names(source, fit))
        if baselines:
            check_installed(BASELINES)
            missing = _missing_labels(fit, source)
            if missing and not (labels or files):
                raise BadInput(f"--baselines: {missing}; name what to write, such as --html PAGE")
        if lerobot:
            segmented = _annotate(fit, source, lerobot, (level, lerobot_format.value), progress)
        else:
            segmented = segments(fit, source, progress)
        if baselines:
            segmented = beside_baselines(segmented, fit, source, gripper)
        agreements = level_agreements(segmented) if html or baselines else {}
        if html:
            pictures = stored_pictures(source, {demo.name: len(demo) for demo in segmented.segments})
            follows = list(followed(recorded(segmented, fit, source), pictures, segmented, fit))
    if baselines:
        for name, found in agreements.items():
            console.show(agreement_table(found.scores, f"level {name}: agreement with the label {found.labels}"))
        if missing:
            print(f"--baselines: {missing}; no agreement is measured")
    for path, write in ((csv, write_csv), (parquet, write_parquet)):
        if path:
            write(path, segmented)
            print(path)
    if html:
        write_page(html, segmented, str(run), str(demos), agreements, follows)
        print(html)
    if labelled:
        write_labels(demos, labelled, segmented)
        print(f"{labelled}: labels/{', labels/'.join([*segmented.counts, *segmented.segments[0].baselines])}")


def _missing_labels(fit: Fit, source: Source) -> str:
    """What is missing to measure agreement, in words; empty where a demonstration has labels of the run's spec."""
    from ddco_pyro.segmenting import chosen_names

    names = fit.spec.demonstrations.label_names
    if not names:
        return "the run's spec has no demonstrations.labels"
    if any(name in source.recording(demo).labels for demo in chosen_names(source, fit) for name in names):
        return ""
    return f"the demonstrations have no {', '.join(f'labels/{name}' for name in names)}"


def _annotate(fit: Fit, source: Source, out: Path, how: tuple[str | None, str], on_event: OnEvent) -> Segmented:
    """Segment a LeRobot dataset and write a copy with a level's options as subtasks.

    :param how: the level (None: the lowest) and the format.
    """
    from ddco_pyro.segmenting import segments

    if source.format != "lerobot":
        raise BadInput(f"{source.files[0]}: is no LeRobot dataset; --lerobot annotates a copy of one")
    from ddco_pyro.data.sources.lerobot import LeRobot
    from ddco_pyro.segmenting.lerobot import FORMS, annotate, check_target, subtasks

    assert isinstance(source, LeRobot)
    level, form = how[0], FORMS[how[1]]
    if level is not None and level not in fit.names:
        raise BadInput(f"--level: there is no level {level!r} (there is: {', '.join(fit.names)})")
    chosen = level or next(iter(fit.names), "")
    names = fit.names.get(chosen, ())
    check_target(source, out, subtasks(chosen, len(names) - 1, names), form)
    segmented = segments(fit, source, on_event)
    annotate(source, out, segmented, chosen, form)
    print(out)
    return segmented


def export(
    run: RunPath,
    out: Annotated[Path, written(out_folder, "The folder to write.", show_default=False)],
    onnx: Annotated[bool, typer.Option("--onnx", help="Write ONNX too (pip install 'ddco-pyro\\[export]').")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Write the controller as files that do not need this library: numpy with a runner, torch.export, ONNX.

    Every form is loaded again and acts in three synthetic episodes, by the
    loop of runner.py. It must choose the options of the run's controller,
    with probabilities within 1e-6. Controls must be within 1e-6 of the
    largest of 1, their spread, and their distance from their mean, or
    within four times the error of float32 in the run's networks where that
    is more. Otherwise nothing is written.
    """
    from ddco_pyro.exporting import export as write
    from ddco_pyro.fitting.fitted import load

    check_outputs([Output("--out", out, "folder")], [run])
    exported = write(load(run, allow_code), out, onnx)
    for form, (difference, seconds) in exported.items():
        print(f"{form}: largest difference {difference:.1e}, a step takes {1e3 * seconds:.3f} ms")
    form = next(iter(exported))
    again = shlex.join(["python", str(out / "runner.py"), str(out), *([] if form == "numpy" else [form])])
    print(f"{out}: try it with: {again}")
