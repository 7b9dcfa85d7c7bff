"""One colour for each option, the same in every figure, frame and film."""

from __future__ import annotations

import matplotlib

CONTROL = "#9a9a9a"

OPTIONS = (
    "#3f90da", "#e76300", "#332288", "#ecd83c", "#882255", "#7fd8f0", "#5c3317", "#bd1f01", "#a96b59", "#000000",
)  # fmt: skip
"""For each two of the first five and the grey of control, the distance in CIELAB is above 23 for readers with normal
sight and for those without red, green or blue cones; for all ten it is above 18."""


def option_colour(choice: int) -> str:
    """Hex colour of choice 1 to k; control (0) is grey. Ten colours, told apart by colour-blind readers too, repeat."""
    return CONTROL if choice == 0 else OPTIONS[(choice - 1) % len(OPTIONS)]


def option_rgb(choice: int) -> tuple[int, int, int]:
    """The same as 0 to 255 red, green, blue."""
    red, green, blue = (round(255 * part) for part in matplotlib.colors.to_rgb(option_colour(choice)))
    return red, green, blue
