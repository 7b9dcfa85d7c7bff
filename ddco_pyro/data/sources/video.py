"""Films read frame by frame, and part of one as a column of pictures."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import av
import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.pictures import block_steps
from ddco_pyro.data.sources.recording import Column


def frames(path: Path, start: float = 0.0) -> Iterator[np.ndarray]:
    """The frames of a film from ``start`` seconds on, uint8 [H, W, 3].

    :raises av.FFmpegError: it cannot be decoded.
    :raises IndexError: there are no pictures in it.
    """
    return (frame for _, frame in timed_frames(path, start))


def timed_frames(path: Path, start: float) -> Iterator[tuple[float, np.ndarray]]:
    """The same with the second, of the film, at which each is shown."""
    with av.open(path) as film:
        stream = film.streams.video[0]
        stream.thread_type = "AUTO"
        unit = stream.time_base
        assert unit is not None  # only what has no streams yet has none
        zero = float((stream.start_time or 0) * unit)
        film.seek(int((zero + start) / unit), stream=stream)  # to the last key frame before
        for frame in film.decode(stream):
            if frame.time >= zero + start:
                yield frame.time - zero, frame.to_ndarray(format="rgb24", interpolation="BICUBIC")


def video_column(path: Path, name: str, start: float, steps: int, size: tuple[int, int], frequency: float) -> Column:
    """``steps`` frames from ``start`` seconds on, uint8 [T, H, W, 3].

    :param name: of the demonstration, for messages.
    :param size: height and width.
    :param frequency: frames in a second.
    """
    shape = (*size, 3)

    def blocks() -> Iterator[np.ndarray]:
        at_once, shown = block_steps(shape, np.dtype(np.uint8)), _frames(path, name, start, steps, frequency, size)
        while block := list(islice(shown, at_once)):
            yield np.stack(block)

    return Column((steps, *shape), np.dtype(np.uint8), blocks, video=True)


def _frames(
    path: Path, name: str, start: float, steps: int, frequency: float, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """The frames of the steps of one demonstration, each within half a step of its time."""
    if not path.is_file():
        raise DemonstrationsError(f"{name}: {path}: the video is missing; leave its observation out with --observation")
    seen = 0
    try:
        for time, frame in islice(timed_frames(path, max(start - 0.5 / frequency, 0)), steps):  # the next is meant
            if frame.shape[:2] != size:
                actual, told = (" x ".join(map(str, shape)) for shape in (frame.shape[:2], size))
                raise DemonstrationsError(f"{name}: {path}: is {actual}, and meta/info.json says {told}")
            if abs(time - start - seen / frequency) > 0.5 / frequency:
                raise DemonstrationsError(
                    f"{name}: {path}: has no frame of step {seen}: the next one is at second {time:g}"
                )
            seen += 1
            yield frame
    except (av.FFmpegError, IndexError) as error:
        raise DemonstrationsError(f"{name}: {path}: cannot be decoded: {' '.join(str(error).split())[:200]}") from error
    if seen != steps:
        raise DemonstrationsError(f"{name}: {path}: has {seen} frames from second {start:g} on, and {steps} are needed")
