"""The first picture of the README and of the site: the needle's options in space and over time, in large letters.

    python studies/needle_picture.py RUN

RUN is a fit of ``specs/needle.yaml``; writes ``docs/images/needle.png``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ddco_pyro.drawing.colours import legend
from ddco_pyro.drawing.figures import STYLE, save
from ddco_pyro.fitting.fit import load
from ddco_pyro.report.activity import Activity, activity
from ddco_pyro.report.options import colour_image, row_order
from ddco_pyro.report.trajectories import panel

KEY = "gripper_pose"
OUT = Path("docs/images/needle.png")
LARGE = {"font.size": 13, "axes.labelsize": 13, "legend.fontsize": 13, "xtick.labelsize": 12, "ytick.labelsize": 12}


def draw(found: Activity, positions: list) -> Figure:
    """Left: gripper positions coloured by option. Right: the options of every demonstration over its steps."""
    (level,), rows = found.levels, row_order(found)
    figure = Figure(figsize=(9.2, 4.6))
    space = figure.add_axes((-0.02, 0.12, 0.5, 0.8), projection="3d", proj_type="ortho")
    panel(space, level, positions, KEY)
    for name, axis in zip("xyz", (space.xaxis, space.yaxis, space.zaxis), strict=True):
        axis.set_label_text(f"{name} (mm)")
        axis.labelpad = 9
    space.tick_params(labelsize=10)
    time = figure.add_axes((0.57, 0.24, 0.42, 0.66))
    extent = (-0.5, level.path.shape[1] - 0.5, len(rows) + 0.5, 0.5)
    time.imshow(colour_image(level.path[rows]), aspect="auto", interpolation="nearest", extent=extent)
    time.set(xlabel="step", ylabel="demonstration")
    time.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    figure.text(0.24, 0.94, "where", ha="center", fontsize=14)
    figure.text(0.78, 0.94, "when", ha="center", fontsize=14)
    figure.legend(handles=legend(level.choices), loc="lower center", ncols=5, handlelength=1, columnspacing=1.6)
    return figure


def main() -> None:
    """Draw the picture of a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    fit = load(parser.parse_args().run)
    demos = fit.demonstrations
    with matplotlib.rc_context({**STYLE, **LARGE, "figure.constrained_layout.use": False}):
        figure = draw(activity(fit, demos), [demo.observations[KEY][:, :3] for demo in demos])
        save(figure, OUT, "Gripper positions coloured by option, and the options of every demonstration over time", "")


if __name__ == "__main__":
    main()
