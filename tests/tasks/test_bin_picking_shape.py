"""The shape of a load: what is known of bars and squares by hand, and where the camera sees an object."""

from __future__ import annotations

import numpy as np
import pytest
from ddco_tasks.bin_picking import geometry, task
from ddco_tasks.bin_picking.shape import FEWEST, NAMES, REGION, described


def numbers(mask: np.ndarray) -> dict[str, float]:
    return dict(zip(NAMES, described(mask), strict=True))


@pytest.mark.parametrize("turned", [False, True])
def test_a_bar(turned: bool) -> None:
    """21 × 3 pixels from row 4 and column 10 on; lengths are between centres of pixels."""
    mask = np.zeros((40, 40), np.uint8)
    mask[4:7, 10:31] = 255
    found = numbers(mask.T if turned else mask)
    across, along = ((size**2 - 1) / 12 * 63 / 62 for size in (3, 21))  # variances of a sample of evenly spaced places
    rows, columns = [4, 5, 6], [10, 20, 30]
    (top, row, bottom), (left, column, right) = (columns, rows) if turned else (rows, columns)
    expected = {
        "area": 63, "inside": 40, "parts": 1, "largest part": 63, "spread across": across**0.5,
        "spread along": along**0.5, "hull": 40, "length": 20, "width": 2, "outline": 44, "solidity": 63 / 41,
        "column": column, "row": row, "left": left, "right": right, "top": top, "bottom": bottom,
        "slant": float(turned),
    }  # fmt: skip
    assert found == pytest.approx(expected, abs=1e-4)


def test_parts_are_counted_and_the_largest_is_named() -> None:
    mask = np.zeros((20, 20), np.uint8)
    mask[2:6, 2:6] = mask[10:13, 10:13] = mask[13, 13] = 1  # the last one touches by a corner
    found = numbers(mask)
    assert (found["area"], found["parts"], found["largest part"]) == (26, 2, 16)
    assert found["slant"] == pytest.approx(0.5**0.5)


def test_next_to_nothing_has_no_shape() -> None:
    mask = np.zeros((20, 20), np.uint8)
    mask[3, 3 : 3 + FEWEST - 1] = 255
    assert not described(mask).any()


def test_an_object_is_described_where_loads_are_shown_and_nowhere_else() -> None:
    environment = task.load(2)
    assert not environment.reset().observation["load"].any()  # the pile lies in the near part
    environment.physics.place_object(0, geometry.SHOWING, np.array([1.0, 0.0, 0.0, 0.0]))
    centre = environment.physics.centres()[0]
    environment.task.after_step(environment.physics)
    found = dict(zip(NAMES, environment.task.get_observation(environment.physics)["load"], strict=True))
    seen = [found["column"] + REGION[1].start, found["row"] + REGION[0].start]
    environment.close()
    assert found["area"] > 100
    np.testing.assert_allclose(seen, geometry.project(centre), atol=6.0)
