"""What is shown of a demonstration: its paths in space, its pictures, and its numbers over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ddco_pyro.data.arrays import Observed, is_picture
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.sources import Source
from ddco_pyro.spec import PathSpec

LEAST_OBLIQUE = 15.0
"""Degrees between the view and an axis, at least; a view along an axis hides the axis' scale."""

MOST_STRETCHED = 4.0
"""Axes whose ranges differ by more than this factor are not drawn to one scale."""

QUALITY = 70
"""Of JPEG pictures, 0 to 100."""

MOST_SKIPPED = 4
"""Steps of a stretch that is read whole, for each of its pictures that is shown."""


# --- paths in space -----------------------------------------------------------------------------------------


def positions(demo: Demonstration, paths: Sequence[PathSpec]) -> np.ndarray:
    """The positions of P paths in space or in the plane, [P, T, 3] or [P, T, 2]."""
    arrays = [np.asarray(demo.observations[path.key], float) for path in paths]
    return np.stack([array[:, path.among(array.shape[1])] for path, array in zip(paths, arrays, strict=True)])


def in_words(paths: Sequence[PathSpec], demos: Demonstrations) -> str:
    """The paths in words: which numbers of which observations, and how the lines of several differ."""
    each = []
    for place, path in enumerate(paths):
        size = demos.observation_shapes[path.key][0]
        more = [LINES[place % len(LINES)]] if len(paths) > 1 else []
        more += [f"the first three of its {size} numbers"] if path.numbers is None and size > 3 else []
        each.append(f"“{path}”" + (f" ({'; '.join(more)})" if more else ""))
    return f"observation{'s' * (len(each) > 1)} {', '.join(each)}"


LINES = ("solid", "dashed", "dotted")
"""Of several paths, in turn."""


def projection(points: np.ndarray) -> np.ndarray:
    """The map [2, D] from positions [M, D] to a plane, right and down.

    The second axis of a plane points up, and both have one scale. Space is seen along the direction in which
    positions spread the least, with the third axis upright: from 15 to 45 degrees above, and along no axis.
    """
    span = np.ptp(points, axis=0)
    span = np.where(span > 0, span, 1.0)
    if len(span) == 2:
        return np.array([[1.0, 0.0], [0.0, -1.0]]) / span.max()
    scale = span if span.max() > MOST_STRETCHED * span.min() else np.full(3, span.max())
    scaled = points / (scale / scale.max())
    normal = np.linalg.eigh(np.cov(scaled.T))[1][:, 0] if len(points) > 1 else np.ones(3)
    normal = -normal if normal[2] < 0 else normal
    up = np.radians(np.clip(np.degrees(np.arcsin(normal[2])), 15, 45))
    quarter, rest = divmod(float(np.degrees(np.arctan2(normal[1], normal[0]))), 90)
    turned = np.radians(90 * quarter + np.clip(rest, LEAST_OBLIQUE, 90 - LEAST_OBLIQUE))
    right = [-np.sin(turned), np.cos(turned), 0.0]
    down = [np.sin(up) * np.cos(turned), np.sin(up) * np.sin(turned), -np.cos(up)]
    return np.array([right, down]) / scale


# --- pictures -----------------------------------------------------------------------------------------------


def pictures(demos: Iterable[Demonstration]) -> list[Observed]:
    """The first observation of each demonstration that is pictures; empty where one has none."""
    found = []
    for demo in demos:
        first = next(filter(is_picture, demo.observations.values()), None)
        if first is None:
            return []
        found.append(first)
    return found


def stored_pictures(source: Source, lengths: Mapping[str, int]) -> list[Observed]:
    """The first pictures of each demonstration, which are read when shown, observed by a fit or not.

    :param lengths: steps of each demonstration by name.
    :returns: pictures in this order; empty where a demonstration has none or has other steps.
    """
    found = pictures(map(source.read, lengths)) if lengths.keys() <= {*source.names} else []
    return found if [*map(len, found)] == [*lengths.values()] else []


def frames(observed: Observed, steps: Sequence[int] | np.ndarray, height: int) -> np.ndarray:
    """The pictures of these steps, uint8 [F, height, W, 3] in red, green and blue.

    Of fewer than three channels the first is shown, in grey; of more, the first three.
    """
    import cv2  # one's own vectors need none of it

    chosen = np.unique(steps)
    first, last = int(chosen[0]), int(chosen[-1])
    if last - first < MOST_SKIPPED * len(chosen):
        read = np.asarray(observed[first : last + 1])[chosen - first]
    else:
        read = np.stack([np.asarray(observed[int(step)]) for step in chosen])
    coloured = read[..., :3] if read.shape[-1] >= 3 else np.repeat(read[..., :1], 3, axis=-1)
    width = max(1, round(height * read.shape[2] / read.shape[1]))
    how = cv2.INTER_AREA if height < read.shape[1] else cv2.INTER_NEAREST
    each = map(np.ascontiguousarray, coloured)
    sized = [cv2.resize(picture, (width, height), interpolation=how) for picture in each]
    return np.stack(sized)[np.searchsorted(chosen, steps)]


def jpeg(picture: np.ndarray) -> bytes:
    """A picture uint8 [H, W, 3] as JPEG."""
    import cv2

    _, content = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(content)
