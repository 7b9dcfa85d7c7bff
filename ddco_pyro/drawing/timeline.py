"""Time lines: the segments of many demonstrations under one axis of time, drawn by ``timeline.html.j2``.

Segments are run-length coded. Posterior probabilities and observed numbers are bytes in base64.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.drawing.shown import frames, jpeg, positions, projection
from ddco_pyro.spec import PathSpec

MOST_NUMBERS = 12
"""Numbers that follow the cursor; more where the paths and the controls alone are more."""

MOST_BYTES = 1_000_000
"""Bytes of observed numbers on a page, about; longer demonstrations are thinned out in time."""

MOST_PICTURES, FEWEST_PICTURES = 320, 8
"""Pictures on a page, and the fewest of a demonstration that has any."""

PICTURE_HEIGHT = 96
"""Rows of a picture that follows the cursor."""


@dataclass(frozen=True)
class Timelines:
    """Demonstrations under one axis of time.

    :param lanes: the rows of every demonstration, a level of options or labels each: its ``name``, and the
        ``names`` and ``colours`` of its values, by value.
    :param tracks: of each demonstration ``name``, ``steps``, ``held_out``, a line of ``facts``, the
        ``anchor`` by which links lead to it, its ``lanes`` (:func:`coded`; None of one that it lacks), and
        what follows the cursor (:func:`following`).
    :param frequency: steps per second (Hz); None where unknown.
    :param rows: demonstrations that are seen at once, about; None for as many as a window has room for.
    """

    lanes: Sequence[Mapping[str, Any]]
    tracks: Sequence[Mapping[str, Any]]
    frequency: float | None = None
    rows: int | None = None

    @property
    def json(self) -> str:
        """The data of the script; without ``<``, so that no text ends the element that holds them."""
        longest = max(track["steps"] for track in self.tracks)
        data = {"frequency": self.frequency, "longest": longest, "lanes": self.lanes, "tracks": self.tracks}
        return json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")


def coded(
    starts: Sequence[int],
    values: Sequence[int],
    intervals: np.ndarray | None = None,
    probability: np.ndarray | None = None,
) -> dict[str, Any]:
    """The segments of one demonstration in one lane, for the script.

    :param starts: first steps.
    :param values: the option or the label of each segment.
    :param intervals: of each first step, [segments, 2], single steps left out; None for labels.
    :param probability: of the option at each step [T]; None for labels.
    """
    found: dict[str, Any] = {"s": list(starts), "v": list(values)}
    if intervals is not None:
        pairs = zip(starts, intervals.tolist(), strict=True)
        found["i"] = {place: ends for place, (start, ends) in enumerate(pairs) if ends != [start, start]}
    if probability is not None:
        found["p"] = text(np.rint(255 * probability))
    return found


def text(values: np.ndarray) -> str:
    """Numbers from 0 to 255 as bytes in base64."""
    return base64.b64encode(values.astype(np.uint8).tobytes()).decode("ascii")


def following(
    demos: Iterable[Demonstration], pictures: Sequence[Observed], steps: int, paths: Sequence[PathSpec]
) -> Iterator[dict[str, Any]]:
    """What follows the cursor along each demonstration: numbers, paths in space, pictures.

    :param pictures: of each demonstration; empty for none.
    :param steps: of all demonstrations together.
    :param paths: that are drawn.
    """
    left, view = MOST_PICTURES, None
    for demo, observed in zip_longest(demos, pictures):
        values, drawn = _numbers(demo, paths)
        every = -(-len(values) * steps // MOST_BYTES) or 1
        low = np.array([array.min() for array in values.values()])
        span = np.array([np.ptp(array) for array in values.values()])
        each = zip(values.values(), low, span, strict=True)
        scaled = [255 * (array - a) / (b or 1) for array, a, b in each]
        found: dict[str, Any] = {}
        if values:
            coded = text(np.rint([array[::every] for array in scaled]))
            ranges = {"low": np.round(low, 6).tolist(), "span": np.round(span, 6).tolist()}
            found["n"] = {"names": list(values), "every": every, "bytes": coded, **ranges}
        if paths:
            view = projection(np.concatenate(positions(demo, paths))) if view is None else view
            found |= {"view": np.round(view, 5).tolist(), "paths": drawn}
        if observed is not None and left >= FEWEST_PICTURES:
            count = min(len(demo), max(FEWEST_PICTURES, MOST_PICTURES * len(demo) // steps), left)
            chosen = np.unique(np.linspace(0, len(demo) - 1, count).round().astype(int))
            left -= len(chosen)
            strip = np.hstack(list(frames(observed, chosen, PICTURE_HEIGHT)))
            content = base64.b64encode(jpeg(strip)).decode("ascii")
            found["k"] = {"steps": chosen.tolist(), "strip": f"data:image/jpeg;base64,{content}"}
        yield found


def _numbers(demo: Demonstration, paths: Sequence[PathSpec]) -> tuple[dict[str, np.ndarray], list[list[int]]]:
    """Numbers over time by name: those of paths, all controls, then observations; the places of each path's.

    There are :data:`MOST_NUMBERS` in all, or more where paths and controls alone are more.
    """
    vectors = {key: np.asarray(array) for key, array in demo.observations.items() if len(array.shape) == 2}
    arrays = {"control": demo.actions.reshape(len(demo), -1), **vectors}
    drawn = [[(path.key, place) for place in path.among(vectors[path.key].shape[1])] for path in paths]
    first = list(dict.fromkeys(chain.from_iterable(drawn)))
    others = ((key, place) for key, array in arrays.items() for place in range(array.shape[1]))
    every = dict.fromkeys([*first, *others])
    values = {
        f"{key}[{place}]" if arrays[key].shape[1] > 1 else key: arrays[key][:, place].astype(float)
        for key, place in islice(every, max(MOST_NUMBERS, len(first) + arrays["control"].shape[1]))
    }
    return values, [[first.index(number) for number in path] for path in drawn]
