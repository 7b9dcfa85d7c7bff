"""The report of a run: one self-contained HTML page."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.sources import open_source
from ddco_pyro.drawing.figures import style
from ddco_pyro.drawing.page import Block, Folded, Page, Text, Warned, note
from ddco_pyro.drawing.shown import paths_of, pictures, stored_pictures
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.options import beside_equal_parts
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import method
from ddco_pyro.report import agreement, inputs, likelihood, options, rollouts, skills, training
from ddco_pyro.report.trajectories import activity
from ddco_pyro.segmenting.page import timelines


def write_report(fit: Fit, demos: Demonstrations) -> Path:
    """Write ``report.html`` and ``figures/`` into the run folder.

    :param demos: the demonstrations of the fit.
    :returns: the path of the page.
    :raises RunError: the fit has no folder.
    """
    path, metrics = fit.run_folder / "report.html", fit.metrics
    active = activity(fit, demos) if fit.spec.hierarchy else None
    segmented, paths = active.segmented if active else None, paths_of(fit.spec.report.trajectory, demos)
    if segmented:
        ordered = demos.select([demo.name for demo in segmented.segments])
        shown = pictures(ordered) or _stored(fit, ordered)
        drawn = timelines(segmented, ordered, shown, paths, options.MOST_STEPS)
        drawings = skills.Shown(ordered, shown, paths)
        every = skills.skills(fit, segmented)
    with style():
        learning = training.learning(fit)  # or a history is damaged, and no figure is written
        sections = [
            likelihood.test(metrics),
            skills.section(fit, ordered, every, drawings, active) if active else None,
            options.segments(drawn, len(metrics.demonstrations_by_likelihood)) if segmented else None,
            agreement.section(fit, demos),
            rollouts.success(fit),
            rollouts.films(fit),
            likelihood.section(fit),
            likelihood.demonstrations(metrics, {track.anchor for track in drawn.tracks} if segmented else ()),
            likelihood.dimensions(fit),
            options.section(fit, demos, active, paths) if active else None,
            inputs.branches(fit),
            learning,
            training.particulars(fit),
        ]
    tiles = skills.overview(fit, every, drawings) if active else []
    write_text(path, Page(title(fit), [*tiles, *header(fit)], sections, subtitle=subtitle(fit)).html())
    return path


def title(fit: Fit) -> str:
    """The file of the demonstrations, or their task."""
    known = fit.spec.demonstrations.path
    return Path(known).name if known else str(fit.spec.demonstrated_task)


def subtitle(fit: Fit) -> str:
    """The model, its run folder and the time at which it was fitted."""
    folder = fit.run_folder.resolve()
    fitted = datetime.fromtimestamp((folder / "model.safetensors").stat().st_mtime)
    return f"{method(fit.name)}, {folder.parent.name}/{folder.name}, fitted {fitted:%Y-%m-%d %H:%M}"


def _stored(fit: Fit, demos: Demonstrations) -> list[Observed]:
    """Pictures of these demonstrations in the fit's file that the fit does not observe; empty where there are none."""
    path = fit.spec.demonstrations.path
    if path is None or not Path(path).is_file():
        return []
    with open_source(path) as source:
        return stored_pictures(source, dict(zip(demos.names, demos.lengths, strict=True)))


def header(fit: Fit) -> list[Block]:
    """The skills' lengths, how they agree with labels, and what is doubtful; of a policy, how likely it is."""
    metrics = fit.metrics
    texts = [verdicts.twitches(metrics.segments, metrics.control_frequency) or verdicts.explained(metrics)]
    texts += [text for text, worse in beside_equal_parts(metrics) if not worse]
    found = training.doubts(fit)
    return [
        *map(Text, texts),
        *(Warned(*sign) for sign in found),
        *([] if found else [Folded("No sign of a doubtful fit", [note(training.SOUND)])]),
    ]
