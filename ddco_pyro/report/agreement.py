"""Agreement of options with ground-truth labels, in the report."""

from __future__ import annotations

from collections.abc import Sequence

from ddco_pyro.drawing.page import Block, Section, Table, Text, note
from ddco_pyro.drawing.words import option_name, percent
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Confusion
from ddco_pyro.report.options import quoted
from ddco_pyro.segmenting.agreement import EXPLAINED, agreement_table


def section(fit: Fit) -> Section | None:
    """The measures of each level, and where the steps of each label lie; None where the spec names no labels."""
    record = fit.metrics.agreement
    if not record or fit.spec.hierarchy is None:
        return None
    names = [level.name for level in fit.spec.hierarchy.levels]
    parts = {"held out": record.valid, "training": record.train}
    scores = {
        f"{level}, {words}" if len(names) > 1 else words: found[place]
        for place, level in enumerate(names)
        for words, found in parts.items()
        if found is not None
    }
    labels = quoted(list(dict.fromkeys(record.labels)))
    blocks: list[Block] = [Text(f"Options and the ground-truth {labels}."), agreement_table(scores), note(EXPLAINED)]
    for level, label, own in zip(names, record.labels, record.confusion, strict=True):
        title = f"Where each label’s steps lie: level “{level}”, label “{label}”"
        blocks += [Text(title, "heading"), confusion_table(own, fit.names[level])]
    part = "training" if record.valid is None else "held-out"
    blocks.append(
        note(
            f"Share of the steps of each label, {part} demonstrations. “Stands for”: the label matched with the "
            "option in all demonstrations; – for an option without a label. The steps of a label without an option "
            "lie in options that stand for other labels."
        )
    )
    return Section("agreement", "Agreement with ground truth", blocks)


def confusion_table(record: Confusion, names: Sequence[str] = ()) -> Table:
    """Share of each label's steps in each option, and the label of each option.

    :param names: of each choice, control first.
    """
    rows = [
        [str(label), str(sum(steps)), *(percent(count / sum(steps)) if count else "" for count in steps)]
        for label, steps in zip(record.labels, record.steps, strict=True)
    ]
    matched = ["–" if label is None else str(label) for label in record.matched]
    options = [option_name(option, names) for option in record.options]
    return Table(["Label", "Steps", *options], [*rows, ["stands for", "", *matched]])
