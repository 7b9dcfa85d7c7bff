"""Rollouts in the report: success in the task, and films."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from markupsafe import Markup

from ddco_pyro.drawing.figures import film
from ddco_pyro.drawing.page import Block, Columns, Drawing, Section, Table, Text, note
from ddco_pyro.drawing.words import P_VALUE, interval, measure, number, p_value, rate
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Mean, Measure, Method, read_successes
from ddco_pyro.names import method

MOST_BYTES = 4_000_000
"""Films are held in the page up to this size together; the page links to the others."""


def success(fit: Fit) -> Section | None:
    """The measures of all methods and the paired comparison of success; None where nothing was rolled out."""
    record = fit.metrics.rollouts
    if not record:
        return None
    methods = record.methods
    explained = (
        "Rates: successes of trials (Wilson 95 % interval). Other measures: mean ± standard deviation [95 % "
        "interval of the mean], n episodes in which the measure is known."
    )
    states = f"the same initial states (seeds from {record.seed})"
    text = f"{record.episodes} episodes of each method from {states}."
    blocks: list[Block] = [Text(text), measures_table(methods), note(explained)]
    if paired := paired_table(methods, fit.metrics.model):
        blocks += [Text("Paired comparison of success", "heading"), paired, note(P_VALUE)]
    return Section("rollouts", "Success in the task", blocks)


def measures_table(methods: Mapping[str, Method], title: str | None = None) -> Table:
    """Every measure of every method, as in the paper's table."""
    names = list(dict.fromkeys(name for entry in methods.values() for name in entry.measures))
    rows = [[method(key), *(_cell(own.measures.get(name)) for name in names)] for key, own in methods.items()]
    return Table(["Method", *map(measure, names)], rows, title=title)


def _cell(summary: Measure | None) -> str:
    if summary is None:
        return "–"
    if not isinstance(summary, Mean):
        return rate(summary)
    if not summary.trials:
        return "– (n = 0)"
    spread = "" if summary.std is None else f" ± {number(summary.std)} [{interval(summary.interval)}]"
    return f"{number(summary.mean)}{spread}, n = {summary.trials}"


def paired_table(methods: Mapping[str, Method], ours: str) -> Table | None:
    """The paired comparison of success on the same initial states; None where there is none."""
    rows = [
        [method(name), str(pair.only_ours), str(pair.only_theirs), str(pair.trials), p_value(pair.p_value)]
        for name, results in methods.items()
        if (pair := results.against)
    ]
    successes = [f"Only {method(ours)}: success", "Only the other: success"]
    head = [f"{method(ours)} against", *successes, "Episodes", "p"]
    return Table(head, rows) if rows else None


def films(fit: Fit) -> Section | None:
    """Filmed rollouts, the model's first; None where nothing was filmed."""
    folder = fit.run_folder
    filmed = (folder / "videos").glob("*.mp4")
    paths = sorted(filmed, key=lambda path: (_named(path)[0] != fit.name, *_named(path)))
    if not paths:
        return None
    explained = "The border has the colour of the lowest level’s option; h1 is its number."
    return Section("films", "Films", [Columns(films_of(folder, paths)), note(explained)])


def films_of(folder: Path, paths: list[Path]) -> list[Drawing]:
    """The films of a run folder with their outcomes, the first ones held in the page."""
    successes = read_successes(folder).items()
    outcomes = {key: ": success" if value == 1 else ": failure" for key, value in successes}
    left, films = MOST_BYTES, []
    for path in paths:
        name, seed = _named(path)
        held = path.stat().st_size <= left
        left -= path.stat().st_size if held else 0
        caption = f"{method(name)}, seed {seed}{outcomes.get((name, seed), '')}"
        link = Markup('{} – <a href="{}">{}</a>').format(caption, *[f"videos/{path.name}"] * 2)
        films.append(film(path.read_bytes(), caption) if held else Drawing(Markup(), link))
    return films


def _named(path: Path) -> tuple[str, int]:
    """The method and the seed of a film."""
    name, _, seed = path.stem.rpartition("-")
    return name, int(seed)
