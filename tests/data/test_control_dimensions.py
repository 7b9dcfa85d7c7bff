"""What is said of each control dimension, against counts by hand, however demonstrations divide it."""

from dataclasses import replace

import numpy as np
import pytest

from ddco_pyro.data.controls import control_dimensions, control_parts, notes
from ddco_pyro.model.controls import ControlScaling
from ddco_pyro.spec import ControlSpec

STEPS = 200


def controls() -> np.ndarray:
    """Free; constant; a switch; at its maximum in 3 of 200 steps; in 2, so 1 %; at both ends, in halves."""
    random = np.random.default_rng(0)
    found = random.uniform(-0.9, 0.9, (STEPS, 6))
    found[:, 1] = 0.3
    found[:, 2] = np.where(np.arange(STEPS) < 50, -0.0, 1.0)
    found[[3, 100, 199], 3] = 1.0
    found[[3, 199], 4] = 1.0
    found[:60, 5], found[150:, 5] = -2.0, 7.25
    return found


def demonstrations(controls: np.ndarray, cuts: list[int]) -> dict[str, np.ndarray]:
    """Controls [T, A] divided before these steps."""
    return {f"demo_{number}": part for number, part in enumerate(np.split(controls, cuts))}


@pytest.mark.parametrize("cuts", [[], [99], [60, 60, 150]])
def test_each_dimension_is_described(cuts: list[int]) -> None:
    found = control_dimensions(demonstrations(controls(), cuts))
    free, still, switch, seldom, twice, both = (replace(each, made_by={}, exceptions=()) for each in found)
    assert (free.constant, free.values, free.extremes, free.note) == (False, (), (), "")
    assert (still.constant, still.values) == (True, (0.3,))
    assert (switch.constant, switch.values, switch.extremes) == (False, (0.0, 1.0), ())
    assert (switch.at_minimum, switch.at_maximum, switch.steps) == (50, 150, STEPS)
    assert seldom.extremes == (("maximum", 1.0, 0.015),)
    assert twice.extremes == ()
    assert both.extremes == (("minimum", -2.0, 0.3), ("maximum", 7.25, 0.25))
    assert notes([free, still, switch, seldom, twice, both]) == [
        "control dimension 1: constant (0.3): no part of the model, emitted as it is",
        "control dimension 2: takes two values, 0 and 1",
        "control dimension 3: exactly at its maximum 1 in 1.5 % of the steps",
        "control dimension 5: exactly at its minimum -2 in 30.0 % of the steps, at its maximum 7.25 in 25.0 "
        "% of the steps",
    ]


def resting(steps: int = STEPS) -> np.ndarray:
    """At 0.25 in half of the steps; at -0 in nine tenths of these; at 0 in a tenth, 1 and -1 too; rounded."""
    random = np.random.default_rng(1)
    found = random.uniform(-0.9, 0.9, (steps, 4))
    half, tenth = np.arange(steps) % 2 == 0, np.arange(steps) % 20
    found[half, 0] = 0.25
    found[half & (tenth != 4), 1] = -0.0
    for value, at in ((0.0, (3, 5)), (1.0, (7, 9)), (-1.0, (11, 13))):
        found[np.isin(tenth, at), 2] = value
    found[:, 3] = found[:, 3].round(3)
    return found


@pytest.mark.parametrize("cuts", [[], [60, 150], [99]])
def test_a_value_inside_the_range_is_counted_and_with_whom_it_is_taken(cuts: list[int]) -> None:
    first, second, third, fourth = control_dimensions(demonstrations(resting(), cuts))
    inside = [(each.inside, each.at_inside) for each in (first, second, third)]
    assert inside == [(0.25, 100), (0.0, 90), (0.0, 20)]
    assert [each.together for each in (first, second, third)] == [(1,), (0,), ()]
    assert first.note == "exactly 0.25 in 50.0 % of the steps"
    ends = "exactly at its minimum -1 in 10.0 % of the steps, at its maximum 1 in 10.0 % of the steps"
    assert third.note == f"exactly 0 in 10.0 % of the steps; {ends}"
    assert fourth.note == ""


def rounded(dtype: type) -> np.ndarray:
    """[200, 4]: a limit often reached, a switch, a rest and a constant, at times missed by rounding."""
    random = np.random.default_rng(0)
    found = random.uniform(-2.2, 2.2, (STEPS, 4))
    found[::4, 0], found[1::4, 0] = -2.4, 2.4
    found[:, 1] = np.where(np.arange(STEPS) % 2 == 0, 0.0, 0.7)
    found[::3, 2] = 0.3
    found[:, 3] = 0.1
    found[::8] *= 1 + 2 * np.finfo(dtype).eps
    return found.astype(dtype).astype(np.float64)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("cuts", [[], [1, 2, 3]])
def test_a_limit_that_is_missed_by_rounding_is_reached(cuts: list[int], dtype: type) -> None:
    """Else most steps at the limit are a value inside the range, beside an extreme that a few steps have."""
    demonstration = rounded(dtype)
    found = control_dimensions(demonstrations(demonstration, cuts))
    limit, switch, rest, still = found
    assert len(np.unique(demonstration[::4, 0])) == 2  # rounding does show
    assert (limit.at_minimum, limit.at_maximum, limit.inside) == (50, 50, None)
    assert (len(switch.values), rest.at_inside, still.constant) == (2, 67, True)
    parts = control_parts(ControlSpec(), found)
    kinds = [(part.dims, part.kind) for part in parts]
    assert kinds == [((0,), "clipped"), ((2,), "hurdle"), ((1,), "binary")]
    scaling = ControlScaling(ControlSpec(), 4, {3: still.minimum}, parts)
    scaled = scaling.scaled(demonstration)
    at = [np.isin(np.arange(STEPS) % 4, phases) for phases in ([0], [1])]
    low, high = (end.numpy()[0] for end in scaling.ends())
    assert ((scaled[:, 0].astype(np.float32) <= low) == at[0]).all()
    assert ((scaled[:, 0].astype(np.float32) >= high) == at[1]).all()
    assert set(scaled[:, 1]) == {0.0, 1.0}
    assert ((scaled[:, 2] == 0) == (np.arange(STEPS) % 3 == 0)).all()


def test_a_short_file_does_not_sit_on_its_extremes() -> None:
    """In 20 steps a value that is taken once is taken in 5 % of them."""
    assert notes(control_dimensions({"demo": np.arange(20.0)[:, None]})) == []


def test_values_that_are_not_finite_do_not_count() -> None:
    column = np.array([np.nan, 2.0, np.inf, 2.0, -np.inf])
    for cuts in ([], [1, 2, 3, 4]):
        (found,) = control_dimensions(demonstrations(column[:, None], cuts))
        assert (found.values, found.steps) == ((2.0,), 2)
    assert control_dimensions({"demo": np.full((3, 1), np.nan)}) == ()


SPOILT = {
    "dead": lambda made: 0 * made,
    "padded": lambda made: np.concatenate([made, np.zeros((100, 2))]),
    "at its limit": lambda made: np.where(np.arange(len(made))[:, None] < 20, 5.0, made),
}
OTHERS = {
    "free": lambda random: random.normal(size=(50, 2)),
    "positive": lambda random: random.uniform(0.1, 1, (50, 2)),
}


@pytest.mark.parametrize("spoilt", [(3,), (3, 17)], ids=["one", "two"])
@pytest.mark.parametrize("spoil", SPOILT)
@pytest.mark.parametrize("others", OTHERS)
def test_what_few_demonstrations_make_decides_no_kind(others: str, spoil: str, spoilt) -> None:
    """It is said of whom it is; what half of them make decides the kind as it did."""
    random, spoiling = np.random.default_rng(0), SPOILT[spoil]
    made = {f"demo_{n}": OTHERS[others](random) for n in range(20)}
    rested = {name: spoiling(one) if number % 2 else one for number, (name, one) in enumerate(made.items())}
    made |= {f"demo_{n}": spoiling(made[f"demo_{n}"]) for n in spoilt}
    found = control_dimensions(made)
    (part,) = control_parts(ControlSpec(), found)
    assert part.kind == "gaussian"
    assert all(f"demo_{n}" in text for n in spoilt for text in (part.why, found[0].note))
    assert {part.kind for part in control_parts(ControlSpec(), control_dimensions(rested))} == {
        "clipped" if spoil == "at its limit" or others == "positive" else "hurdle"
    }


@pytest.mark.parametrize(
    ("others", "odd", "named"),
    [
        ((-1.0, 1.0), (-1.0, 0.0, 1.0), True),
        ((-1.0, 1.0), (0.0, 0.0, 1.0), True),
        ((1.0, 1.0), (1.0, 1.0, 0.0), True),
        ((-1.0, 0.0, 1.0), (-1.0, 0.0, 1.0), False),
        ((-1.0, 1.0), (1.0, 1.0, 1.0), False),
    ],
)
def test_a_demonstration_without_which_a_dimension_would_be_a_switch_or_constant_is_named(
    others: tuple[float, ...], odd: tuple[float, ...], named: bool
) -> None:
    made = {f"demo_{n}": np.resize(others, 30)[:, None] for n in range(10)}
    made["demo_4"] = np.resize(odd, 30)[:, None]
    (found,) = control_dimensions(made)
    assert found.exceptions == (("demo_4",) if named else ())
    assert ("a switch without demo_4" in found.note) == (named and len({*others, *odd}) == 3)
