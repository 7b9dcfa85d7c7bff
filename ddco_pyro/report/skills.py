"""Skills in the report: each option with its use, pictures and films of typical segments, and their order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.figures import curves, film, picture, transition_graph, typical_paths
from ddco_pyro.drawing.page import Block, Card, Cell, Columns, Drawing, Facts, Section, Text, note
from ddco_pyro.drawing.shown import frames, in_words, positions, projection
from ddco_pyro.drawing.words import duration, number, percent
from ddco_pyro.evaluation.options import diagnose
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.names import proposed_by_library
from ddco_pyro.metrics import Alike, NamedByLabel, Use
from ddco_pyro.names import numbered_name, option_colour, option_name, option_rgb
from ddco_pyro.report.inputs import deciding
from ddco_pyro.segmenting.segments import Segmented
from ddco_pyro.simulation.film import encoded
from ddco_pyro.spec import PathSpec

INSTANCES = 9
"""Instances in a film."""

SHOWN = 3
"""Segments on a contact sheet."""

FRAMES, FRAMES_PER_SECOND = 32, 10
"""Frames of a film, at most, and their rate; longer instances skip steps."""

SHEET_HEIGHT, FILM_HEIGHT = 96, 104
"""Rows of a picture on a contact sheet and in a film."""

MOST_FILMS = 12
"""Films of pictures on a page; further options have a contact sheet alone."""

MOST_PATHS = 25
"""Demonstrations behind the segments in a drawing."""

MOST_CONTROLS = 6
"""Numbers of the control in a drawing."""


@dataclass(frozen=True)
class Instance:
    """A segment of an option.

    :param row: its demonstration in :attr:`~ddco_pyro.segmenting.Segmented.segments`.
    :param end: the step after its last one.
    :param probability: the mean posterior probability of its option.
    """

    row: int
    start: int
    end: int
    probability: float

    def __len__(self) -> int:
        return self.end - self.start


def instances(segmented: Segmented, level: str, option: int) -> list[Instance]:
    """The segments of an option, the most typical first, different demonstrations before the same one again.

    The same option chosen anew stays one segment.

    A segment is the more typical, the larger its mean posterior probability (to two digits), then the nearer
    its length to the median length.
    """
    found = [
        Instance(row, start, end, float(demo.levels[level].probability[start:end].mean()))
        for row, demo in enumerate(segmented.segments)
        for choice, start, end in demo.levels[level].runs(anew=False)
        if choice == option
    ]
    if not found:
        return []
    median = float(np.median([len(one) for one in found]))
    ranked = sorted(found, key=lambda one: (-round(one.probability, 2), abs(np.log(len(one) / median))))
    times = Counter[int]()
    again = []
    for one in ranked:
        again.append(times[one.row])
        times[one.row] += 1
    return [ranked[place] for place in np.argsort(again, kind="stable")]


def transitions(segmented: Segmented, level: str) -> np.ndarray:
    """Counts of transitions between segments [1 + k + 1, 1 + k + 1]: from a row's choice to a column's.

    The last row is the start of demonstrations, the last column their end.
    """
    outside = segmented.counts[level] + 1
    counts = np.zeros((outside + 1, outside + 1), int)
    for demo in segmented.segments:
        choices = [outside, *(choice for choice, _, _ in demo.levels[level].runs(anew=False)), outside]
        np.add.at(counts, (choices[:-1], choices[1:]), 1)
    return counts


@dataclass(frozen=True)
class Skill:
    """One option in the demonstrations of a fit.

    :param found: its segments, as of :func:`instances`.
    :param labels: the labels that it stands for, with their agreement, by name of labels.
    """

    level: str
    choice: int
    name: Cell
    share: float
    use: Use
    found: Sequence[Instance]
    labels: Mapping[str, str]


def agreeing(one: NamedByLabel) -> str:
    """The label that an option stands for, with their agreement: ``reach 0.71``."""
    return f"{one.name} {number(one.agreement)}"


def skills(fit: Fit, segmented: Segmented) -> list[Skill]:
    """The options that a most likely path has, of the highest level first."""
    return [
        Skill(
            level,
            choice,
            Cell(numbered_name(choice, names), colour=option_colour(choice)),
            use[choice].steps / sum(one.steps for one in use),
            use[choice],
            found,
            {
                one.labels: agreeing(one)
                for one in fit.metrics.named_by_labels
                if (one.level, one.option) == (level, choice)
            },
        )
        for (level, names), use in reversed(list(zip(fit.names.items(), fit.metrics.options, strict=True)))
        for choice in range(len(names))
        if (found := instances(segmented, level, choice))
    ]


def overview(fit: Fit, every: Sequence[Skill], shown: Shown) -> list[Block]:
    """Each skill in a tile: its picture, name, share of the steps, and median length."""
    blocks, frequency = list[Block](), fit.metrics.control_frequency
    for level in (levels := dict.fromkeys(one.level for one in every)):
        tiles = []
        for one in (skill for skill in every if skill.level == level):
            length = one.use.length or 0.0
            lasts = f"{length / frequency:.2g} s" if frequency else duration(None, length)
            label = "".join(f"; label {told}" for told in one.labels.values())
            text = note(f"{percent(one.share)} of steps, {lasts} each{label}")
            name = Cell(option_name(one.choice, fit.names[level]), colour=one.name.colour)
            tiles.append(Card(name, [*shown.first(one.found, one.choice), text]))
        blocks += [Text(f"Level “{level}”", "heading")] if len(levels) > 1 else []
        blocks.append(Columns(tiles))
        names, used = fit.names[level], {one.choice for one in every if one.level == level}
        if unused := [numbered_name(choice, names) for choice in range(1, len(names)) if choice not in used]:
            blocks.append(note(f"Never active on a most likely path: {', '.join(unused)}."))
    return blocks


def section(fit: Fit, every: Sequence[Skill], shown: Shown, segmented: Segmented) -> Section:
    """Every option of every level, the highest level first, then the order of the options."""
    reads = deciding(fit, shown.demos)
    blocks: list[Block] = [note(shown.explained())]
    tasks, proposed = sorted({demo.task for demo in segmented.segments}), proposed_by_library(fit.spec)
    diagnoses = diagnose(fit.metrics.options, segments=fit.metrics.segments)
    whole = {(one.level, one.choice): one for one in diagnoses if one.kind == "whole"}
    for place, (level, names) in reversed(list(enumerate(fit.names.items()))):
        if len(fit.names) > 1:
            blocks.append(Text(f"Level “{level}”", "heading"))
        counts = transitions(segmented, level)
        present = {one.choice: one for one in every if one.level == level}
        for choice, one in present.items():
            low, high = np.percentile([len(each) for each in one.found], [25, 75])
            facts = {
                "Share of steps": percent(one.share, 1),
                "Segments": str(one.use.segments),
                "Median length": duration(segmented.frequency, one.use.length or 0.0),
                "Quartiles of length": duration(segmented.frequency, low, high),
                "Comes after": _frequent(counts[:, choice], [*names, "start"]),
                "Comes before": _frequent(counts[choice], [*names, "end"]),
            }
            if len(tasks) > 1:
                steps = Counter[str]()
                for each in one.found:
                    steps[segmented.segments[each.row].task] += len(each)
                facts["Tasks"] = _frequent(np.array([steps[task] for task in tasks]), tasks)
            facts |= {f"Label {labels}, agreement": told for labels, told in one.labels.items()}
            if choice and level not in fit.named and (known := proposed.get(level)):
                facts["Name in the library, a proposal"] = known[choice - 1]
            if near := _nearest(choice, fit.metrics.divergences[place], names):
                facts["Most like"] = near
            if finding := whole.get((1 + place, choice)):
                facts["No skill"] = finding.deed(segmented.frequency)
            read = reads.get(level, {}).items()
            facts |= {what: values[choice] for what, values in read if choice in values}
            facts = {what: said.replace(" %", "\N{NO-BREAK SPACE}%") for what, said in facts.items()}
            blocks.append(Card(one.name, [Facts(facts), *shown.blocks(one.found, choice)]))
        onset = {
            choice: np.mean([each.start / len(segmented.segments[each.row]) for each in one.found])
            for choice, one in present.items()
        }
        order = sorted(present, key=onset.__getitem__)
        caption = (
            "Order of the options: numbers count transitions between segments; the width of an arc is the "
            "share of its start's transitions. Arcs above lead to the right, arcs below back. Arcs of less "
            "than 1 % of transitions, or of starts or ends, are left out. The area of a circle is the share "
            f"of steps. From left to right, by mean onset: {', '.join(names[choice] for choice in order)}."
        )
        shares = [present[choice].share if choice in present else 0.0 for choice in range(len(names))]
        blocks.append(Drawing(transition_graph(counts, shares, names, order), caption))
    return Section("skills", "Skills one by one", blocks)


def _nearest(choice: int, pairs: Sequence[Alike], names: Sequence[str]) -> str:
    """The option from which an option's policy differs least, in words; empty for the only one, control."""
    own = [one for one in pairs if choice in one.options]
    known = [(one.divergence, *one.options) for one in own if one.divergence is not None]
    if not known:
        return ""
    apart, first, second = min(known)
    return f"{option_name(first if second == choice else second, names)}, {number(apart)} nats per step apart"


def _frequent(counts: np.ndarray, names: Sequence[str]) -> str:
    """The two most frequent ones with their shares."""
    first, total = np.argsort(-counts, kind="stable")[:2], counts.sum()
    return ", ".join(f"{names[place]} {percent(counts[place] / total)}" for place in first if counts[place])


class Shown:
    """Pictures and films of segments, from what demonstrations have: pictures, else paths, else controls.

    :param demos: in the order of their segments.
    :param pictures: of each demonstration; empty for none.
    :param drawn: the paths in space that the spec names.
    :ivar paths: of each demonstration, turned into the plane of the page, [P, T, 2]; empty without ``drawn``.
    """

    def __init__(
        self, demos: Demonstrations, pictures: Sequence[Observed], drawn: Sequence[PathSpec]
    ) -> None:
        self.demos, self.pictures, self.drawn = demos, pictures, drawn
        self.films = 0
        self.paths: list[np.ndarray] = []
        if drawn:
            places = [positions(demo, drawn) for demo in demos]
            turned = projection(np.concatenate([place.reshape(-1, place.shape[-1]) for place in places]))
            self.paths = [place @ turned.T for place in places]

    def explained(self) -> str:
        """What the drawings of each option are."""
        typical = "Typical segments have the largest mean posterior probability; "
        typical += "different demonstrations come first."
        if self.pictures:
            return (
                f"Contact sheet: first, middle and last picture of a segment, a row each. {typical} "
                "Instances in a film are aligned at their onset; one that has ended rests."
            )
        if not self.drawn:
            return (
                f"Lines: controls from the onset of each segment on. {typical} To draw an observation as a "
                "path in space: ddco-pyro report RUN --set report.trajectory=KEY."
            )
        return (
            f"Drawings: {in_words(self.drawn, self.demos)}. Circle, square and triangle: first, "
            f"middle and last step of a segment. {typical}"
        )

    def first(self, found: Sequence[Instance], choice: int) -> list[Block]:
        """The most typical segment of an option: its middle picture, its path, or its first control."""
        one = found[0]
        if self.pictures:
            where = f"Middle picture of {self._places([one])}"
            middle = frames(self.pictures[one.row], [(one.start + one.end - 1) // 2], SHEET_HEIGHT)[0]
            return [picture(middle, where)]
        return [self._drawing(found[:1] if self.drawn else found, choice, "", 1)]

    def blocks(self, found: Sequence[Instance], choice: int) -> list[Block]:
        """A contact sheet and a film of the most typical segments of an option, or a drawing of them."""
        chosen = found[:INSTANCES]
        where = self._places(chosen[:SHOWN])
        if self.pictures:
            self.films += 1
            films = [film_of(self.pictures, chosen, choice)] if self.films <= MOST_FILMS else []
            return [sheet_of(self.pictures, chosen[:SHOWN], where), *films]
        caption = where if self.drawn else f"{len(chosen)} instances from their onset on"
        return [self._drawing(chosen[:SHOWN] if self.drawn else chosen, choice, caption, MOST_CONTROLS)]

    def _places(self, chosen: Sequence[Instance]) -> str:
        return ", ".join(f"{self.demos[one.row].name} {one.start}–{one.end - 1}" for one in chosen)

    def _drawing(self, chosen: Sequence[Instance], choice: int, caption: str, controls: int) -> Drawing:
        """The paths of segments over those of demonstrations, or the first few numbers of their control."""
        if self.drawn:
            rows = list(dict.fromkeys([*(one.row for one in chosen), *range(len(self.demos))]))[:MOST_PATHS]
            segments = [(rows.index(one.row), one.start, one.end) for one in chosen]
            paths = [self.paths[row] for row in rows]
            return Drawing(typical_paths(paths, segments, option_colour(choice)), caption)
        every = [
            self.demos[one.row].actions.reshape(len(self.demos[one.row]), -1)[one.start : one.end, :controls]
            for one in chosen[:INSTANCES]
        ]
        numbers = range(every[0].shape[1])
        values = {f"control[{n}]": [array[:, n].astype(float) for array in every] for n in numbers}
        return Drawing(curves(values, [{"stroke": option_colour(choice)}]), caption)


def sheet_of(pictures: Sequence[Observed], chosen: Sequence[Instance], where: str) -> Drawing:
    """First, middle and last picture of each instance, a row each."""
    steps = [(one.start, (one.start + one.end - 1) // 2, one.end - 1) for one in chosen]
    pairs = zip(chosen, steps, strict=True)
    strips = [frames(pictures[one.row], three, SHEET_HEIGHT) for one, three in pairs]
    rows = [np.hstack(list(strip)) for strip in strips]
    return picture(np.vstack(rows), f"First, middle and last pictures of {where}", where)


def film_of(pictures: Sequence[Observed], chosen: Sequence[Instance], choice: int) -> Drawing:
    """A grid of instances aligned at onset, in H.264; one that has ended rests at its last step, paler."""
    longest = max(map(len, chosen))
    after = np.arange(0, longest, -(-longest // FRAMES))[:, None]
    starts, ends = np.array([(one.start, one.end) for one in chosen]).T
    steps = np.minimum(starts + after, ends - 1)  # [F, instances]
    cells = [frames(pictures[one.row], steps[:, cell], FILM_HEIGHT) for cell, one in enumerate(chosen)]
    columns = int(np.ceil(np.sqrt(len(cells))))
    height, width = cells[0].shape[1:3]
    pixels = np.full((len(steps), -(-len(cells) // columns) * height, columns * width, 3), 255, np.uint8)
    for cell, seen in enumerate(cells):
        ended = np.diff(steps[:, cell], prepend=-1) == 0
        shown = np.where(ended[:, None, None, None], 128 + seen // 2, seen)
        shown[:, :3] = option_rgb(choice)
        top, left = height * (cell // columns), width * (cell % columns)
        pixels[:, top : top + height, left : left + width] = shown
    return film(encoded(pixels, FRAMES_PER_SECOND), f"{len(chosen)} instances from their onset on")
