"""Commands on finished runs: ``compare``, ``rollout``, ``report``, ``segment`` and ``export``."""

from __future__ import annotations

import inspect
import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from ddco_pyro.cli import BRACKET, AllowCode, Overrides, RunPath, out_file, out_folder, written
from ddco_pyro.data.files import Output, check_outputs
from ddco_pyro.errors import BadInput

if TYPE_CHECKING:
    from ddco_pyro.data.sources import Source
    from ddco_pyro.fitting.fitted import Fit
    from ddco_pyro.segmenting.formats import Asked, Writer

FILMED = 3
"""Episodes of each method that ``rollout --video`` films."""

Best = Annotated[
    bool,
    typer.Option(
        "--best",
        help="Act with the run's baseline that is likelier on held-out demonstrations than its model, by more than a "
        "standard error, if there is one.",
    ),
]
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
    best: Best = False,
    video: Annotated[bool, typer.Option("--video", help="Film the first episodes of each method.")] = False,
    jobs: Jobs = -1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Where RUN holds these rollouts, finished, show them again.")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Roll the model, its baselines and the spec's scripted policies out from the same initial states.

    An unfinished rollout of as many episodes is continued. The repetitions of fit --seeds are rolled
    out, too. With --best one model alone is rolled out, beside the scripted policies.
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
        roll_out(fitted, number, FILMED if video else 0, progress, jobs, resume, best)
        if not best:
            roll_out_repetitions(fitted, progress, jobs)
    console.successes(fitted.metrics)
    print(f"report: {write_report(fitted, demos)}")


def report(run: RunPath, overrides: Overrides = [], allow_code: AllowCode = False) -> None:  # noqa: B006
    """Write the report of a run again. RUN/spec.yaml keeps what --set changes, such as report.trajectory=KEY."""
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


# --- segment and export -----------------------------------------------------------------------------------------------


def _option(name: str, default: Any, kind: Any, text: str) -> inspect.Parameter:
    """An option that belongs to formats alone, as a parameter of their writers."""
    flag = f"--{name.replace('_', '-')}"
    annotation = Annotated[kind, typer.Option(flag, help=text)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


class Format(NamedTuple):
    """A format of segments, an option of ``segment`` that names a file or folder.

    :param writer: its class in :mod:`ddco_pyro.segmenting.formats`, ``module:Class``.
    :param more: further options, which are arguments of that class.
    """

    option: str
    kind: Literal["file", "folder", "stream"]
    writer: str
    group: str
    text: str
    more: tuple[inspect.Parameter, ...] = ()


OVERWRITE = _option("overwrite", False, bool, "Let --out replace a file that is no labelled copy of DEMOS.")
LEROBOT_FORMAT = _option(
    "lerobot_format", "0.6", Literal["0.6", "0.4"], "Subtasks as LeRobot reads them from 0.6 on, or in 0.4 and 0.5."
)
SAME_ORDER = _option(
    "same_order",
    False,
    bool,
    "Leave demonstrations out of --mimicgen and --isaac if their options follow another order than most.",
)
GENERAL, DATASETS, TOOLS = "Pages, tables and labels", "Datasets for training", "Annotation tools"
FORMATS = (
    Format("--html", "stream", "html:Page", GENERAL, "A page with the timeline of every demonstration."),
    Format("--csv", "stream", "tables:CSV", GENERAL, "A table with a row for each step."),
    Format("--parquet", "stream", "tables:Parquet", GENERAL, "The same table as Parquet."),
    Format(
        "--out", "file", "labels:Labels", GENERAL, "A copy of the HDF5 file with labels for each step.", (OVERWRITE,)
    ),
    Format(
        *("--lerobot", "folder", "lerobot:Annotated", DATASETS, "A LeRobot dataset with options as subtasks."),
        more=(LEROBOT_FORMAT,),
    ),
    Format("--sarm", "folder", "lerobot:SARM", DATASETS, "A LeRobot dataset with the stages of SARM's reward model."),
    Format("--rabc", "stream", "rabc:RABC", DATASETS, "Progress of each frame as Parquet, for RA-BC in LeRobot."),
    Format(
        *("--mimicgen", "file", "mimicgen:MimicGen", DATASETS, "A copy of a prepared file, with MimicGen's signals."),
        more=(SAME_ORDER,),
    ),
    Format("--isaac", "file", "mimicgen:Isaac", DATASETS, "The same for Isaac Lab Mimic.", (SAME_ORDER,)),
    Format("--rlds", "folder", "rlds:RLDS", DATASETS, "Steps in the fields of RLDS, as numpy archives."),
    Format("--label-studio", "folder", "label_studio:LabelStudio", TOOLS, "Predictions for Label Studio."),
    Format("--elan", "folder", "elan:ELAN", TOOLS, "ELAN's .eaf of each demonstration."),
    Format("--rerun", "folder", "rerun:Rerun", TOOLS, "Rerun's .rrd of each demonstration."),
)
"""Every format of segments; to add one, write its :class:`Writer` and list it here."""


def with_formats(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command an option for each format, between its arguments and its own options.

    The command gets them as ``outputs``, from the option to the path, with the options that were given, and the
    formats' further options as ``settings`` by name.
    """
    own = list(inspect.signature(command, eval_str=True).parameters.values())
    parsers = {"file": out_file, "stream": out_file, "folder": out_folder}
    added = {form.option[2:].replace("-", "_"): form for form in FORMATS}
    keyword = inspect.Parameter.KEYWORD_ONLY
    options = [
        inspect.Parameter(
            name,
            keyword,
            default=None,
            annotation=Annotated[
                Path | None,
                written(parsers[form.kind], form.text, show_default=False, rich_help_panel=form.group),
            ],
        )
        for name, form in added.items()
    ]

    more = {option.name: option for form in FORMATS for option in form.more}
    options += more.values()

    @wraps(command)
    def with_outputs(**arguments: Any) -> None:
        paths = {form.option: arguments.pop(name, None) for name, form in added.items()}
        settings = {name: arguments.pop(name, option.default) for name, option in more.items()}
        outputs = {option: path for option, path in paths.items() if path}
        command(**arguments, outputs=outputs, settings=settings)

    parameters = [option.replace(kind=keyword) for option in own if option.name not in ("outputs", "settings")]
    vars(with_outputs)["__signature__"] = inspect.Signature([*parameters[:2], *options, *parameters[2:]])
    return with_outputs


@with_formats
def segment(
    outputs: dict[str, Path],
    settings: dict[str, Any],
    run: RunPath,
    demos: Annotated[
        Path, typer.Argument(metavar="DEMOS", help="Demonstrations: an HDF5 file, or a Minari or LeRobot dataset.")
    ],
    in_place: Annotated[bool, typer.Option("--in-place", help="Write the labels into the HDF5 file itself.")] = False,
    level: Annotated[
        str | None, typer.Option(help="The level that gives the subtasks; the lowest by default.", show_default=False)
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="Steps per second; by default the control frequency that DEMOS says.",
            show_default=False,
        ),
    ] = None,
    baselines: Annotated[
        bool,
        typer.Option(
            "--baselines",
            help="Write the labels of k-means, mixtures, hidden Markov models, change points, equal lengths and "
            "gripper changes beside the options; measure the agreement of all with the file's labels "
            f"(pip install 'ddco-pyro{BRACKET}segments]').",
        ),
    ] = False,
    gripper: Annotated[
        int, typer.Option(help="The control dimension of the gripper for --baselines, from 0; by default the last.")
    ] = -1,
    granularity: Annotated[
        str | None,
        typer.Option(
            metavar="coarse|medium|fine",
            help="How long segments are: as in the run (medium), or twice or half as long, by further fits. The other "
            "two stand beside as labels.",
            show_default=False,
        ),
    ] = None,
    allow_code: AllowCode = False,
) -> None:
    """Label every step of demonstrations with a run's options, and write them in the formats that you name.

    DEMOS is changed with --in-place only.
    """
    if not (outputs or in_place or baselines):
        raise BadInput(
            "name what to write, such as --html PAGE, --csv FILE or --lerobot FOLDER; labels for each step go to --out "
            "FILE (a copy) or with --in-place into DEMOS; --baselines measures agreement with labels"
        )
    if "--out" in outputs and in_place:
        raise BadInput("--out and --in-place exclude each other; keep one")
    places = [Output(form.option, outputs[form.option], form.kind) for form in FORMATS if form.option in outputs]
    if in_place:
        places.append(Output("--in-place", demos, "file"))
    from ddco_pyro.cli import console
    from ddco_pyro.data.sources import open_source
    from ddco_pyro.evaluation.agreement import agreement_table, tolerances
    from ddco_pyro.fitting.fitted import load
    from ddco_pyro.segmenting import baseline_labels, beside_baselines, beside_others, segments
    from ddco_pyro.segmenting.baselines import BASELINES, check_installed
    from ddco_pyro.segmenting.formats import Asked
    from ddco_pyro.selection.small import GRANULARITIES, cut

    if granularity not in (None, *GRANULARITIES):
        raise BadInput(f"--granularity {granularity}: give one of {', '.join(GRANULARITIES)}")
    check_outputs(places, [run] if in_place else [run, demos])
    fit = load(run, allow_code)
    if level is not None and fit.names and level not in fit.names:
        raise BadInput(f"--level: there is no level {level!r} (there is: {', '.join(fit.names)})")
    others = {}
    if granularity is not None:
        with console.Progress() as progress:
            others = {name: cut(fit, name, progress) for name in GRANULARITIES}
        fit = others.pop(granularity)
    with open_source(demos) as source, console.Progress("segmenting") as progress:
        beside = baseline_labels(fit) if baselines else ()
        beside += tuple(f"{level}_{name}" for level in fit.names for name in others)
        asked = Asked(fit, run, demos, source, level or next(iter(fit.names), ""), beside)
        writers = [writer_of(place, asked, settings) for place in places]
        if fit.names:  # without options, segments() refuses the run
            for writer in writers:
                writer.check()
        missing = _missing_labels(fit, source) if baselines else ""
        if baselines:
            check_installed(BASELINES)
            if missing and not writers:
                raise BadInput(f"--baselines: {missing}; name what to write, such as --html PAGE")
        segmented = segments(fit, source, progress, intervals="--html" in outputs)
        segmented = replace(segmented, frequency=fps or segmented.frequency)
        segmented = beside_others(segmented, others, fit, source) if others else segmented
        if baselines:
            segmented = beside_baselines(segmented, fit, source, gripper, progress)
            for name, scores in segmented.agreements.items():
                title = f"level {name}: agreement with the label {segmented.truth[name]}"
                console.show(agreement_table(scores, title))
                if said := tolerances(segmented.frequency):
                    console.say(said)
            if missing:
                print(f"--baselines: {missing}; no agreement is measured")
        for writer in writers:
            print(writer.write(segmented))


def writer_of(place: Output, asked: Asked, settings: Mapping[str, Any]) -> Writer:
    """What writes a format's file or folder.

    :param settings: the formats' further options by name.
    :raises BadInput: a package that the format needs is missing.
    """
    (form,) = (form for form in FORMATS if form.option == place.option.replace("--in-place", "--out"))
    try:
        kind = resolve_name(f"ddco_pyro.segmenting.formats.{form.writer}")
    except ModuleNotFoundError as error:
        raise BadInput(f"{place.option} needs {error.name}; install it with: pip install {error.name}") from None
    more = {option.name: settings[option.name] for option in form.more}
    writer: Writer = kind(place.option, place.path, asked, **more)
    return writer


def _missing_labels(fit: Fit, source: Source) -> str:
    """What is missing to measure agreement, in words; empty where a demonstration has labels of the run's spec."""
    from ddco_pyro.segmenting import chosen_names

    names = fit.spec.demonstrations.label_names
    if not names:
        return "the run's spec has no demonstrations.labels"
    if any(name in source.recording(demo).labels for demo in chosen_names(source, fit) for name in names):
        return ""
    return f"the demonstrations have no {', '.join(f'labels/{name}' for name in names)}"


def export(
    run: RunPath,
    out: Annotated[Path | None, written(out_folder, "The folder to write.", show_default=False)] = None,
    lerobot: Annotated[
        Path | None,
        written(out_folder, "The folder of a LeRobot policy, for lerobot_policy_ddco.", show_default=False),
    ] = None,
    best: Best = False,
    onnx: Annotated[
        bool, typer.Option("--onnx", help=f"Write ONNX too (pip install 'ddco-pyro{BRACKET}export]').")
    ] = False,
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

    if not (out or lerobot):
        raise BadInput("name what to write: --out FOLDER or --lerobot FOLDER")
    places = {"--out": out, "--lerobot": lerobot}
    check_outputs([Output(option, path, "folder") for option, path in places.items() if path], [run])
    fit = load(run, allow_code)
    fit = fit.best if best else fit
    if lerobot:
        from ddco_pyro.exporting.lerobot import export_policy

        export_policy(fit, lerobot)
        print(f"{lerobot}: use it with: lerobot-eval --policy.path={lerobot} --env.type=...")
    if out is None:
        return
    exported = write(fit, out, onnx)
    for form, (difference, seconds) in exported.items():
        print(f"{form}: largest difference {difference:.1e}, a step takes {1e3 * seconds:.3f} ms")
    form = next(iter(exported))
    again = shlex.join(["python", str(out / "runner.py"), str(out), *([] if form == "numpy" else [form])])
    print(f"{out}: try it with: {again}")
