"""Colours: one for each option, the same in every figure, frame and film."""

from __future__ import annotations

CONTROL = "#9a9a9a"

OPTIONS = (
    "#3f90da", "#e76300", "#332288", "#ecd83c", "#882255", "#7fd8f0", "#5c3317", "#bd1f01", "#a96b59", "#000000",
)  # fmt: skip
"""Any two of the first five and the grey of control are more than 23 apart in CIELAB, for normal sight and for readers
without red, green or blue cones. All ten are more than 18 apart."""


def option_colour(choice: int) -> str:
    """Hex colour of choice 1 to k; control (0) is grey. The ten colours repeat."""
    return CONTROL if choice == 0 else OPTIONS[(choice - 1) % len(OPTIONS)]


def option_rgb(choice: int) -> tuple[int, int, int]:
    """The colour of a choice as red, green and blue, 0 to 255."""
    red, green, blue = bytes.fromhex(option_colour(choice)[1:])
    return red, green, blue
