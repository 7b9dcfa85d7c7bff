"""A run as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.pictures import style
from ddco_pyro.drawing.templates import render
from ddco_pyro.drawing.words import unconverged
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.report import activity, demonstration_list, dimensions, looks, option_figures, sections, worth
from ddco_pyro.report.sections import degeneracies

__all__ = ["degeneracies", "unconverged", "write_report"]


def write_report(fit: Fit, demos: Demonstrations) -> Path:
    """Write ``report.html`` and ``figures/`` into the run folder; the path of the page.

    :param demos: the demonstrations the fit was made from.
    :raises RunError: the fit has no folder.
    """
    path, metrics = fit.run_folder / "report.html", fit.metrics
    active = activity.activity(fit, demos) if fit.spec.hierarchy else None
    timelines = demonstration_list.timelines(fit, demos, active, metrics) if active else []
    with style():
        page = {
            "header": sections.header(fit, metrics),
            "worth": worth.section(metrics),
            "likelihood": sections.likelihood(fit, metrics),
            "dimensions": dimensions.section(metrics, {name: other.metrics for name, other in fit.baselines.items()}),
            "rollouts": sections.rollouts(fit, metrics),
            "learning": sections.learning(fit),
            "options": option_figures.options(fit, demos, active, metrics) if active else None,
            "agreement": sections.agreement(fit, metrics),
            "looks": looks.section(fit, demos),
            "branches": sections.branches(fit, metrics),
            "warnings": sections.warnings(fit, metrics),
            "films": sections.films(fit),
            "particulars": sections.particulars(fit, metrics),
            "demonstrations": demonstration_list.listed(metrics, {timeline.anchor for timeline in timelines}),
            "timelines": timelines,
        }
    write_text(path, render("report/report.html.j2", page))
    return path
