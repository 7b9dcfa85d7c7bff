"""Objects that no demonstration has shown: their geometry by hand, and what the jaws and gravity do with them."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from ddco_tasks import psm
from ddco_tasks.bin_picking import alone, geometry, objects
from ddco_tasks.bin_picking.environment import Environment


@pytest.fixture(params=objects.UNSEEN)
def environment(request: pytest.FixtureRequest) -> Iterator[Environment]:
    """A bin with one object of each kind in turn, after its reset."""
    environment = alone[request.param].load(0)
    environment.reset()
    yield environment
    environment.close()


def go(environment: Environment, height: float, jaw: float) -> None:
    """A control step that truly brings the gripper over the middle of the pile, across an object that lies along x."""
    joints = psm.inverse(geometry.upright(np.pi / 2, np.array([0.0, 0.012, height])))
    environment.step(np.append(environment.physics.command(joints), jaw))


def extent(environment: Environment) -> float:
    """From the highest to the lowest middle of what the object is made of (m)."""
    model, heights = environment.physics.model, environment.physics.data.geom_xpos[:, 2]
    own = model.geom_bodyid >= model.name2id("object_0", "body")
    return float(np.ptp(heights[own]))


def test_an_object_is_held_by_friction_and_only_the_thread_hangs_down(environment: Environment) -> None:
    physics = environment.physics
    (kind,) = environment.task.trials.kinds
    physics.place_object(0, np.array([0.0, 0.012, 0.0035]), np.array([1.0, 0.0, 0.0, 0.0]))
    for height, jaw in ((0.020, 1), (0.003, 1), (0.003, 0), (0.030, 0), (0.030, 0)):
        go(environment, height, jaw)
    assert physics.held() == {0}
    assert (extent(environment) > 0.008) == (kind == "thread")
    go(environment, 0.030, 1)
    assert physics.held() == frozenset()


@pytest.mark.parametrize("kind", objects.UNSEEN)
def test_they_are_of_the_size_of_the_others_and_none_is_one_of_them(kind: str) -> None:
    parts = objects.parts(kind)
    assert kind not in objects.KINDS
    for one, after in itertools.pairwise(parts):
        np.testing.assert_allclose(one.end, after.start, atol=1e-12)  # a chain
    length = sum(np.linalg.norm(part.end - part.start) for part in parts)
    assert 0.015 < length <= 0.030
    assert 0.001 <= 2 * parts[0].radius <= 0.003  # where there is no head
    assert max(part.radius for part in parts) < 0.003
