"""Signs of a degenerate solution (SM 2.1), read from how the options are used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

UNUSED_SHARE = 0.01
DOMINATING_SHARE = 0.9
SHORTEST_DURATION = 1.5
AGAIN_AND_AGAIN = 3.0
"""Selections in each demonstration that has the option; an option may end after one step by design, such as a grasp."""

HIGH_FITTING_SHARE = 0.5
SMALLEST_DIVERGENCE = 0.1
"""Nats per step; two Gaussian policies whose means are 0.45 σ apart."""

Use = Sequence[Mapping[str, Any]]
"""How each choice of one level is used, control (0) first: its rows in ``metrics["options"]``."""

Alike = Sequence[Mapping[str, Any]]
"""How differently each two ``options`` of one level act: ``divergence`` in nats per step."""

Kind = Literal["unused", "redundant", "dominating", "never_persisting", "high_fitting"]

ADVICE: Mapping[Kind, str] = {
    "unused": "Fewer options may do: compare hierarchy.levels.*.count by cross-validation (ddco-pyro select), or start "
    "from clusters with training.initialize: vq and try more restarts.",
    "redundant": "Make them one and see what it costs (ddco-pyro merge), or compare hierarchy.levels.*.count by "
    "cross-validation (ddco-pyro select). If "
    "they should differ, start from clusters of observations and controls (training.initialize: vq_controls) or lower "
    "control.std, below which differences do not count.",
    "dominating": "Start from clusters (training.initialize: vq), train layer by layer (training.layerwise: true), or "
    "give the options' policies less capacity, so that one of them cannot do all the work.",
    "never_persisting": "A simpler termination (network: linear), fewer options, or observations that change more "
    "slowly (differences: false) let options last.",
    "high_fitting": "Train layer by layer (training.layerwise: true), give the calling policy less capacity, or let it "
    "emit options only (emits: [options]).",
}
"""What usually helps."""


@dataclass(frozen=True)
class Finding:
    """One sign of a degenerate solution: its ``kind``, the ``level`` (1 is the lowest) and ``choice`` it concerns, and
    the ``value`` that gave it away: a share of the time, a duration in steps, or nats per step. A redundant option acts
    like the ``other``; one that never persists has so many ``selections`` in each demonstration that has it.
    """

    kind: Kind
    level: int
    choice: int
    value: float
    other: int = 0
    selections: float = 0.0

    @property
    def advice(self) -> str:
        """What usually helps."""
        return ADVICE[self.kind]


def diagnose(options: Sequence[Use], divergences: Sequence[Alike] = ()) -> list[Finding]:
    """The signs found in ``metrics["options"]`` and ``metrics["divergences"]``, levels lowest first.

    An option is unused below 1 % of the time, and dominating above 90 % where it is not the only one. It never persists
    where it is expected to last less than 1.5 steps and is selected again and again, three times or more in each
    demonstration that has it: it ends at once, and its caller does all the work. Two options that are both used are
    redundant where they differ by less than 0.1 nats per step over the time that one of them is active. A caller is
    high-fitting where it emits the control itself in more than half of the time that it acts.
    """
    findings: list[Finding] = []
    for level, use in enumerate(options, start=1):
        for option in use[1:]:
            findings += _of_option(level, option, alone=len(use) == 2)
        findings += _of_pairs(level, use, divergences[level - 1] if divergences else ())
        above = options[level] if level < len(options) else None
        findings += _of_caller(level, float(use[0]["share"]), float(above[0]["share"]) if above else 0.0)
    return findings


def _of_option(level: int, use: Mapping[str, Any], alone: bool) -> list[Finding]:
    choice, share, duration = int(use["choice"]), float(use["share"]), use["duration"]
    if share < UNUSED_SHARE:
        return [Finding("unused", level, choice, share)]
    findings = []
    if share > DOMINATING_SHARE and not alone:
        findings.append(Finding("dominating", level, choice, share))
    within = float(use.get("demonstrations", 0.0))  # runs of before do not have it
    selections = float(use["selected"]) / within if within else 0.0
    if duration is not None and duration < SHORTEST_DURATION and selections >= AGAIN_AND_AGAIN:
        findings.append(Finding("never_persisting", level, choice, float(duration), selections=selections))
    return findings


def _of_pairs(level: int, use: Use, alike: Alike) -> list[Finding]:
    used = {int(row["choice"]) for row in use if float(row["share"]) >= UNUSED_SHARE}
    return [
        Finding("redundant", level, second, float(pair["divergence"]), first)
        for pair in alike
        for first, second in [pair["options"]]
        if {first, second} <= used and pair["divergence"] is not None and pair["divergence"] < SMALLEST_DIVERGENCE
    ]


def _of_caller(level: int, control: float, not_acting: float) -> list[Finding]:
    """The caller of a level acts unless the level above has control already, ``not_acting`` of the time."""
    acting = 1.0 - not_acting
    if acting < UNUSED_SHARE:
        return []
    own = (control - not_acting) / acting
    return [Finding("high_fitting", level, 0, own)] if own > HIGH_FITTING_SHARE else []
