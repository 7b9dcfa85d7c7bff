"""Names of models, options and labels, and colours of options: the same in every figure, frame and film."""

from __future__ import annotations

from collections.abc import Sequence

from ddco_pyro.data.labels import UNKNOWN

HIERARCHY = "ddco"
"""The name of a hierarchy whose options last, in tables."""

MIXTURE = "mixture"

FLAT = ("flat", "flat_equal")
"""Flat baselines; a hierarchy is compared with the first one that a fit has."""

METHODS = {
    "ddco": "options",
    "flat": "flat",
    "flat_equal": "flat of equal size",
    "per_timestep": "per-timestep",
    "mixture": "mixture",
    "open_loop": "open loop",
}


def method(name: str) -> str:
    """A method in words: ``flat_equal`` is ``flat of equal size``."""
    return METHODS.get(name, name.replace("_", " "))


def option_name(option: int, names: Sequence[str] = ()) -> str:
    """The name of a choice: ``control``, the option's name, or ``option h`` where it has none.

    :param names: of each choice, control first, as in ``fit.names[level]``.
    """
    return names[option] if option < len(names) else f"option {option}" if option else "control"


def numbered_name(option: int, names: Sequence[str] = ()) -> str:
    """``grasp (option 2)``, or ``option 2`` where it has no name."""
    name, number = option_name(option, names), option_name(option)
    return name if name == number else f"{name} ({number})"


def name_in_level(option: int, level: str, names: Sequence[str] = ()) -> str:
    """``grasp``, or ``skill 2`` where option 2 of the level ``skill`` has no name."""
    name = option_name(option, names)
    return f"{level} {option}" if option and name == option_name(option) else name


def label_name(label: str, value: int, names: Sequence[str] = (), level: str = "option") -> str:
    """``grasp`` where the file names label 2 of the labels ``phase``, else ``phase 2``; ``unknown`` for −1.

    Labels that are called as a level's options are are ``label 2``.

    :param names: of labels 0, 1, ...
    """
    if value == UNKNOWN:
        return "unknown"
    named = names[value].strip() if 0 <= value < len(names) else ""
    return named or f"{'label' if label in (level, 'option') else label} {value}"


def choice_names(count: int, named: Sequence[str] = ()) -> tuple[str, ...]:
    """The name of each choice of a level with ``count`` options, control first.

    :param named: the names of the options; empty where they have none.
    """
    return option_name(0), *(named or map(option_name, range(1, 1 + count)))


# --- colours ------------------------------------------------------------------------------------------------

CONTROL = "#9a9a9a"

OPTIONS = (
    "#3f90da", "#e76300", "#332288", "#ecd83c", "#882255",
    "#7fd8f0", "#5c3317", "#bd1f01", "#a96b59", "#000000",
)  # fmt: skip
"""Any two of the first five and the grey of control are more than 23 apart in CIELAB, for normal sight and
for readers without red, green or blue cones. All ten are more than 18 apart."""


def option_colour(choice: int) -> str:
    """Hex colour of choice 1 to k; control (0) is grey. The ten colours repeat."""
    return CONTROL if choice == 0 else OPTIONS[(choice - 1) % len(OPTIONS)]


def option_rgb(choice: int) -> tuple[int, int, int]:
    """The colour of a choice as red, green and blue, 0 to 255."""
    red, green, blue = bytes.fromhex(option_colour(choice)[1:])
    return red, green, blue
