"""Part of a video as a column of pictures, decoded by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from ddco_pyro.hdf5 import DemonstrationsError
from ddco_pyro.sources.recording import Column, block_steps


def video_column(path: Path, start: float, steps: int, size: tuple[int, int], frequency: float) -> Column:
    """``steps`` frames from ``start`` seconds on, uint8 [T, H, W, 3].

    :param size: height and width.
    :param frequency: frames in a second.
    """
    shape = (*size, 3)

    def blocks() -> Iterator[np.ndarray]:
        at_once, block = block_steps(shape, np.dtype(np.uint8)), []
        for frame in _frames(path, start, steps, frequency, size):
            block.append(frame)
            if len(block) == at_once:
                yield np.stack(block)
                block = []
        if block:
            yield np.stack(block)

    return Column((steps, *shape), np.dtype(np.uint8), blocks, video=True)


def _frames(path: Path, start: float, steps: int, frequency: float, size: tuple[int, int]) -> Iterator[np.ndarray]:
    if not path.is_file():
        raise DemonstrationsError(f"{path}: the video is missing; leave its observation out with --observation")
    seek = ["-ss", f"{max(start - 0.5 / frequency, 0):.6f}"]  # half a frame early: the next frame is the one meant
    frames = imageio_ffmpeg.read_frames(str(path), input_params=seek, output_params=["-frames:v", str(steps)])
    seen = 0
    try:
        width, height = next(frames)["size"]
        if (height, width) != size:
            raise DemonstrationsError(f"{path}: is {height} x {width}, and meta/info.json says {size[0]} x {size[1]}")
        for frame in frames:
            seen += 1
            yield np.frombuffer(frame, np.uint8).reshape(*size, 3)
    except (OSError, RuntimeError, StopIteration) as error:
        raise DemonstrationsError(f"{path}: cannot be decoded: {' '.join(str(error).split())[:200]}") from error
    finally:
        frames.close()
    if seen != steps:
        raise DemonstrationsError(f"{path}: has {seen} frames from second {start:g} on, and {steps} are needed")
