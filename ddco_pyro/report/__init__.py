"""A run as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

import jinja2

from ddco_pyro.demonstrations import Demonstrations
from ddco_pyro.files import write_text
from ddco_pyro.report import dimensions, sections
from ddco_pyro.report.pictures import style
from ddco_pyro.report.sections import degeneracies
from ddco_pyro.run import Fit

__all__ = ["degeneracies", "write_report"]


def write_report(fit: Fit, demos: Demonstrations) -> Path:
    """Write ``report.html`` and ``figures/`` into the run folder; the path of the page.

    :param demos: the demonstrations the fit was made from.
    """
    metrics = fit.metrics
    with style():
        page = {
            "header": sections.header(fit, metrics),
            "likelihood": sections.likelihood(fit, metrics),
            "dimensions": dimensions.section(metrics, {name: one.metrics for name, one in fit.baselines.items()}),
            "rollouts": sections.rollouts(fit, metrics),
            "learning": sections.learning(fit),
            "options": sections.options(fit, demos, metrics),
            "warnings": sections.warnings(fit, metrics),
            "films": sections.films(fit),
            "particulars": sections.particulars(fit, metrics),
        }
    path = fit.folder / "report.html"
    write_text(path, _template().render(page))
    return path


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ddco_pyro.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2")
