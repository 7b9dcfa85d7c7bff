"""Words for numbers, measures and models."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ddco_pyro.metrics import METRICS, Against, Difference, Rate
from ddco_pyro.names import HIERARCHY, METHODS, method
from ddco_pyro.statistics import mean_interval

NAT = "one nat more per step means that the control of a step is e = 2.7 times as probable"

P_VALUE = "p: McNemar’s exact test, two-sided, not corrected for the number of comparisons."

ABOUT = {
    "ddco": "policies that stay active until they end",
    "flat": "one policy without options",
    "per_timestep": "a policy for each time step",
    "mixture": "the options’ policies with a new choice at every step (no memory)",
}


def about(names: Iterable[str]) -> str:
    """A sentence that explains the methods."""
    return "; ".join(f"{method(name)}: {ABOUT[name]}" for name in names if name in ABOUT) + "."


def verb(name: str, many: str, one: str) -> str:
    """The form of a verb after the name of a method."""
    return many if name.lower() == METHODS[HIERARCHY] else one


def number(value: float | None, digits: int = 2) -> str:
    """A number with fixed digits after the point and a real minus sign; a dash for None and NaN."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}"
    return (text.lstrip("-") if float(text) == 0 else text).replace("-", "−")


def signed(value: float, digits: int = 2) -> str:
    """A number as :func:`number` gives it, with a plus sign where it is positive."""
    text = number(value, digits)
    return text if text.startswith(("−", "–")) or float(text) == 0 else f"+{text}"


def percent(value: float | None, digits: int = 0) -> str:
    """A share in percent."""
    return "–" if value is None or not math.isfinite(value) else f"{number(100 * value, digits)} %"


def interval(value: Sequence[float] | None, scale: float = 1.0, digits: int = 2) -> str:
    """``low to high``."""
    return "–" if value is None else " to ".join(number(scale * end, digits) for end in value)


def duration(frequency: float | None, *steps: float) -> str:
    """``61 steps``, or ``8 to 29 steps``, with seconds where the frequency (Hz) is known."""
    said = " to ".join(f"{round(count, 2):g}" for count in steps) + (" step" if steps[-1] == 1 else " steps")
    return f"{said}, {' to '.join(f'{count / frequency:.3g}' for count in steps)} s" if frequency else said


def p_value(value: float) -> str:
    """A p-value with two significant digits."""
    return "< 0.001" if value < 0.001 else f"{value:.2g}"


def rate(result: Rate, of: str = "") -> str:
    """``41 of 50 (69 to 90 %)``: successes, trials (with a noun ``of``) and the 95 % interval of the rate."""
    text = f"{result.successes} of {result.trials} {of}".rstrip()
    return text if result.interval is None else f"{text} ({interval(result.interval, 100, 0)} %)"


def measure(name: str) -> str:
    """A measure as people read it: ``nmi`` is ``NMI``, a task's own ``accuracy_mm`` is ``Accuracy (mm)``."""
    if name in METRICS:
        return METRICS[name].name
    base, _, unit = name.rpartition("_")
    units = {"mm", "cm", "m", "s", "rad", "deg", "steps"}
    text = f"{base} ({unit})" if base and unit in units else name
    return text.replace("_", " ").capitalize() if "(" not in text else capital(text.replace("_", " "))


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def over_seeds(name: str, values: Sequence[float]) -> str:
    """``+1.00 [0.50 to 1.50]``: the mean of differences over training seeds with its 95 % t interval.

    :param name: of :data:`~ddco_pyro.metrics.METRICS`.
    """
    _, _, scale, digits = METRICS[name]
    mean = signed(scale * float(np.mean(values)), digits)
    return f"{mean} [{interval(mean_interval(values), scale, digits)}]"


def of_episodes(pair: Against | None) -> str:
    """A difference in successes with McNemar's exact p-value; a dash for None."""
    if pair is None:
        return "–"
    return f"{signed(pair.only_ours - pair.only_theirs, 0)} (p = {p_value(pair.p_value)})".replace("= <", "<")


def spread(values: Sequence[float]) -> tuple[str, str, str]:
    """Mean, 95 % t interval of the mean, and range of a few values."""
    mean = number(float(np.mean(values)))
    return mean, interval(mean_interval(values)), interval((min(values), max(values)))


def with_error(difference: Difference | None, digits: int = 2) -> str:
    """A difference in nats per step with its standard error over held-out demonstrations; a dash for None."""
    if difference is None:
        return "–"
    return f"{signed(difference.nats_per_step, digits)} ± {number(difference.standard_error, digits)}"


def listed(items: Iterable[str]) -> str:
    """``a, b and c``."""
    items = list(items)
    return items[0] if len(items) == 1 else ", ".join(items[:-1]) + " and " + items[-1]
