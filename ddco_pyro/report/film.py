"""Films of rollouts in the page: a strip of frames, and the films themselves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ddco_pyro.data.sources.video import frames
from ddco_pyro.drawing import words
from ddco_pyro.drawing.pictures import blank, data_uri, hide_frame
from ddco_pyro.evaluation.schema import read_successes

MOST_BYTES = 4_000_000
"""Films are held in the page up to this size in all; further ones are linked to."""

MOST_FRAMES = 16
COLUMNS = 4


@dataclass(frozen=True)
class Film:
    """A filmed episode: ``uri`` holds the film, or is None where the page only links to ``link``."""

    method: str
    seed: int
    link: str
    uri: str | None
    outcome: str

    @property
    def name(self) -> str:
        """What the method is called in the page."""
        return words.method(self.method)


def films(folder: Path, first: str) -> list[Film]:
    """The films in a run folder, those of the method ``first`` before the others."""
    paths = sorted((folder / "videos").glob("*.mp4"), key=lambda path: _key(path, first))
    outcomes = {key: "success" if value == 1 else "failure" for key, value in read_successes(folder).items()}
    left, clips = MOST_BYTES, []
    for path in paths:
        method, seed = _name(path)
        size = path.stat().st_size
        uri = data_uri(path.read_bytes(), "video/mp4") if size <= left else None
        left -= size if uri else 0
        clips.append(Film(method, seed, f"videos/{path.name}", uri, outcomes.get((method, seed), "")))
    return clips


def draw_strip(path: Path) -> Figure:
    """Frames of a film, evenly over time, in rows."""
    film = np.stack(list(frames(path)))
    chosen = film[np.unique(np.linspace(0, len(film) - 1, min(len(film), MOST_FRAMES)).round().astype(int))]
    rows = -(-len(chosen) // COLUMNS)
    height, width = film.shape[1:3]
    figure = blank(rows * 9.6 / COLUMNS * height / width)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(rows, COLUMNS, squeeze=False)
    for axes in panels.flat:
        hide_frame(axes)
    for axes, frame in zip(panels.flat, chosen, strict=False):
        axes.imshow(frame)
    return figure


def _name(path: Path) -> tuple[str, int]:
    method, _, seed = path.stem.rpartition("-")
    return method, int(seed)


def _key(path: Path, first: str) -> tuple[bool, str, int]:
    method, seed = _name(path)
    return method != first, method, seed
