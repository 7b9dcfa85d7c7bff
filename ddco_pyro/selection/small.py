"""What small fits decide of a spec: heavy tails, and what makes options last as long as is asked for.

The less the control counts, the more a change of option costs beside what it explains. What gates and
terminations read costs nothing, so where even a small power leaves segments too short, both become constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.starting import Decided
from ddco_pyro.drawing.words import duration
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.options import segments_of
from ddco_pyro.events import Counted, EpochEnded, Event, OnEvent, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.metrics import Segments
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.training.data import train_and_valid

FIRST, LEAST = 0.5, 0.005
"""The largest and the smallest power that are tried."""
HALVINGS = 2
"""Powers that are tried between two with gates of one kind."""
NEAR, FAR = 1.15, 1.5
"""Factors between the median and what is asked: a search ends within the first, or a step; gates stay as they
are within the second."""
LADDER = (0.5, 0.05, 0.02)
"""Powers that are tried in this order where no length is asked for, at last with constant gates."""
FEW = 3
"""Segments of a demonstration, in the mean, below which they are few."""
USUAL = 0.5
"""Below this power gates and terminations have ridges of :data:`RIDGE`; options may begin from windows."""
RIDGE = 100.0
"""What gates and terminations read of observations costs nothing else."""
STEPS_A_SECOND = 10
"""Where the frequency is unknown."""
PARTS = (1, 3)
"""Half widths of windows are one second over these: the first, and all and none where a length is asked."""
STEPS = 6000
"""Steps of the demonstrations that are used, about."""
FEWEST = 4
"""Fewest demonstrations of which a half predicts the other."""
EPOCHS = 30
"""Most epochs of a fit."""


class Lasting(NamedTuple):
    """How much the control counts, and the median segment that comes of it.

    :param power: β.
    :param constant: whether gates and terminations are constant.
    :param window: ``training.window`` of options that last long; 0 for none.
    :param segments: of the lowest level.
    :param value: log-likelihood per step of the tuning demonstrations with that power, nats.
    """

    power: float
    constant: bool
    window: int
    segments: Segments
    value: float


def overrides(spec: Spec, power: float, constant: bool, window: int) -> dict[str, Any]:
    """The key paths of a spec whose options last as these values make them."""
    values: dict[str, Any] = {"control.power": power}
    if power < USUAL:
        values["training.optimizer.ridge.gate"] = RIDGE
        values |= {"training.starts": ["windows"], "training.window": window} if window else {}
    if constant and spec.hierarchy is not None:
        levels = spec.hierarchy.levels
        policies = [f"levels.{n}.policy" for n in range(1, len(levels))]
        terminations = [f"levels.{n}.termination" for n, level in enumerate(levels) if level.lasts]
        gates = (*policies, *terminations, "meta_policy")
        values |= {f"hierarchy.{gate}.network": "constant" for gate in gates}
    return values


def decide(
    spec: Spec,
    demos: Demonstrations,
    frequency: float | None,
    steps: float | None = None,
    on_event: OnEvent = ignore,
) -> Decided:
    """What small fits to training demonstrations decide of a starting spec.

    :param frequency: steps per second (Hz); None where unknown.
    :param steps: the median segment that is asked for; None for any that is not too short for a skill.
    :raises BadInput: the spec has no options that last.
    """
    heavy = heavy_tails(spec, demos)
    found = lasting(with_heavy_tails(spec, heavy), demos, steps, on_event)
    wanted = "" if steps is None else f"; asked: {duration(frequency, steps)}"
    why = f"median segment {duration(frequency, found.segments.median)} in small fits{wanted}"
    return Decided(found.power, found.constant, found.window, why, heavy, moved(demos))


def lasting(spec: Spec, demos: Demonstrations, steps: float | None, on_event: OnEvent = ignore) -> Lasting:
    """The power, and gates, with which a fit's median segment has a length that is asked for.

    Fits are of the model alone, to some of the training demonstrations. Where a length is asked for, several
    windows are tried below :data:`USUAL`, and the one with the best tuning log-likelihood is kept: windows
    that are longer than skills mix them.

    :param steps: the length, in steps; None for any that is not too short for a skill.
    :raises BadInput: the spec has no options that last.
    """
    if spec.hierarchy is None or not spec.hierarchy.levels[0].lasts:
        raise BadInput("lengths of segments are of a spec whose lowest level has options that last")
    some, sketch = _some(train_and_valid(spec, demos)["train"]), _sketch(spec)

    second = demos.frequency or STEPS_A_SECOND
    windows = [max(1, round(second / part)) for part in PARTS]
    windows = windows[:1] if steps is None else [*windows, 0]

    def begun(power: float, constant: bool, window: int) -> Lasting:
        values = [-math.inf]

        def heard(event: Event) -> None:
            if isinstance(event, EpochEnded):
                values.append(event.tune)

        found = fit(with_overrides(sketch, overrides(spec, power, constant, window)), some, on_event=heard)
        segments = segments_of(found.segment(some)[0], demos.frequency)
        return Lasting(power, constant, window, segments, values[-1])

    def tried(power: float, constant: bool) -> Lasting:
        tries = [begun(power, constant, window) for window in (windows if power < USUAL else [0])]
        found = max(tries, key=lambda one: one.value)
        gates = ", constant gates" if constant else ""
        note = f"power {power:g}{gates}: median segment {found.segments.median:g} steps"
        on_event(Counted("trying lengths", None, note))
        return found

    return unasked(tried) if steps is None else asked(tried, steps)


def _sketch(spec: Spec) -> Spec:
    """The spec of a small fit of the model alone, with all demonstrations, from its first start."""
    return with_overrides(
        spec,
        {
            "compare_with": [],
            "demonstrations.valid_fraction": 0,
            "demonstrations.hold_out_by": None,
            "training.starts": spec.training.starts[:1],
            "training.epochs": min(EPOCHS, spec.training.epochs or EPOCHS),
        },
    )


def heavy_tails(spec: Spec, demos: Demonstrations) -> tuple[int, ...]:
    """The Gaussian control dimensions, where one Student t predicts them better than Gaussians do, else none.

    Small fits to every other one of some training demonstrations predict the controls of the rest.
    """
    some = _some(train_and_valid(spec, demos)["train"])
    if len(some) < FEWEST:
        return ()
    places = (range(first, len(some), 2) for first in (0, 1))
    train, rest = (Demonstrations(tuple(some[place] for place in own)) for own in places)
    usual = fit(_sketch(spec), train)
    kinds = usual.hierarchy.scaling.parts
    heavy = tuple(sorted(dim for part in kinds if part.kind == "gaussian" for dim in part.dims))
    if not heavy:
        return ()
    other = fit(_sketch(with_heavy_tails(spec, heavy)), train)
    gain = other.log_likelihood(rest).sum() - usual.log_likelihood(rest).sum()
    return heavy if gain > 0 else ()


def moved(demos: Demonstrations) -> str:
    """The vector that controls move most as a position, of three numbers or more, else of two; or empty.

    Its value is the product of three shares: of its changes that controls explain, of its numbers that are
    drawn (the first three), and of the way of steady steps that the diagonal of the box around it is: 1 along
    a straight line, near 0 for a velocity. A vector of constant norm, such as a quaternion, is no position.
    """
    shapes = demos.observation_shapes
    in_space = [key for key, shape in shapes.items() if len(shape) == 1 and shape[0] >= 3]
    for keys in (in_space, [key for key, shape in shapes.items() if shape == (2,)]):
        values = {key: _moved(key, demos) for key in keys}
        best = max(values, key=values.__getitem__, default="")
        if best and values[best] > 0:
            return best
    return ""


def _moved(key: str, demos: Demonstrations) -> float:
    values = [np.asarray(demo.observations[key], float) for demo in demos]
    norms = np.concatenate([np.linalg.norm(array, axis=1) for array in values])
    points = [array[:, :3] for array in values]
    steps = [np.diff(path, axis=0) for path in points]
    ways = [float(np.sqrt(np.square(each).sum() * len(each))) for each in steps]
    spans = [np.linalg.norm(np.ptp(path, axis=0)) for path in points]
    reach = np.mean([span / way if way else 0.0 for span, way in zip(spans, ways, strict=True)])
    if np.ptp(norms) <= 1e-3 * norms.max() or reach == 0:
        return 0.0
    changes, before = np.concatenate(steps), np.concatenate([path[:-1] for path in points])
    controls = np.concatenate([demo.actions[:-1].reshape(len(demo) - 1, -1).astype(float) for demo in demos])

    def left(*by: np.ndarray) -> float:
        """The squares of the changes that these numbers do not explain linearly."""
        rows = np.column_stack([np.ones(len(changes)), *by])
        return float(np.square(changes - rows @ np.linalg.lstsq(rows, changes, rcond=None)[0]).sum())

    alone = left(before)
    explained = 1 - left(before, controls) / alone if alone > 0 else 0.0
    return float(reach * explained * points[0].shape[1] / values[0].shape[1])


def with_heavy_tails(spec: Spec, dims: tuple[int, ...]) -> Spec:
    """The spec with one Student t for these control dimensions, if there are any."""
    heavy = {"control.parts": [{"name": "heavy", "dims": dims, "kind": "student"}]}
    return with_overrides(spec, heavy if dims else {})


def in_steps(place: str, length: str, frequency: float | None) -> float:
    """The steps of a length such as ``2s`` or ``20``.

    :param frequency: steps per second (Hz); None where unknown.
    :raises BadInput: the text is no length, or seconds are given and the frequency is unknown.
    """
    number, seconds = length.removesuffix("s"), length.endswith("s")
    try:
        value = float(number)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise BadInput(f"{place} {length}: give seconds, such as 2s, or steps, such as 20")
    if seconds and not frequency:
        why = "the demonstrations do not say how many steps a second has; give steps"
        raise BadInput(f"{place} {length}: {why}")
    return value * frequency if seconds and frequency else value


def unasked(tried: Callable[[float, bool], Lasting]) -> Lasting:
    """The first power of :data:`LADDER` whose segments are not :attr:`~ddco_pyro.metrics.Segments.brief`.

    Where that leaves few segments in a demonstration, options are about to become one. Then it is a power
    between this one and the one before, and where that leaves few segments, too, the one before.
    """
    found = before = tried(LADDER[0], False)
    for power in LADDER[1:]:
        if not found.segments.brief:
            break
        before, found = found, tried(power, power == LADDER[-1])

    def few(own: Segments) -> bool:
        return own.number < FEW * own.demonstrations

    if before is found or not few(found.segments):
        return found
    between = tried(float(f"{math.sqrt(before.power * found.power):.2g}"), before.constant)
    return before if few(between.segments) else between


def asked(tried: Callable[[float, bool], Lasting], steps: float) -> Lasting:
    """The largest power with a median about as long as asked for: down in halves, then between the last two.

    Too small a power makes segments short again, since options then hardly differ.
    """
    found: list[Lasting] = []
    for constant in (False, True):
        shorter, power = 1.0, FIRST
        while power >= LEAST:
            found.append(tried(power, constant))
            if found[-1].segments.median >= steps or _near(found[-1], steps):
                break
            shorter, power = power, power / 2
        else:
            power = 0.0
        for _ in range(HALVINGS if power else 0):
            if any(_near(one, steps) for one in found):
                break
            found.append(tried(float(f"{math.sqrt(shorter * power):.2g}"), constant))
            longer = found[-1].segments.median >= steps
            shorter, power = (shorter, found[-1].power) if longer else (found[-1].power, power)
        best = min(found, key=lambda one: _off(one, steps))
        if _off(best, steps) < FAR:
            break
    return best


def _near(found: Lasting, steps: float) -> bool:
    return _off(found, steps) < NEAR or abs(found.segments.median - steps) <= 1


def _off(found: Lasting, steps: float) -> float:
    """The factor between a median and the length asked for, at least 1."""
    return max(found.segments.median / steps, steps / found.segments.median)


def _some(demos: Demonstrations) -> Demonstrations:
    """Demonstrations of about :data:`STEPS` steps, of all parts of their order; four or more if there are."""
    number = max(4, round(STEPS / np.mean([len(demo) for demo in demos])))
    chosen = np.unique(np.linspace(0, len(demos) - 1, number).round().astype(int))
    return Demonstrations(tuple(demos[place] for place in chosen), attributes=demos.attributes)
