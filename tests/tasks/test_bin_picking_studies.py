"""What the studies of bin picking make of demonstrations and rates, on ones with planted trials."""

from __future__ import annotations

from bin_picking import criteria
from bin_picking_recovery import Load, Trial, counted
from ddco_tasks.bin_picking.trials import Attempt, Trials


def test_criteria_are_sums_over_bins() -> None:
    nothing = Trials(()).measures() | dict.fromkeys(("cleared", "success"), 0.0)
    first = nothing | {"cleared": 1, "attempts": 4, "single": 3, "due_recoveries": 2, "nothing": 1, "recovered": 2}
    second = nothing | {"attempts": 2, "single": 0, "due_recoveries": 2, "recovered": 1, "nothing_recovered": 0}
    found = criteria([first | {"nothing_recovered": 1}, second])
    assert found["success"] == (1, 2)
    assert found["grasp of exactly one"] == (3, 6)
    assert found["recovery, recall"] == (3, 4)
    assert found["recall where nothing is held"] == (1, 1)
    assert found["recall where several are"] == (2, 3)


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
