"""Colours: one for each option, the same in every figure, frame and film."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from ddco_pyro.names import option_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTROL = "#9a9a9a"

OPTIONS = (
    "#3f90da", "#e76300", "#332288", "#ecd83c", "#882255", "#7fd8f0", "#5c3317", "#bd1f01", "#a96b59", "#000000",
)  # fmt: skip
"""Any two of the first five and the grey of control are more than 23 apart in CIELAB, for normal sight and for readers
without red, green or blue cones. All ten are more than 18 apart."""

ROW = 132
"""Characters in a row of a legend, about: eleven options without names."""


def option_colour(choice: int) -> str:
    """Hex colour of choice 1 to k; control (0) is grey. The ten colours repeat."""
    return CONTROL if choice == 0 else OPTIONS[(choice - 1) % len(OPTIONS)]


def option_rgb(choice: int) -> tuple[int, int, int]:
    """The colour of a choice as red, green and blue, 0 to 255."""
    red, green, blue = bytes.fromhex(option_colour(choice)[1:])
    return red, green, blue


def add_legend(
    figure: Figure, choices: Iterable[int], names: Sequence[str] = (), place: str = "outside lower center"
) -> None:
    """Name the colours of these choices below a figure, in rows that it has room for.

    :param names: of each choice, control first.
    """
    from matplotlib.patches import Patch

    handles = [Patch(color=option_colour(choice), label=option_name(choice, names)) for choice in sorted(set(choices))]
    longest = max((len(handle.get_label()) for handle in handles), default=0)  # type: ignore[arg-type]
    columns = max(1, min(len(handles), ROW // (longest + 4)))
    figure.legend(handles=handles, loc=place, ncols=columns, handlelength=1)  # type: ignore[call-overload]
