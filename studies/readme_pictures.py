"""The film and the small pictures of the README.

    python studies/readme_pictures.py film RUN            a fit of ``specs/needle.yaml``, such as that of ``make demo``
    python studies/readme_pictures.py pages RUN SEGMENTS  a fit, and the page of ``ddco-pyro segment --html``

The film is ``docs/images/needle.gif``: a demonstration above its segments, beside the policy that acts. The pictures
``report.png``, ``space.png`` and ``segments.png`` are cut from the pages of the first commands of the README. They
need ``chromium``.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageChops, ImageOps

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import legend, option_colour
from ddco_pyro.drawing.figures import STYLE
from ddco_pyro.fitting.fitted import load
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import find_task

OUT = Path("docs/images")
DEMONSTRATED, ACTED = 5001, 1001
"""Seeds of the two initial states. Demonstrations of the spec have others."""
SHOWN = np.s_[45:345, 40:440]
"""The part of the pictures in which something happens."""
MILLISECONDS, LAST = 350, 1800
COLOURS = 96
DPI = 100
SIZE = (560, 420)
STYLES = {
    "report": "body > :not(#skills), #skills > :not(.card), .card ~ .card ~ .card { display: none }",
    "segments": "body > :not(#segments), #segments > :not(.timeline), .bar, .readout, .tracks > :nth-child(n+7) "
    "{ display: none }",
}
"""What is left of a page, and so fills a picture of :data:`SIZE`."""


def draw(t: int, films: list[tuple[str, Episode, np.ndarray]]) -> Image.Image:
    """Frame t of each film, titled, above the options [T] of its steps so far."""
    figure = Figure(figsize=(8, 4.15), dpi=DPI)
    count = max(options.max() for *_, options in films)
    for column, (title, episode, options) in enumerate(films):
        left = 0.01 + 0.5 * column
        picture = figure.add_axes((left, 0.245, 0.48, 0.665))
        picture.imshow(episode.frames[t][SHOWN], aspect="auto")
        picture.set(xticks=[], yticks=[])
        picture.set_title(title, fontsize=15, pad=7)
        active = option_colour(options[min(t, len(options) - 1)])
        for side in picture.spines.values():
            side.set(color=active, linewidth=5, visible=True)
        time = figure.add_axes((left, 0.13, 0.48, 0.085))
        time.barh(0, len(options), color="#eeeeee", align="edge", height=1)
        for step, option in enumerate(options[: t + 1]):
            time.barh(0, 1.02, left=step, color=option_colour(option), align="edge", height=1)
        time.axvline(min(t + 1, len(options)), color="black", linewidth=2)
        time.set(xlim=(0, len(options)), ylim=(0, 1), xticks=[], yticks=[])
        time.set_axis_off()
    figure.legend(handles=legend(range(1, count + 1)), loc="lower center", ncols=count, fontsize=14, handlelength=1)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def film(run: Path) -> None:
    """Film the supervisor and the run's policy."""
    fit = load(run)
    keys = [observation.key for observation in fit.spec.observations]
    task = find_task(fit.spec.task)
    shown = run_episode(task, "supervisor", DEMONSTRATED, film=True, observed=keys, keep=keys)
    acted = run_episode(task, fit.controller(), ACTED, film=True, observed=keys)
    (segments,) = fit.segment(Demonstrations((shown.record,)))
    films = [
        ("A demonstration, segmented", shown, segments[0]),
        ("The learned policy, acting", acted, acted.choices[:, 0]),
    ]
    with matplotlib.rc_context(STYLE | {"figure.constrained_layout.use": False}):
        frames = [draw(t, films) for t in range(len(shown.frames))]
    palette = Image.fromarray(np.vstack([np.asarray(one) for one in frames])).quantize(COLOURS)
    first, *others = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames]
    durations = [MILLISECONDS] * len(others) + [LAST]
    first.save(OUT / "needle.gif", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)


def pages(run: Path, segments: Path) -> None:
    """Cut the pictures from a report and from a page of segments."""
    sources = {"report": run / "report.html", "segments": segments}
    small = {name: screen(page, STYLES[name]) for name, page in sources.items()}
    whole = Image.open(run / "figures" / "trajectories.png").convert("RGB")
    small["space"] = trimmed(whole.crop((0, 60, whole.width // 2, whole.height - 60)))
    for name, picture in small.items():
        ImageOps.pad(picture, SIZE, color="white").quantize(224).save(OUT / f"{name}.png", optimize=True)


def screen(page: Path, style: str) -> Image.Image:
    """What chromium shows of a page in this style, without the white around."""
    with tempfile.TemporaryDirectory() as folder:
        styled, shot = Path(folder, "page.html"), Path(folder, "shot.png")
        styled.write_text(page.read_text().replace("</head>", f"<style>{style}</style></head>"))
        options = [
            "--headless",
            "--no-sandbox",
            "--hide-scrollbars",
            "--window-size=820,1000",
            "--virtual-time-budget=4000",
        ]
        command = ["chromium", *options, "--force-device-scale-factor=1", f"--screenshot={shot}", styled.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        return trimmed(Image.open(shot).convert("RGB"))


def trimmed(picture: Image.Image) -> Image.Image:
    """A picture without its white border, except for a narrow one."""
    box = ImageChops.difference(picture, Image.new("RGB", picture.size, "white")).getbbox()
    return ImageOps.expand(picture.crop(box), 8, "white")


def main() -> None:
    """Make the film, or the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["film", "pages"])
    parser.add_argument("places", type=Path, nargs="+")
    asked = parser.parse_args()
    {"film": film, "pages": pages}[asked.what](*asked.places)


if __name__ == "__main__":
    main()
