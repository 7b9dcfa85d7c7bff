"""Options in the report: use of each, where it is active in space, its segments, agreement with labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from markupsafe import Markup

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import label_names
from ddco_pyro.drawing.figures import MOST_PATHS, paths_of_options, save
from ddco_pyro.drawing.page import Block, Cell, Section, Table, Text, footnote, note
from ddco_pyro.drawing.shown import in_words
from ddco_pyro.drawing.timeline import Timelines
from ddco_pyro.drawing.words import capital, duration, number, percent
from ddco_pyro.evaluation.agreement import EQUAL, EXPLAINED, agreement_table, tolerances
from ddco_pyro.evaluation.verdicts import contributions, recogniser
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Confusion, Scores
from ddco_pyro.names import label_name, numbered_name, option_colour, option_name
from ddco_pyro.report.skills import Shown, agreeing
from ddco_pyro.segmenting.page import HOW, use_by_task
from ddco_pyro.segmenting.segments import Segmented

ROWS = 6
"""Time lines that are seen at once."""

MOST_STEPS = 1_000_000
"""Steps of all levels in time lines, about; ``ddco-pyro segment --html`` makes a page of more."""


def section(fit: Fit, segmented: Segmented, shown: Shown) -> Section:
    """How each option is used, and the paths in space, in ``figures/trajectories.svg`` too."""
    blocks: list[Block] = []
    if len(fit.names) > 1:
        named = " Legends give the names of the highest level first." if fit.named else ""
        apart = "Each level numbers its own options: equal colours in two levels mean nothing."
        blocks.append(Text(apart + named))
    for level in reversed(fit.names) if shown.paths else ():
        options = [demo.levels[level].options for demo in segmented.segments]
        drawing = paths_of_options(shown.paths, options)
        name = "trajectories" if len(fit.names) == 1 else f"trajectories-{level}"
        caption = (
            f"Level “{level}”: {min(len(options), MOST_PATHS)} demonstrations, coloured by the most likely "
            f"option: {in_words(shown.drawn, shown.demos)}. Circles: first steps."
        )
        blocks.append(save(drawing, fit.run_folder / "figures" / f"{name}.svg", caption))
    blocks += [Text("Use of the options", "heading"), use_table(fit)]
    anew = "The same option chosen anew stays one segment."
    blocks.append(note(f"On the most likely path of all demonstrations. {anew}"))
    for level in reversed(fit.names):
        blocks += use_by_task(segmented, level)
    link = Markup('<a href="#segments">segments of every demonstration</a>')
    blocks.append(Text(Markup("Step by step: {}.").format(link)))
    return Section("options", "How the options are used", blocks, folded=True)


def use_table(fit: Fit) -> Table:
    """The use of each choice of each level, the highest level first; control only where it is chosen."""
    rows, stands_for = [], {(one.level, one.option): agreeing(one) for one in fit.metrics.named_by_labels}
    for (level, names), use in reversed(list(zip(fit.names.items(), fit.metrics.options, strict=True))):
        total = sum(row.steps for row in use)
        for row in use:
            if row.choice or row.segments:
                named = Cell(numbered_name(row.choice, names), colour=option_colour(row.choice))
                length = "–" if row.length is None else duration(fit.metrics.control_frequency, row.length)
                label = [stands_for.get((level, row.choice), "–")] if stands_for else []
                rows.append([level, named, percent(row.steps / total, 1), str(row.segments), length, *label])
    head = ["Level", "Option", "Share of steps", "Segments", "Median length"]
    return Table([*head, *(["Label, agreement"] if stands_for else [])], rows, {0, 1, 5})


# --- segments -----------------------------------------------------------------------------------------------


def segments(drawn: Timelines, demonstrations: int) -> Section:
    """The time lines; a note on the others where not all of so many demonstrations have one."""
    explained = Markup('{} The order is that of the <a href="#demonstrations">list</a>.').format(HOW)
    blocks: list[Block] = [note(explained), replace(drawn, rows=ROWS)]
    if len(drawn.tracks) < demonstrations:
        command = Markup("<code>ddco-pyro segment RUN FILE --html PAGE</code>")
        others = Markup("The others would make this page slow; {} makes a page of them.")
        blocks.append(note(others.format(command)))
    return Section("segments", "Segments of every demonstration", blocks)


# --- labels -------------------------------------------------------------------------------------------------


def agreement(fit: Fit, demos: Demonstrations) -> Section | None:
    """The measures of each level, and where the steps of each label lie; None if the spec names no labels."""
    record = fit.metrics.agreement
    names, truth = list(fit.names), fit.spec.demonstrations.labels_by_level(len(fit.names))
    if not record or not truth:
        return None
    scores, given = dict[str, Scores | None](), fit.spec.training.labels
    sides = (
        ("held out", "valid", record.valid, record.equal_valid),
        ("training", "train", record.train, record.equal_train),
    )
    for place, level in enumerate(names):
        before = f"{level}: " if len(names) > 1 else ""
        for words, part, found, equal in sides:
            if found is not None:
                scores[f"{before}options, {words}"] = found[place]
                if given is not None and level == given.level and part in record.recogniser:
                    scores[f"{before}recogniser alone, {words}"] = record.recogniser[part]
                if equal:
                    scores[f"{before}{EQUAL}, {words}"] = equal[place]
    known = label_names(demos.attributes)
    compared = " and ".join(f"“{name}”" for name in fit.spec.demonstrations.label_names)
    blocks: list[Block] = [Text(f"Options and the ground-truth label {compared}."), agreement_table(scores)]
    blocks.append(footnote(f"{EXPLAINED} {tolerances(demos.frequency)}"))
    if told := recogniser(fit.metrics.training):
        blocks.append(Text(f"{capital(told)}."))
    if each := contributions(fit.metrics.training):
        rows = [[name, number(accuracy), number(edit)] for name, (accuracy, edit) in each.items()]
        table = Table(["", "Accuracy", "Edit score"], rows)
        blocks += [Text("Left-out labelled demonstrations", "heading"), table]
    for level, label, own in zip(names, truth, record.confusion, strict=True):
        names_of_labels = [label_name(label, value, known.get(label, ()), level) for value in own.labels]
        title = f"Where each label’s steps lie: level “{level}”, label “{label}”"
        blocks += [Text(title, "heading"), confusion_table(own, fit.names[level], names_of_labels)]
    part = "training" if record.valid is None else "held-out"
    blocks.append(
        note(
            f"Share of the steps of each label, {part} demonstrations. “Stands for”: the label matched with "
            "the option in all demonstrations; – for an option without a label. The steps of a label without "
            "an option lie in options that stand for other labels."
        )
    )
    return Section("agreement", "Agreement with ground truth", blocks)


def confusion_table(record: Confusion, names: Sequence[str], labels: Sequence[str]) -> Table:
    """Share of each label's steps in each option, and the label of each option.

    :param names: of each choice, control first.
    :param labels: the names of the table's labels.
    """
    rows = [
        [label, str(sum(steps)), *(percent(count / sum(steps)) if count else "" for count in steps)]
        for label, steps in zip(labels, record.steps, strict=True)
    ]
    matched = ["–" if value is None else labels[record.labels.index(value)] for value in record.matched]
    options = [option_name(option, names) for option in record.options]
    return Table(["Label", "Steps", *options], [*rows, ["stands for", "", *matched]])
