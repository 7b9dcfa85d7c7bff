"""Signs of a degenerate solution in words."""

from __future__ import annotations

from ddco_pyro.drawing.words import number, percent
from ddco_pyro.evaluation.diagnostics import Finding


def warning(finding: Finding, level: str) -> str:
    """A sign of a degenerate solution, in words with its number."""
    option = f"Option {finding.choice} of level “{level}”"
    share = percent(finding.value, 1)
    return {
        "unused": f"{option} is unused: it is active in {share} of all steps.",
        "dominating": f"{option} dominates: it is active in {share} of all steps.",
        "redundant": f"{option} does the same as option {finding.other}: over the time that one of them is active they "
        f"differ by {number(finding.value, 3)} nats per step.",
        "never_persisting": f"{option} never persists: it lasts {number(finding.value)} steps on average and is "
        f"selected {number(finding.selections, 1)} times in each demonstration that has it.",
        "high_fitting": f"High-fitting: the caller of level “{level}” emits the control itself in {share} of its "
        "steps, past its options.",
    }[finding.kind]
