"""Use and divergence of options, and the signs of a degenerate solution (SM 2.1)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.drawing.words import capital, duration, listed, number, percent
from ddco_pyro.evaluation.verdicts import Direction, said
from ddco_pyro.inference import Posterior
from ddco_pyro.metrics import Alike, Metrics, Segments, Use
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.names import numbered_name
from ddco_pyro.spec import Spec, TrainingSpec
from ddco_pyro.training.initialization import WAYS


def run_lengths(choices: Iterable[np.ndarray], count: int) -> list[np.ndarray]:
    """The lengths of the runs of each choice 0 to ``count``; a run lasts while the choice is the same.

    >>> run_lengths([np.array([1, 1, 2, 1]), np.array([2, 2])], 2)
    [array([], dtype=int64), array([1, 2]), array([1, 2])]

    :param choices: of each demonstration [T], -1 past its end.
    """
    found: list[list[int]] = [[] for _ in range(1 + count)]
    for row in choices:
        known = row[row >= 0]
        starts = np.flatnonzero(np.diff(known, prepend=-1))
        for start, length in zip(starts, np.diff(starts, append=len(known)), strict=True):
            found[known[start]].append(int(length))
    return [np.sort(np.array(lengths, int)) for lengths in found]


class OnPaths(NamedTuple):
    """One choice on the most likely paths of demonstrations.

    :param lengths: steps of its segments in rising order; the same option chosen anew stays one segment.
    :param having: the number of demonstrations with a segment.
    :param within: the share of their steps that it takes; None where all demonstrations have it, or none.
    """

    lengths: np.ndarray
    having: int
    within: float | None


def on_paths(paths: Sequence[np.ndarray], count: int) -> list[OnPaths]:
    """Each choice 0 to ``count`` on the paths [T] of demonstrations; -1 past an end is no choice."""
    steps, found = np.array([(path >= 0).sum() for path in paths]), []
    for choice, lengths in enumerate(run_lengths(paths, count)):
        having = np.array([bool((path == choice).any()) for path in paths])
        within = float(lengths.sum() / steps[having].sum()) if having.any() and not having.all() else None
        found.append(OnPaths(lengths, int(having.sum()), within))
    return found


def option_use(posterior: Posterior, paths: Iterable[Sequence[np.ndarray]]) -> list[list[Use]]:
    """The use of every choice of each level, lowest first.

    :param paths: the most likely choices [T] of each demonstration, for each level.
    """
    uses = []
    for u, v, path in zip(posterior.u, posterior.v, paths, strict=True):
        active, selected = u.sum((0, 1)).numpy(), v.sum(1).numpy()
        often, within = selected.sum(0), selected.clip(max=1.0).sum(0)
        uses.append(
            [
                Use(
                    choice=choice,
                    share=float(active[choice] / active.sum()),
                    selected=float(often[choice]),
                    demonstrations=float(within[choice]),
                    duration=float(active[choice] / often[choice]) if often[choice] > 1e-6 else None,
                    segments=len(one.lengths),
                    steps=int(one.lengths.sum()),
                    length=float(np.median(one.lengths)) if one.having else None,
                    having=one.having,
                    within=one.within,
                )
                for choice, one in enumerate(on_paths(path, len(active) - 1))
            ]
        )
    return uses


TWITCH_SECONDS = 0.5
TWITCH_STEPS = 5
TWITCH_SHARE = 1 / 50
"""A segment is a twitch where it is shorter: by the first where the rate is known, else by the others, of
which the last is a share of its demonstration."""


def segments_of(paths: Sequence[np.ndarray], frequency: float | None = None) -> Segments:
    """The segments of a level on the most likely paths [T] of demonstrations.

    :param frequency: of the control, Hz; None where unknown.
    """
    most = max(int(path.max()) for path in paths)
    each = [np.concatenate(run_lengths([path], most)) for path in paths]
    unknown = (max(TWITCH_STEPS, TWITCH_SHARE * own.sum()) for own in each)
    shortest = (TWITCH_SECONDS * frequency if frequency else least for least in unknown)
    twitches = sum(int((own < least).sum()) for own, least in zip(each, shortest, strict=True))
    every = np.concatenate(each)
    median = float(np.median(every))
    return Segments(median=median, number=len(every), demonstrations=len(paths), twitches=twitches)


def divergences(pieces: Iterable[tuple[Outputs, Posterior]]) -> list[list[Alike]]:
    """The ``divergence`` of each pair of ``options`` of each level, lowest first, nats per step.

    The divergence is the mean of KL(π_i ‖ π_j) and KL(π_j ‖ π_i), averaged over steps with weights u_t(i) +
    u_t(j); None where neither option is ever active. Two options with divergence 0 are one skill twice.

    :param pieces: outputs of the networks and posteriors of demonstrations.
    """
    levels: list[Tensor | float] = []
    for outputs, posterior in pieces:
        levels = levels or [0.0 for _ in posterior.u]
        for place, (own, u) in enumerate(zip(outputs.callers[:-1], posterior.u, strict=True)):
            own = own.map(Tensor.double)
            each = [_divergence(own, i, u) for i in range(u.shape[-1] - 1)]
            levels[place] = levels[place] + torch.stack(each)
    return [
        [
            Alike(options=(i + 1, j + 1), divergence=total / weight if weight > 0 else None)
            for i, row in enumerate(level.tolist())
            for j, (total, weight) in enumerate(row)
            if i < j
        ]
        for level in levels
        if isinstance(level, Tensor)
    ]


def _divergence(own: CallerOutputs, i: int, u: Tensor) -> Tensor:
    """Of option i and each option: the weighted sum over the steps, and the sum of the weights, [k, 2]."""
    options, q = u[..., 1:], own.selection
    p = q[:, :, i : i + 1]
    both = torch.isfinite(p) & torch.isfinite(q)  # callers of a level emit the same kinds of choices
    steps = torch.where(both, 0.5 * (p.exp() - q.exp()) * (p - q), 0.0).sum(-1)
    control = 0.5 * (p[..., 0].exp() + q[..., 0].exp())  # mean probability of emitting the control
    if own.emission is not None:
        steps = steps + control * own.emission.divergence(i)
    weight = options[..., i : i + 1] + options
    return torch.stack([(weight * steps).sum((0, 1)), weight.sum((0, 1))], dim=-1)


UNUSED_SHARE = 0.01
DOMINATING_SHARE = 0.9
SHORTEST_DURATION = 1.5
AGAIN_AND_AGAIN = 3.0
"""Selections in each demonstration with the option; one of a single step may be meant, such as a grasp."""

HIGH_FITTING_SHARE = 0.5
SMALLEST_DIVERGENCE = 0.1
"""Nats per step; two Gaussian policies whose means are 0.45 σ apart."""

WHOLE = 0.9
"""An option with this share of the steps of its demonstrations takes them whole."""
MOSTLY = 2 / 3
"""The same share where no more than half of the demonstrations have the option."""


Kind = Literal["unused", "redundant", "dominating", "whole", "never_persisting", "brief", "high_fitting"]

ADVICE: Mapping[Kind, str] = {
    "unused": "Fewer options may do: compare hierarchy.levels.*.count by cross-validation (ddco-pyro "
    "select), or try more starts (training.starts).",
    "redundant": "Fewer options may do: compare hierarchy.levels.*.count by cross-validation (ddco-pyro "
    "select). If they should differ, lower control.std, below which differences do not count.",
    "dominating": "Train layer by layer (training.layerwise: true), or give the options' policies less "
    "capacity, so that one of them cannot do all the work.",
    "whole": "Observe what is alike in all demonstrations: write positions relative to the first step, or "
    "differences alone, into the file.",
    "never_persisting": "A simpler termination (network: linear), fewer options, or observations that change "
    "more slowly (differences: false) let options last.",
    "brief": "Options so short are parts of one movement, not skills. Ask for longer ones (control.power, or "
    "ddco-pyro init --segment), take fewer options, or import at a lower rate (ddco-pyro import --hz).",
    "high_fitting": "Train layer by layer (training.layerwise: true), give the calling policy less capacity, "
    "or let it emit options only (emits: [options]).",
}
"""The usual remedies."""

LABELS = (
    "Equal parts know nothing but the time. Observe what tells the labels apart, start from some of them "
    "(training.labels), or start from equal parts (training.starts: [equal_parts])."
)
"""The same where equal parts agree better with labels."""

START: Mapping[Kind, str] = {"unused": "vq", "redundant": "vq_controls", "dominating": "vq"}
"""The initialisation from clusters that is a remedy, too, unless training starts from labels or clusters."""


@dataclass(frozen=True)
class Finding:
    """A sign of a degenerate solution.

    :param level: the level, 1 is the lowest.
    :param choice: the choice of the level.
    :param value: a share of the time, a duration in steps, or nats per step.
    :param other: the option that acts like a redundant one.
    :param times: selections of an option that never persists, in each demonstration with the option; the
        number of demonstrations that an option takes whole; the share of twitches of a brief level.
    """

    kind: Kind
    level: int
    choice: int
    value: float
    other: int = 0
    times: float = 0.0

    def advice(self, training: TrainingSpec) -> str:
        """The usual remedy for a model that was trained so."""
        start = START.get(self.kind)
        if start is None or training.labels or {start, "vq_controls"} & {*training.starts}:
            return ADVICE[self.kind]
        return f"{ADVICE[self.kind]} Or start from clusters, too (training.starts: [{start}])."

    def options(self, names: Sequence[str]) -> str:
        """The option, or the two options that act alike, by the names of a level's choices."""
        both = (self.other, self.choice) if self.other else (self.choice,)
        return listed(numbered_name(option, names) for option in both)

    def amount(self, frequency: float | None) -> str:
        """The value in words; the frequency is that of the control in Hz, None where unknown."""
        if self.kind == "redundant":
            return number(self.value, 3)
        if self.kind == "never_persisting":
            lasts = duration(frequency, self.value)
            return f"{lasts}, selected {number(self.times, 1)} times a demonstration"
        if self.kind == "brief":
            return duration(frequency, self.value)
        if self.kind == "whole":
            return f"{percent(self.value)} of the {self.times:.0f} demonstrations that have it"
        return percent(self.value, 1)

    def deed(self, frequency: float | None) -> str:
        """What the option does, in words."""
        return f"{SIGNS[self.kind][0]} {self.amount(frequency)}"


def diagnose(
    options: Sequence[Sequence[Use]],
    divergences: Sequence[Sequence[Alike]] = (),
    segments: Sequence[Segments] = (),
) -> list[Finding]:
    """The signs of a degenerate solution in the ``options`` and ``divergences`` of a run, lowest level first.

    :data:`SOUND` says which signs these are.
    """
    found: list[Finding] = []
    for level, use in enumerate(options, start=1):
        own = segments[level - 1] if segments else None
        used = [one for one in use[1:] if one.share >= UNUSED_SHARE]
        found += [Finding("unused", level, one.choice, one.share) for one in use[1:] if one not in used]
        for one in used:
            if one.share > DOMINATING_SHARE and len(use) > 2:
                found.append(Finding("dominating", level, one.choice, one.share))
            least = MOSTLY if own and 2 * one.having <= own.demonstrations else WHOLE
            if one.within is not None and one.within >= least:
                found.append(Finding("whole", level, one.choice, one.within, times=one.having))
            times = one.selected / one.demonstrations if one.demonstrations else 0.0
            if one.duration is not None and one.duration < SHORTEST_DURATION and times >= AGAIN_AND_AGAIN:
                found.append(Finding("never_persisting", level, one.choice, one.duration, times=times))
        for pair in divergences[level - 1] if divergences else ():
            both = {one.choice for one in used}.issuperset(pair.options)
            if both and pair.divergence is not None and pair.divergence < SMALLEST_DIVERGENCE:
                found.append(Finding("redundant", level, pair.options[1], pair.divergence, pair.options[0]))
        if own and own.brief:
            found.append(Finding("brief", level, 0, own.median, times=own.twitches / own.number))
        # the caller of a level acts unless the level above emits the control
        above = options[level][0].share if level < len(options) else 0.0
        itself = (use[0].share - above) / (1.0 - above) if 1.0 - above >= UNUSED_SHARE else 0.0
        if itself > HIGH_FITTING_SHARE:
            found.append(Finding("high_fitting", level, 0, itself))
    return found


SOUND = (
    "Training converged, and the model predicts held-out controls better than the mean and the spread of "
    "each control do. Every option is used (at least 1 % of all steps) and none dominates (more than 90 %). "
    "No two options act alike (differ by less than 0.1 nats per step). No option ends at once again and "
    "again (lasts less than 1.5 steps, with three selections or more in a demonstration). No option takes "
    "some demonstrations whole (at least 90 % of their steps, or two thirds of no more than half of the "
    "demonstrations). Options do not switch all the time (six segments or more in a demonstration, most of "
    "them below 0.5 s, or 5 steps or a fiftieth of their demonstration where the rate is unknown). No caller "
    "emits the control itself most of the time."
)
"""What was looked at where nothing is doubtful. A sign of two options that act alike is of used ones only."""


# --- signs in words -----------------------------------------------------------------------------------------

LISTED = 10
"""Options, or pairs of options, that a sign lists, the clearest first."""

SIGNS: Mapping[Kind, tuple[str, str]] = {
    "unused": ("is unused; its share of all steps is", "are unused; their shares of all steps are"),
    "dominating": ("dominates; its share of all steps is",) * 2,
    "whole": (
        "says which demonstration, not which skill; it takes",
        "say which demonstration, not which skill; they take",
    ),
    "never_persisting": ("never persists; on average it lasts", "never persist; on average they last"),
    "redundant": ("act alike; while either is active they differ, in nats per step, by",) * 2,
}
"""What one option, or one pair, does, and several."""


def unlabelled_start(training: TrainingSpec) -> list[tuple[str, str]]:
    """Starts that do not follow the labels to train from, with a remedy."""
    blind = [start for start in training.starts if WAYS[start].ordered]
    if training.labels is None or not blind:
        return []
    text = f"training.starts: {listed(blind)} numbers options in the order of time, whatever "
    remedy = "Start from what labelled steps say of the others (training.starts: [vq_controls])."
    return [(f"{text}training.labels say.", remedy)]


def degeneracies(metrics: Metrics, spec: Spec, names: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """The findings of :func:`diagnose` in words, one sign for a kind and level, with the usual remedy.

    Signs that labels show follow.

    :param names: of the choices of each level, such as ``fit.names``.
    """
    groups: dict[tuple[int, Kind], list[Finding]] = {}
    rate = metrics.control_frequency
    for finding in diagnose(metrics.options, metrics.divergences, metrics.segments):
        if finding.kind not in ("never_persisting", "brief") or spec.levels[finding.level - 1].lasts:
            groups.setdefault((finding.level, finding.kind), []).append(finding)
    signs = []
    for (number_of_level, _), findings in groups.items():
        level = spec.levels[number_of_level - 1].name
        text = _sign(findings, level, names[level], rate)
        signs.append((text, findings[0].advice(spec.training)))
    less = [(text, LABELS) for text, worse in beside_equal_parts(metrics) if worse]
    return [*signs, *less, *unlabelled_start(spec.training)]


def beside_equal_parts(metrics: Metrics) -> list[tuple[str, bool]]:
    """How each level's options agree with its labels, and whether equal parts of demonstrations do better.

    On held-out demonstrations where there are any.
    """
    found, told = metrics.agreement, []
    if found is None:
        return []
    valid = found.valid is not None and found.equal_valid is not None
    ours, equal = (found.valid, found.equal_valid) if valid else (found.train, found.equal_train)
    for labels, own, other in zip(found.labels, ours or (), equal or (), strict=False):
        if own and other:
            numbers = {"ours": number(own.nmi), "equal": number(other.nmi)}
            numbers["accuracy"] = percent(own.matched_globally.accuracy)
            numbers["equal_accuracy"] = percent(other.matched_globally.accuracy)
            worse, part = own.nmi < other.nmi, "held out" if valid else "in training"
            way: Direction = "worse" if worse else "better"
            told.append((said("labels", way, labels=labels, part=part, **numbers), worse))
    return told


def _sign(findings: Sequence[Finding], level: str, names: Sequence[str], frequency: float | None) -> str:
    """The findings of one kind in a level as one sign of a degenerate solution."""
    kind, first, many = findings[0].kind, findings[0], len(findings)
    if kind == "high_fitting":
        share = first.amount(frequency)
        deed = f"emits the control itself in {share} of its steps"
        return f"High-fitting: the caller of level “{level}” {deed}."
    if kind == "brief":
        return (
            f"Options of level “{level}” switch every {first.amount(frequency)} (the median segment). "
            f"{percent(first.times)} of their segments are twitches."
        )
    if many == 1:
        return f"{capital(first.options(names))} of level “{level}” {first.deed(frequency)}."
    ordered = sorted(findings, key=lambda finding: finding.value)[:LISTED]
    values = [f"{finding.amount(frequency)} ({finding.options(names)})" for finding in ordered]
    values += [f"so on for {many - LISTED} more"] if many > LISTED else []
    what = "pairs of options" if kind == "redundant" else "options"
    return f"{many} {what} of level “{level}” {SIGNS[kind][1]} {listed(values)}."
