"""Videos of episodes with the active options written on each frame."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.names import option_name, option_rgb
from ddco_pyro.simulation.episodes import Episode

FRAMES_PER_SECOND = 3
BORDER = 6
QUALITY = "25"
"""x264's constant rate factor: 0 is lossless, 51 the coarsest."""


def write_film(path: Path, episode: Episode, names: Sequence[Sequence[str]] = ()) -> None:
    """Write the episode's frames as an mp4 (H.264).

    :param names: the name of each choice of each level, lowest first.
    """
    frames = [captioned(episode, t, names) for t in range(len(episode.frames))]
    with whole_file(path) as temporary:
        temporary.write_bytes(encoded(frames, FRAMES_PER_SECOND))


def encoded(frames: Sequence[np.ndarray] | np.ndarray, rate: int) -> bytes:
    """Frames uint8 [H, W, 3] as mp4 (H.264), ``rate`` of them a second, cut to an even height and width."""
    import av

    content = io.BytesIO()
    with av.open(content, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate, options={"crf": QUALITY})
        stream.height, stream.width = _even(frames[0]).shape[:2]
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(_even(frame)))))
        film.mux(stream.encode())
    return content.getvalue()


def captioned(episode: Episode, t: int, names: Sequence[Sequence[str]] = ()) -> np.ndarray:
    """Frame t with a border in the active option's colour, and its name; uint8 [H, W, 3].

    The last frame shows the end of the episode, without an active option.
    """
    import cv2

    frame = np.array(episode.frames[t], order="C")
    active = episode.choices[t] if t < len(episode.choices) else episode.choices[:0].reshape(-1)
    if len(active):
        corner = (frame.shape[1] - 1, frame.shape[0] - 1)
        cv2.rectangle(frame, (0, 0), corner, option_rgb(active[0]), 2 * BORDER)
    shown = [name.removeprefix("option ") for name in map(option_name, active, names)] if names else active
    chosen = "".join(f"  h{d}={h}" for d, h in enumerate(shown, 1))
    text = "end" if t >= len(episode.choices) else f"t={t}{chosen}"
    white, black = (255, 255, 255), (20, 20, 20)
    for right, down, colour in ((-1, 0, white), (1, 0, white), (0, -1, white), (0, 1, white), (0, 0, black)):
        place = (12 + right, 26 + down)
        cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)
    return frame


def _even(frame: np.ndarray) -> np.ndarray:
    """The picture cut to an even height and width, which H.264 needs."""
    return frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
