"""What the studies of bin picking make of demonstrations and rates, on ones with planted trials."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from bin_picking import OURS, beside, summarize
from bin_picking_recovery import counted
from bin_picking_trials import ENDINGS, Bin, Load, Trial
from bin_picking_trials import trials as trials_of
from bin_picking_unseen import place
from ddco_tasks.bin_picking.trials import Attempt, End, Trials
from rates import shown

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.simulation.episodes import Episode, rate

DEMONSTRATION = Demonstration("demo_0", {"kin": np.zeros((10, 7))}, np.zeros((10, 7)))


def test_methods_are_paired_by_seed() -> None:
    def bins(cleared: list[int]) -> dict[str, list[dict[str, float]]]:
        return {"bins": [Trials(()).measures() | {"cleared": one, "objects": 3, "attempts": 1} for one in cleared]}

    cells = [{"methods": {OURS: bins([1, 1, 1]), "flat": bins([0, 1, 0])}}] * 2
    found = summarize([*cells, {"methods": {OURS: bins([0]), "flat": bins([1])}}])
    assert found["flat"]["cleared by seed"] == [1, 1, 1]
    # Two bins more, two more and one fewer: the mean of three is 1, and its standard error 1; t(0.975, 2) is 4.3027.
    assert found["flat"]["paired"]["by_seed"] == [2, 2, -1]
    assert found["flat"]["paired"]["interval"] == pytest.approx([1 - 4.3027, 1 + 4.3027], abs=1e-4)
    assert beside(found["flat"]["paired"]) == "+2, +2, -1: +1.0 [-3.3, +5.3]"
    assert found[OURS]["paired"] is None


def test_rates_have_counts_and_wilson_interval() -> None:
    # Wilson's interval for 8 of 10 by hand: centre (0.8 + 0.192073) / 1.384146 = 0.71674, half width 0.22658.
    assert shown(rate(8, 10)) == "80.0% (8 of 10; 49.0% to 94.3%)"
    assert shown(rate(0, 0)) == "-"


NONE, FIRST, BOTH = frozenset[int](), frozenset({0}), frozenset({0, 1})
STEPS = slice(0, 10)
ATTEMPTS = {
    "into its cup": Attempt(2, FIRST, FIRST, ("accept",), 10),
    "nothing taken": Attempt(2, NONE, NONE, ("bin",), 10),
    "several taken": Attempt(2, BOTH, BOTH, ("bin", "bin"), 10),
    "slipped": Attempt(2, BOTH, FIRST, ("accept",), 10),
    "into the wrong cup": Attempt(2, FIRST, FIRST, ("reject",), 10),
    "one let go over the bin": Attempt(2, FIRST, FIRST, ("bin",), 10),
    "none or several to a cup": Attempt(2, BOTH, BOTH, ("accept", "accept"), 10),
    "not let go": Attempt(2, FIRST, FIRST, (), 20),
}


def a_bin(trial: Trial, end: End) -> Bin:
    """A bin with a pin and a wire, and one trial."""
    empty = Episode(0, DEMONSTRATION, {}, np.zeros((10, 1), int))
    return Bin(empty, Trials(["pin", "wire"], end=end), [trial])


@pytest.mark.parametrize("name", ATTEMPTS)
def test_trials_are_called_by_how_they_end(name: str) -> None:
    trial = Trial(STEPS, ATTEMPTS[name].lifted, ATTEMPTS[name])
    assert a_bin(trial, End.MISSED).ending(trial) == name


def test_a_bin_that_ends_before_the_jaws_open_names_its_last_trial() -> None:
    assert [*ATTEMPTS, "lost"] == list(ENDINGS)
    for attempt in (None, ATTEMPTS["slipped"]):
        trial = Trial(STEPS, FIRST, attempt)
        assert a_bin(trial, End.LOST).ending(trial) == "lost"
    unfinished = Trial(STEPS, NONE, None)
    assert a_bin(unfinished, End.FOAM).ending(unfinished) == "foam"


def test_recoveries_are_of_what_is_held_where_it_is_shown() -> None:
    """What is lost after it was shown alone is nobody's to take back; trials without a decision do not count."""
    back, cup, lost = ATTEMPTS["nothing taken"], ATTEMPTS["into its cup"], Attempt(2, FIRST, NONE, ("accept",), 10)
    shown = [(NONE, back), (NONE, lost), (BOTH, ATTEMPTS["several taken"]), (BOTH, cup), (FIRST, cup), (FIRST, lost)]
    others = [
        (FIRST, ATTEMPTS["one let go over the bin"]),
        (FIRST, None),
        (None, back),
        (FIRST, ATTEMPTS["not let go"]),
    ]
    loads = [None if held is None else Load(held, shown=True, seen=bool(held)) for held, _ in shown + others]
    found = counted(
        [Trial(STEPS, FIRST, attempt, load) for load, (_, attempt) in zip(loads, shown + others, strict=True)]
    )
    falling = counted([Trial(STEPS, FIRST, lost, Load(NONE, shown=True, seen=True))])
    assert found == {
        "nothing": 2, "nothing back": 1, "unseen": 2, "unseen back": 1, "several": 2, "several back": 1, "one": 3,
        "one back": 1, "one lost": 1, "due back": 4, "back": 2,
    }  # fmt: skip
    assert (falling["nothing"], falling["unseen"]) == (1, 0)


def test_a_load_is_shown_where_the_gripper_shows_it_be_it_late() -> None:
    """A grasp that is tried again shows its load some steps later; one that opens its jaws before shows none."""
    away, empty, showing = Load(FIRST, False, False), Load(NONE, False, False), Load(FIRST, True, True)
    task = SimpleNamespace(
        trials=SimpleNamespace(
            attempts=[Attempt(2, FIRST, FIRST, ("accept",), 9), Attempt(2, NONE, NONE, ("bin",), 6)]
        ),
        lifted=None,
    )
    late, never, open_ended = trials_of(task, [empty] * 7 + [showing, away] + [empty] * 6 + [away, showing, showing])
    assert late.load is showing
    assert late.steps == slice(0, 9)
    assert never.load is None
    assert open_ended.load is showing
    assert open_ended.attempt is None


@pytest.mark.parametrize(
    ("lifted", "attempt", "expected"),
    [
        (FIRST, Attempt(1, FIRST, FIRST, ("accept",), 10), "accept"),
        (FIRST, Attempt(1, FIRST, FIRST, ("bin",), 10), "bin"),
        (FIRST, Attempt(1, FIRST, FIRST, ("outside",), 10), "lost"),
        (FIRST, Attempt(1, FIRST, NONE, ("reject",), 10), "lost"),  # the gripper was over the cup, the object not
        (FIRST, Attempt(1, FIRST, FIRST, (), 20), "not let go"),
        (FIRST, None, "lost"),
        (NONE, Attempt(1, NONE, NONE, ("bin",), 10), "nothing"),
    ],
)
def test_an_object_alone_is_where_it_was_dropped(
    lifted: frozenset[int], attempt: Attempt | None, expected: str
) -> None:
    assert place(Trial(STEPS, lifted, attempt)) == expected
