"""The report of a run: one self-contained HTML page."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.labels import label_names
from ddco_pyro.data.sources import open_source
from ddco_pyro.drawing.page import Block, Card, Page, Section, Text, Warned, note
from ddco_pyro.drawing.shown import pictures, stored_pictures
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.options import SOUND, beside_equal_parts
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import method
from ddco_pyro.report import inputs, likelihood, options, rollouts, skills, training
from ddco_pyro.segmenting.page import timelines
from ddco_pyro.segmenting.segments import Segmented, of_piece, of_run


def write_report(fit: Fit, demos: Demonstrations) -> Path:
    """Write ``report.html`` and ``figures/`` into the run folder.

    :param demos: the demonstrations of the fit.
    :returns: the path of the page.
    :raises BadInput: the fit has no folder.
    """
    path, metrics = fit.run_folder / "report.html", fit.metrics
    tiles: list[Block] = []
    by_options: dict[str, Section] = {}
    anchors: set[str] = set()
    learning = training.learning(fit)  # or a history is damaged, and no figure is written
    if fit.spec.hierarchy:
        segmented = segments_of(fit, demos)
        ordered = demos.select([demo.name for demo in segmented.segments])
        paths = fit.spec.report.trajectory or ()
        shown = skills.Shown(ordered, pictures(ordered) or _stored(fit, ordered), paths)
        drawn = timelines(segmented, ordered, shown.pictures, paths, options.MOST_STEPS)
        every = skills.skills(fit, segmented)
        tiles, anchors = skills.overview(fit, every, shown), {track["anchor"] for track in drawn.tracks}
        by_options = {
            "skills": skills.section(fit, every, shown, segmented),
            "segments": options.segments(drawn, len(metrics.demonstrations_by_likelihood)),
            "options": options.section(fit, segmented, shown),
        }
    sections = [
        likelihood.test(metrics),
        by_options.get("skills"),
        by_options.get("segments"),
        options.agreement(fit, demos),
        rollouts.success(fit),
        rollouts.films(fit),
        likelihood.section(fit),
        likelihood.demonstrations(metrics, anchors),
        likelihood.dimensions(fit),
        by_options.get("options"),
        inputs.branches(fit),
        learning,
        training.particulars(fit),
    ]
    known, folder = fit.spec.demonstrations.path, fit.run_folder.resolve()
    title = Path(known).name if known else str(fit.spec.demonstrated_task)
    fitted = datetime.fromtimestamp((folder / "model.safetensors").stat().st_mtime)
    subtitle = f"{method(fit.name)}, {folder.parent.name}/{folder.name}, fitted {fitted:%Y-%m-%d %H:%M}"
    write_text(path, Page(title, [*tiles, *header(fit)], sections, subtitle=subtitle).html())
    return path


def segments_of(fit: Fit, demos: Demonstrations) -> Segmented:
    """Segments of a fit's demonstrations, ordered and numbered like ``demonstrations_by_likelihood``."""
    names = fit.spec.demonstrations.label_names
    labels = {demo.name: {name: demo.labels[name] for name in names} for demo in demos}
    pieces = (of_piece(fit, piece, labels, intervals=True) for piece in fit.infer(demos))
    found = {demo.name: demo for piece in pieces for demo in piece}
    rows = fit.metrics.demonstrations_by_likelihood
    held_out = {row.name for row in rows if row.part == "valid"}
    tasks = dict(zip(demos.names, demos.tasks, strict=True))
    ordered = [
        replace(
            found[row.name],
            log_likelihood=row.log_likelihood_per_step[fit.name],
            held_out=row.part == "valid",
            task=tasks[row.name],
        )
        for row in rows
        if row.name in found and (row.part == "valid" or row.name not in held_out)  # some are in both parts
    ]
    return of_run(fit, ordered, demos.frequency, label_names(demos.attributes))


def _stored(fit: Fit, demos: Demonstrations) -> list[Observed]:
    """Pictures of these demonstrations in the fit's file that the fit does not observe; empty without any."""
    path = fit.spec.demonstrations.path
    if path is None or not Path(path).is_file():
        return []
    with open_source(path) as source:
        return stored_pictures(source, dict(zip(demos.names, demos.lengths, strict=True)))


def header(fit: Fit) -> list[Block]:
    """The skills' lengths, agreement with labels, and what is doubtful; of a policy, how likely it is."""
    metrics = fit.metrics
    texts = [verdicts.twitches(metrics.segments, metrics.control_frequency) or verdicts.explained(metrics)]
    texts += [text for text, worse in beside_equal_parts(metrics) if not worse]
    found = training.doubts(fit)
    return [
        *map(Text, texts),
        *(Warned(*sign) for sign in found),
        *([] if found else [Card("No sign of a doubtful fit", [note(SOUND)], folded=True)]),
    ]
