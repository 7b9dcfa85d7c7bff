"""Videos: frames, and a part of a video as lazy pictures."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import av
import numpy as np

from ddco_pyro.data.errors import DemonstrationsError


def frames(path: Path, start: float = 0.0) -> Iterator[tuple[float, np.ndarray]]:
    """The time of each frame of a video from ``start`` seconds on, and the frame, uint8 [H, W, 3].

    :raises av.FFmpegError: the video cannot be decoded.
    :raises IndexError: the file has no video stream.
    """
    with av.open(path) as video:
        stream = video.streams.video[0]
        stream.thread_type = "AUTO"
        unit = stream.time_base
        assert unit is not None  # files that are read have one
        zero = float((stream.start_time or 0) * unit)
        video.seek(int((zero + start) / unit), stream=stream)  # to the key frame before
        for frame in video.decode(stream):
            if frame.time >= zero + start:
                yield frame.time - zero, frame.to_ndarray(format="rgb24", interpolation="BICUBIC")


def frames_of_steps(
    path: Path, name: str, start: float, steps: int, frequency: float, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """Frames of a demonstration's consecutive steps, each within half a step of its time, uint8 [H, W, 3].

    :param name: of the demonstration, for messages.
    :param start: the time of the first one, in seconds.
    :param size: height and width.
    :raises DemonstrationsError: a frame is missing, or of another size, or the video cannot be decoded.
    """
    where = f"{name}: {path}"
    if not path.is_file():
        missing = "the video is missing; leave its observation out with --observation"
        raise DemonstrationsError(f"{where}: {missing}")
    seen = 0
    try:
        for time, frame in islice(frames(path, max(start - 0.5 / frequency, 0)), steps):
            if frame.shape[:2] != size:
                actual, expected = (" x ".join(map(str, shape)) for shape in (frame.shape[:2], size))
                raise DemonstrationsError(f"{where}: is {actual}, and meta/info.json says {expected}")
            if abs(time - start - seen / frequency) > 0.5 / frequency:
                lacks = f"has no frame of step {seen}: the next one is at second {time:g}"
                raise DemonstrationsError(f"{where}: {lacks}")
            seen += 1
            yield frame
    except (av.FFmpegError, IndexError) as error:
        text = " ".join(str(error).split())[:200]
        raise DemonstrationsError(f"{where}: cannot be decoded: {text}") from error
    if seen != steps:
        has = f"has {seen} frames from second {start:g} on, and {steps} are needed"
        raise DemonstrationsError(f"{where}: {has}")
