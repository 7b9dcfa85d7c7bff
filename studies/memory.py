"""Are options worth it for being several, or for lasting? The page that pairs memoryless mixtures with other studies.

    python studies/memory.py

A mixture is the hierarchy of a study's spec whose options end after every step (``termination: always``): the same
demonstrations, training seeds, starts and gradient steps. ``docs/results/memory.csv`` has its numbers, and those of
options that were fitted again beside the mixtures. Pairs them by seed with the tables of those studies, and writes
``memory.md``, ``memory.png`` and the figure of the README. ``ddco-pyro study`` does further cells of ``needle.yaml``,
``pushing.yaml``, ``arena.yaml`` and ``bins.yaml``; ``planted_levels.py --memoryless`` those of planted levels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from table import RESULTS, ROOT, Row, over_seeds, read, spread

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.figures import FAINT, blank, save, style

OPTIONS, MIXTURE, FLAT, EQUAL = "options", "mixture", "flat", "flat_equal"
EM, FREE = "options by em", "options by em without ridges"
AGAIN = "options again"
"""Those that the code of the mixtures has fitted."""
DIFFERENCES = ((MIXTURE, FLAT), (MIXTURE, EQUAL), (OPTIONS, MIXTURE), (AGAIN, MIXTURE))
BY_EM = ((EM, OPTIONS), (FREE, OPTIONS), (EM, FREE))
ROUNDING = 1e-6
"""Two codes that do the same differ by less."""

ACTING_BY = ", acting by "
"""In a measure of the table, before how options are chosen."""
FAR_END = "flat far end"

Numbers = dict[str, Any]
"""A number, by column: ``study``, ``task``, ``method``, ``demonstrations``, ``seed``, ``acting``, ``measure``,
``value``.
"""

Values = dict[int, float]
"""By training seed."""


# --- what the other studies keep --------------------------------------------------------------------------------------


def numbers(rows: Iterable[Row]) -> list[Numbers]:
    """Rows of this study's table, with how options are chosen apart."""
    found = []
    for row in rows:
        measure, _, acting = row.measure.partition(ACTING_BY)
        found.append(row._asdict() | {"measure": measure, "acting": acting})
    return found


SOURCES: dict[str, tuple[str, str, dict[str, str]]] = {
    "needle": ("needle", "needle", {"ddco": OPTIONS, FLAT: FLAT, EQUAL: EQUAL}),
    "pushing": (
        "pushing",
        "perceptrons",
        {"DDCO MLP, k = 2": OPTIONS, "flat MLP": FLAT, "flat MLP, equal parameters": EQUAL},
    ),
    "arena": ("arena", "arena", {"ddco": OPTIONS, FLAT: FLAT, EQUAL: EQUAL}),
    "bins": ("bin_picking", "bin_picking", {"DDCO": OPTIONS, FLAT: FLAT, EQUAL: EQUAL}),
    "planted": ("segments", "planted_levels", {"segments": OPTIONS, "joint": OPTIONS, "layer-wise": OPTIONS}),
}
"""Of each study here: the table of its numbers, the study in that table, and what its methods are called here."""
ACTING_MEASURES = ("success", "goals")


def of_pages(root: Path = RESULTS) -> list[Numbers]:
    """The numbers of options and of flat policies that the other studies keep, by seed; only ways of acting that the
    study has of its own.
    """
    found = []
    for study, (table, name, methods) in SOURCES.items():
        for row in read(root / f"{table}.csv"):
            measured = row.measure in ("nats", "NMI", *ACTING_MEASURES) or row.measure.startswith("NMI, level")
            if row.study == name and row.method in methods and measured and row.seed is not None:
                task = row.task if study in ("arena", "planted") else study
                acting = "marginal" if row.measure in ACTING_MEASURES else ""
                own = {"study": study, "task": task, "method": methods[row.method], "acting": acting}
                found.append(row._asdict() | own)
    return found


# --- pairs ------------------------------------------------------------------------------------------------------------


def comparisons(rows: Sequence[Numbers], pages: Sequence[Numbers]) -> list[Numbers]:
    """For each study, task, number of demonstrations and measure that mixtures have: the values of each method, and
    differences of those that one is paired with by seed, over seeds.

    :param rows: of mixtures, and of options that were fitted again.
    :param pages: of options and flat policies, as the other studies keep them.
    """
    keys = dict.fromkeys(_key(row) for row in rows if row["method"] == MIXTURE)
    return [_compared(dict(zip(KEY, key, strict=True)), rows, pages) for key in sorted(keys, key=_order)]


KEY = ("study", "task", "demonstrations", "measure", "acting")
ORDER = ("needle", "pushing", "arena", "bins", "planted")


def _key(row: Numbers) -> tuple[Any, ...]:
    return tuple(row[key] for key in KEY)


def _order(key: tuple[Any, ...]) -> tuple[Any, ...]:
    study, task, count, measure, acting = key
    return (ORDER.index(study), task, count, measure != "nats", measure, acting)


def _in_order(one: Numbers) -> int:
    return ORDER.index(one["study"])


def _compared(named: Numbers, rows: Sequence[Numbers], pages: Sequence[Numbers]) -> Numbers:
    anyhow = named | {"acting": "marginal"} if named["acting"] else named  # flat policies act in one way
    values = {
        FLAT: _values(anyhow, FLAT, pages),
        EQUAL: _values(anyhow, EQUAL, pages),
        MIXTURE: _values(named, MIXTURE, rows),
        OPTIONS: _values(named, OPTIONS, pages),
        AGAIN: _values(named, OPTIONS, rows),
        EM: _values(named, EM, rows),
        FREE: _values(named, FREE, rows),
    }
    mixture = values[MIXTURE]
    found = named | {"values": values, "seeds": sorted(mixture)}
    found["again"] = values[AGAIN].keys() >= mixture.keys()
    found["mean"] = {name: over_seeds([own[seed] for seed in mixture if seed in own]) for name, own in values.items()}
    found["difference"] = {
        f"{more} - {less}": over_seeds(paired(values[more], values[less])) for more, less in (*DIFFERENCES, *BY_EM)
    }
    return found


def _values(named: Numbers, method: str, rows: Iterable[Numbers]) -> Values:
    wanted = (*(named[key] for key in KEY), method)
    return {row["seed"]: row["value"] for row in rows if (*_key(row), row["method"]) == wanted}


def paired(more: Values, less: Values) -> list[float]:
    """Differences of the seeds that both have, in the order of seeds."""
    return [more[seed] - less[seed] for seed in sorted(more.keys() & less.keys())]


def over_tasks(found: Sequence[Numbers]) -> list[Numbers]:
    """Of a study with several tasks: means over seeds, and over tasks with intervals over tasks."""
    groups: dict[tuple[Any, ...], list[Numbers]] = {}
    for one in found:
        if one["study"] == "arena":
            groups.setdefault((one["demonstrations"], one["measure"], one["acting"]), []).append(one)
    whole = []
    for group in groups.values():
        named = {key: group[0][key] for key in KEY} | {"task": f"mean of {len(group)} tasks"}
        named["seeds"] = sorted({seed for one in group for seed in one["seeds"]})
        named["again"] = all(one["again"] for one in group)
        named["fewest"] = min(len(one["seeds"]) for one in group)
        whole.append(named | {part: _over(group, part) for part in ("mean", "difference")})
    return whole


def _over(group: Sequence[Numbers], part: str) -> Numbers:
    names = group[0][part]
    means = {name: [one[part][name]["mean"] for one in group if one[part][name]["mean"] is not None] for name in names}
    return {name: over_seeds(values) for name, values in means.items()}


def checks(rows: Sequence[Numbers], pages: Sequence[Numbers]) -> list[Numbers]:
    """Of each cell of options that was fitted again by how much it differs from what its study keeps."""
    again = [row for row in rows if row["method"] == OPTIONS]
    kept = {(*_key(row), row["seed"]): row["value"] for row in pages if row["method"] == OPTIONS}
    return [row | {"kept": kept[name]} for row in again if (name := (*_key(row), row["seed"])) in kept]


# --- the page ---------------------------------------------------------------------------------------------------------

FORMS = {"nats": "{:.2f}", "success": "{:.0%}", "goals": "{:.1f}"}
NAMED = {"needle": "needle", "pushing": "pushing", "arena": "Meta-World", "bins": "bin picking", "planted": "planted"}


def form_of(one: Numbers, difference: bool = False) -> str:
    """How a measure is shown; pushing's likelihoods differ by hundredths."""
    form = (
        "{:.3f}" if one["measure"] == "nats" and one["study"] in ("pushing", "planted") else FORMS.get(one["measure"])
    )
    form = form or "{:.2f}"
    return form.replace("{:", "{:+") if difference else form


def table(found: Sequence[Numbers]) -> list[str]:
    """Lines of Markdown."""
    head = ["study", "demonstrations", "measure", "flat", "flat of equal size", "mixture", "options", "options again"]
    head += ["mixture − flat", "mixture − flat of equal size", "options − mixture", "options again − mixture", "seeds"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for one in found:
        name = NAMED[one["study"]] + (f", {one['task']}" if one["task"] != one["study"] else "")
        acting = f", {one['acting'].replace('_', ' ')}" if one["study"] == "pushing" and one["acting"] else ""
        cells = [name, str(one["demonstrations"]), one["measure"] + acting]
        cells += [_mean(one, method) for method in (FLAT, EQUAL, MIXTURE, OPTIONS, AGAIN)]
        cells += [_difference(one, more, less) for more, less in DIFFERENCES]
        lines.append(f"| {' | '.join([*cells, _seeds(one)])} |")
    return lines


def table_by_em(found: Sequence[Numbers]) -> list[str]:
    """Lines of Markdown: what another optimiser changes, where it was tried."""
    head = ["study", "demonstrations", "measure", *(f"{more} − {less}" for more, less in BY_EM)]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for one in found:
        if one["mean"][EM]["mean"] is not None:
            name = NAMED[one["study"]] + (f", {one['task']}" if one["task"] != one["study"] else "")
            cells = [name, str(one["demonstrations"]), one["measure"], *(_difference(one, *pair) for pair in BY_EM)]
            lines.append(f"| {' | '.join(cells)} |")
    return lines if len(lines) > 2 else []


def _seeds(one: Numbers) -> str:
    """How many seeds: of a mean over tasks of which some have fewer, ``1 to 3``."""
    most, fewest = len(one["seeds"]), one.get("fewest", len(one["seeds"]))
    return str(most) if fewest == most else f"{fewest} to {most}"


def _mean(one: Numbers, method: str) -> str:
    value = one["mean"][method]["mean"]
    return "-" if value is None else form_of(one).format(value)


def _difference(one: Numbers, more: str, less: str) -> str:
    own = one["difference"][f"{more} - {less}"]
    fewer = one["study"] != "arena" and own["mean"] is not None and len(own["by_seed"]) < len(one["seeds"])
    shown = spread(own, form_of(one, True)) + (f" ({len(own['by_seed'])} seeds)" if fewer else "")
    return f"**{shown}**" if own["interval"] and np.prod(np.sign(own["interval"])) > 0 else shown


def reproduced(found: Sequence[Numbers]) -> Iterator[str]:
    """A line for each study: which cells were fitted again, and by how much they differ."""
    for study in ORDER:
        own = [one for one in found if one["study"] == study]
        if not own:
            continue
        cells = dict.fromkeys((one["task"], one["demonstrations"], one["seed"]) for one in own)
        lines = [f"- {NAMED[study]}, {len(cells)} {'cell' if len(cells) == 1 else 'cells'} of options again:"]
        for measure in dict.fromkeys(one["measure"] for one in own):
            apart = [one["value"] - one["kept"] for one in own if one["measure"] == measure]
            same = sum(abs(value) < ROUNDING for value in apart)
            less = "" if same == len(apart) else f", at most {max(map(abs, apart)):.2g} apart"
            lines.append(f"{measure} reproduced: {same} of {len(apart)}{less};")
        yield " ".join(lines).rstrip(";") + "."


def page(found: Sequence[Numbers], again: Sequence[Numbers]) -> str:
    """The results as Markdown."""
    tasks, whole = [one for one in found if one["study"] == "arena"], over_tasks(found)
    main = sorted([*(one for one in found if one["study"] != "arena"), *whole], key=_in_order)
    lines = [
        "# Is it memory, or is it several policies?",
        "",
        "A hierarchy differs from a flat policy in two things. It has several policies behind a meta-policy that "
        "chooses among them, and what is chosen lasts. A *mixture* is the same hierarchy whose options end after every "
        "step, with the same networks, demonstrations, seeds, starts and gradient steps. So **mixture − flat** is what "
        "several policies are worth, and **options − mixture** is what it is worth that they last.",
        "",
        "Differences are paired by training seed: means with 95 % t intervals over seeds, and for Meta-World over "
        "tasks, of means over seeds. They are not corrected for the number of comparisons; bold ones leave out 0. "
        "Options and flat policies are of the studies' own tables, with the same demonstrations, seeds and starts. "
        "Starts: needle 60 with 20 demonstrations and 200 with 100, pushing 20 episodes of 2000 steps, Meta-World 20, "
        "bin picking 20 bins, where success is a bin that is cleared. Nats are per step, and NMI is with the labels; "
        "both are of held-out demonstrations. "
        "*Bin picking, flat far end* shows loads over the pile: its mixtures are hierarchies of "
        "commit 579683a with all logits of terminations at 40, beside the numbers of commit 9c3163b. "
        "Pushing's page has `marginal` alone of the three ways of choosing options; a flat policy acts in one way.",
        "",
        *table(main),
        "",
        "![Differences](memory.png)",
        "",
        "## Is the code the same?",
        "",
        *reproduced(again),
        "",
        "*Options* are the page's; *options again* are fitted by the code and on the machine of the mixtures. A fit is "
        "sensitive to last digits: on another machine the same seed gives another fit to the same demonstrations.",
    ]
    if by_em := table_by_em(main):
        lines += [
            "",
            "## By expectation-maximisation",
            "",
            "The same specs with the optimiser that `init` writes instead of Adam: expectation-maximisation, with "
            "ridges of 1. Pairs are by seed with the page's options. They differ in two things: the optimiser, which "
            "trains until it converges, and its ridges, which Adam has not. EM without ridges leaves the one.",
            "",
            *by_em,
        ]
    if tasks:
        lines += ["", "## Meta-World, by task", "", *table(tasks)]
    return "\n".join(lines) + "\n"


ACTED = (("needle", "success"), ("pushing", "goals"), ("arena", "success"), ("arena", "NMI"), ("bins", "success"))
"""The measures of acting, and of segments, in the figure of README."""


def shortest(found: Sequence[Numbers]) -> list[Numbers]:
    """The rows of README: of each measure of :data:`ACTED` the one with most demonstrations.

    Options are those that were fitted again, where all were.
    """
    rows = [one for one in [*found, *over_tasks(found)] if one["acting"] in ("", "marginal")]
    rows = [one for one in rows if one["task"] == one["study"] or one["task"].startswith("mean of")]
    chosen = []
    for named in ACTED:
        one = max(
            (one for one in rows if (one["study"], one["measure"]) == named), key=lambda one: one["demonstrations"]
        )
        lasting = one["difference"][f"{AGAIN if one['again'] else OPTIONS} - {MIXTURE}"]
        both = {f"{MIXTURE} - {FLAT}": one["difference"][f"{MIXTURE} - {FLAT}"], f"{OPTIONS} - {MIXTURE}": lasting}
        chosen.append(one | {"acting": "", "difference": both})
    return chosen


# --- the figure -------------------------------------------------------------------------------------------------------

COLOURS = {f"{MIXTURE} - {FLAT}": "#c08a30", f"{OPTIONS} - {MIXTURE}": "#1f3f70", f"{AGAIN} - {MIXTURE}": "#84a7d3"}
PANELS: dict[str, Callable[[str], bool]] = {
    "held-out nats per step": lambda measure: measure == "nats",
    "NMI with labels": lambda measure: measure.startswith("NMI"),
    "success": lambda measure: measure == "success",
    "goals": lambda measure: measure == "goals",
}


def everything(found: Sequence[Numbers]) -> list[Numbers]:
    """The rows of the page's figure: every comparison, of Meta-World the means over tasks."""
    return sorted([*(one for one in found if one["study"] != "arena"), *over_tasks(found)], key=_in_order)


def draw(rows: Sequence[Numbers], path: Path, columns: int = 2) -> None:
    """The two differences of every comparison, a panel for each measure; in one column on half the width."""
    groups = {name: [one for one in rows if belongs(one["measure"])] for name, belongs in PANELS.items()}
    groups = {name: group for name, group in groups.items() if group}
    with style():
        sizes = [len(group) for group in groups.values()]
        heights = sizes if columns == 1 else [max(sizes)] * -(-len(sizes) // columns)
        figure = blank(1.2 + 0.24 * sum(heights) + (columns == 1) * 0.5 * len(heights))
        figure.set_figwidth(figure.get_figwidth() * columns / 2)
        panels = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights).flatten()
        for axes, (name, group) in zip(panels, groups.items(), strict=False):
            _panel(axes, name, group)
        for axes in panels[len(groups) :]:
            axes.set_axis_off()
        named = [one for axes in panels for one in zip(*axes.get_legend_handles_labels(), strict=True)]
        handles = {label: handle for handle, label in named}
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=2)
        save(figure, path, "What several policies are worth, and what it is worth that they last", "")


def _panel(axes: Axes, name: str, group: Sequence[Numbers]) -> None:
    for place, one in enumerate(group):
        for shift, (difference, colour) in zip((-0.22, 0, 0.22), COLOURS.items(), strict=True):
            own = one["difference"].get(difference)
            if own is None or own["mean"] is None:
                continue
            axes.plot(own["mean"], place + shift, "o", ms=4, color=colour, label=_once(axes, difference))
            if own["interval"]:
                axes.plot(own["interval"], [place + shift] * 2, lw=2, color=colour, alpha=0.6)
    axes.axvline(0, color=FAINT, lw=0.7)
    axes.set(title=name, yticks=range(len(group)), yticklabels=list(map(_label, group)))
    axes.set_ylim(len(group) - 0.5, -0.5)
    if name.startswith("held-out"):
        axes.set_xscale("symlog", linthresh=0.1)
        axes.set_xticks([-1, -0.1, 0, 0.1, 1, 5])
        axes.xaxis.set_major_formatter("{x:g}")
    if name == "success":
        axes.set_xlim(-0.6, 0.6)


def _once(axes: Axes, difference: str) -> str | None:
    label = difference.replace(" - ", " − ")
    return None if label in axes.get_legend_handles_labels()[1] else label


def _label(one: Numbers) -> str:
    words = [NAMED[one["study"]], str(one["demonstrations"])]
    words += [one["task"]] if one["study"] == "planted" else []
    words += [one["acting"].replace("_", " ")] if one["measure"] == "goals" and one["acting"] else []
    words += [one["measure"].removeprefix("NMI, ")] if one["measure"].startswith("NMI,") else []
    return " ".join(words)


# --- the files --------------------------------------------------------------------------------------------------------


def write_page(out: Path) -> str:
    """``memory.md`` and ``memory.png`` beside the table, and README's figure; the page."""
    found, again = compared(out)
    shown = page(found, again)
    write_text(out.with_suffix(".md"), shown)
    draw(everything(found), out.with_suffix(".png"))
    draw(shortest(found), ROOT / "docs" / "images" / "worth.png", columns=1)
    return shown


def compared(path: Path = RESULTS / "memory.csv") -> tuple[list[Numbers], list[Numbers]]:
    """What mixtures say beside the numbers of the other studies, and options that were fitted again beside theirs."""
    own = numbers(read(path))
    far = [one for one in own if one["task"] == FAR_END]  # of a bin that the tree has no more
    rows = [one for one in own if one["task"] != FAR_END or one["method"] == MIXTURE]
    pages = [*of_pages(), *(one for one in far if one["method"] != MIXTURE)]
    return comparisons(rows, pages), checks(rows, pages)


if __name__ == "__main__":
    print(write_page(RESULTS / "memory.csv"))
