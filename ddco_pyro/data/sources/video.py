"""Part of a video as a column of pictures, decoded by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import imageio_ffmpeg
import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources.recording import Column, block_steps


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
    seek = f"{max(start - 0.5 / frequency, 0):.6f}"  # half a frame early: the next frame is the one meant
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-ss", seek, "-i", str(path)]
    command += ["-frames:v", str(steps), "-f", "image2pipe", "-c:v", "ppm", "-"]
    seen = 0
    with tempfile.TemporaryFile() as said:
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said) as process:
            assert process.stdout is not None
            try:
                for frame in _pictures(process.stdout):
                    if frame.shape[:2] != size:
                        found, told = (" x ".join(map(str, one)) for one in (frame.shape[:2], size))
                        raise DemonstrationsError(f"{path}: is {found}, and meta/info.json says {told}")
                    seen += 1
                    yield frame
            finally:
                process.kill()  # where it was not read to its end
        said.seek(0)
        reason = said.read().decode(errors="replace").split()
    if seen == 0 and reason:
        raise DemonstrationsError(f"{path}: cannot be decoded: {' '.join(reason)[:200]}")
    if seen != steps:
        raise DemonstrationsError(f"{path}: has {seen} frames from second {start:g} on, and {steps} are needed")


def _pictures(stream: IO[bytes]) -> Iterator[np.ndarray]:
    """Pictures in PPM, one after the other: P6, width and height, 255, the pixels."""
    while stream.readline():
        width, height = map(int, stream.readline().split())
        stream.readline()
        pixels = stream.read(height * width * 3)
        if len(pixels) < height * width * 3:
            return
        yield np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
