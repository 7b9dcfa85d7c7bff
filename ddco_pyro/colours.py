"""One colour for each option, the same in every figure, frame and film."""

from __future__ import annotations

import matplotlib

CONTROL = "#9a9a9a"


def option_colour(choice: int) -> str:
    """Hex colour of choice 1 to k; control (0) is grey. Ten colours, told apart by colour-blind readers too, repeat."""
    if choice == 0:
        return CONTROL
    palette = matplotlib.color_sequences["petroff10"]
    return matplotlib.colors.to_hex(palette[(choice - 1) % len(palette)])


def option_rgb(choice: int) -> tuple[int, int, int]:
    """The same as 0 to 255 red, green, blue."""
    red, green, blue = (round(255 * part) for part in matplotlib.colors.to_rgb(option_colour(choice)))
    return red, green, blue
