"""Agreement of options with ground-truth labels, in the report."""

from __future__ import annotations

from collections.abc import Sequence

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import label_names
from ddco_pyro.drawing.page import Block, Section, Table, Text, footnote, note
from ddco_pyro.drawing.words import capital, number, percent
from ddco_pyro.evaluation.agreement import EXPLAINED, agreement_table, tolerances
from ddco_pyro.evaluation.effort import contributions, recogniser
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Confusion, Scores
from ddco_pyro.names import label_name, option_name
from ddco_pyro.report.options import quoted
from ddco_pyro.segmenting.baselines import BASELINES, EQUAL, RECOGNISED


def section(fit: Fit, demos: Demonstrations) -> Section | None:
    """The measures of each level, and where the steps of each label lie; None where the spec names no labels."""
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
                    scores[f"{before}{RECOGNISED}, {words}"] = record.recogniser[part]
                if equal:
                    scores[f"{before}{BASELINES[EQUAL]}, {words}"] = equal[place]
    known = label_names(demos.attributes)
    compared = quoted(fit.spec.demonstrations.label_names)
    blocks: list[Block] = [Text(f"Options and the ground-truth {compared}."), agreement_table(scores)]
    blocks.append(footnote(f"{EXPLAINED} {tolerances(demos.frequency)}"))
    if told := recogniser(fit.metrics.training):
        blocks.append(Text(f"{capital(told)}."))
    if each := contributions(fit.metrics.training):
        rows = [[name, number(accuracy), number(edit)] for name, (accuracy, edit) in each.items()]
        blocks += [Text("Left-out labelled demonstrations", "heading"), Table(["", "Accuracy", "Edit score"], rows)]
    for level, label, own in zip(names, truth, record.confusion, strict=True):
        names_of_labels = [label_name(label, value, known.get(label, ()), level) for value in own.labels]
        title = f"Where each label’s steps lie: level “{level}”, label “{label}”"
        blocks += [Text(title, "heading"), confusion_table(own, fit.names[level], names_of_labels)]
    part = "training" if record.valid is None else "held-out"
    blocks.append(
        note(
            f"Share of the steps of each label, {part} demonstrations. “Stands for”: the label matched with the "
            "option in all demonstrations; – for an option without a label. The steps of a label without an option "
            "lie in options that stand for other labels."
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
