"""What the networks look at in pictures, over one demonstration."""

from __future__ import annotations

import numpy as np

from ddco_pyro.acting.saliency import Saliency
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.heat import overlaid
from ddco_pyro.drawing.pictures import blank, keep
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.report.sections import Figures
from ddco_pyro.training.data import parts

COLUMNS, ROWS = 4, 3
CAPTION = (
    "Pictures of {}, {}, as networks see them, paler, and over them how much the control of the active option changes "
    "with each pixel (the norm of its gradient, for each picture by itself, from yellow to dark red). The frame has "
    "the colour of the option of the most likely path."
)


def section(fit: Fit, demos: Demonstrations) -> Figures | None:
    """Steps of a held-out demonstration, or of the first one where none is held out; None without pictures."""
    keys = fit.hierarchy.encoder.images
    if not keys:
        return None
    split = parts(fit.spec, demos)
    part = "valid" if "valid" in split else "train"
    chosen = split[part].select(split[part].names[:1])
    paths = [level[0] for level in fit.segment(chosen)]
    demo, saliency = chosen[0], Saliency(fit.hierarchy)
    shown = np.unique(np.linspace(0, len(demo) - 1, COLUMNS * ROWS).round().astype(int))
    panels = []
    for step in range(shown[-1] + 1):
        choices = [int(path[step]) for path in paths]
        looks = saliency.step({key: values[step] for key, values in demo.observations.items()}, choices)
        if step in shown:
            drawn = np.hstack([overlaid(*look) for look in looks.values()])
            panels.append((step, choices[0] if choices else 0, drawn))
    height, width = panels[0][2].shape[:2]
    figure = blank(ROWS * (9.6 / COLUMNS * height / width + 0.25))
    for axes, panel in zip(figure.subplots(ROWS, COLUMNS, squeeze=False).flat, panels, strict=False):
        step, choice, drawn = panel
        axes.imshow(drawn)
        axes.set(xticks=[], yticks=[], title=f"step {step}" + f", option {choice}" * bool(paths))
        axes.spines[:].set(visible=True, linewidth=3, color=option_colour(choice))
    for axes in figure.axes[len(panels) :]:
        axes.remove()
    held_out = "held out" if part == "valid" else "a training demonstration"
    caption = CAPTION.format(demo.name, held_out)
    path = fit.run_folder / "figures" / "looks.png"
    return Figures([keep(figure, path, f"Saliency of {', '.join(keys)} over {demo.name}", caption)])
