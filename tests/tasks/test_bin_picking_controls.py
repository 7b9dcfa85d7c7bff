"""The forms of bin picking's controls against independent truths: what encoders read, OpenCV, polar parts."""

import cv2
import numpy as np
import pytest
from ddco_tasks import psm
from ddco_tasks.bin_picking import geometry, task
from ddco_tasks.bin_picking.controls import JOINTS, MATRIX, POSE, Controls, nearest_rotation
from ddco_tasks.bin_picking.shape import FEWEST, NAMES, REGION, described
from scipy import linalg
from scipy.spatial.transform import Rotation

FORMS = {"joints": JOINTS, "pose": POSE, "matrix": MATRIX}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_control_says_the_joints_that_it_was_made_of(form: Controls) -> None:
    generator = np.random.default_rng(0)
    for _ in range(20):
        place = generator.uniform([-0.06, -0.02, 0.0], [0.06, 0.04, 0.04])
        joints = psm.inverse(geometry.upright(generator.uniform(-0.8, 2.4), place))
        control = form.control(np.append(joints, 1.0))
        form.spec().validate(control)
        np.testing.assert_allclose(form.joints(control), joints, atol=1e-9)


def test_poses_are_position_and_opencvs_rotation_vector_or_matrix() -> None:
    joints = np.array([0.2, -0.1, 0.15, 0.4, 0.3, -0.2])
    pose = psm.forward(joints)
    np.testing.assert_allclose(POSE.of_joints(joints)[:3], 1e3 * pose.position)
    np.testing.assert_allclose(cv2.Rodrigues(POSE.of_joints(joints)[3:])[0], pose.rotation, atol=1e-12)
    np.testing.assert_allclose(MATRIX.of_joints(joints)[3:].reshape(3, 3), pose.rotation)


def test_the_nearest_rotation_is_the_polar_factor_or_beats_all_others() -> None:
    generator = np.random.default_rng(1)
    others = Rotation.random(2000, random_state=2).as_matrix()
    for sign in (1.0, -1.0):
        matrix = generator.standard_normal((3, 3))
        matrix *= sign * np.sign(np.linalg.det(matrix))
        nearest = nearest_rotation(matrix)
        np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(nearest) > 0
        assert np.linalg.norm(others - matrix, axis=(1, 2)).min() > np.linalg.norm(nearest - matrix)
        if sign > 0:
            np.testing.assert_allclose(nearest, linalg.polar(matrix)[0], atol=1e-12)


# --- the shape of a load ------------------------------------------------------------------------------------


def numbers(mask: np.ndarray) -> dict[str, float]:
    return dict(zip(NAMES, described(mask), strict=True))


@pytest.mark.parametrize("turned", [False, True])
def test_a_bar(turned: bool) -> None:
    """21 × 3 pixels from row 4 and column 10 on; lengths are between centres of pixels."""
    mask = np.zeros((40, 40), np.uint8)
    mask[4:7, 10:31] = 255
    found = numbers(mask.T if turned else mask)
    # variances of a sample of evenly spaced places
    across, along = ((size**2 - 1) / 12 * 63 / 62 for size in (3, 21))
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
