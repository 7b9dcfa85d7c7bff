"""The needle task against independent truths: MuJoCo's own poses, projected points, the paper's figures."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from ddco_tasks import planning, psm, vision
from ddco_tasks.needle import environment as needle
from ddco_tasks.needle import geometry
from ddco_tasks.needle import supervisor as needle_supervisor
from ddco_tasks.needle.environment import STEPS, Environment, task
from ddco_tasks.psm import Pose

AWAY = Pose(psm.rotation(2, 0.8), np.array([-0.015, -0.040, 0.045]))


@pytest.fixture
def environment() -> Iterator[Environment]:
    """The environment of seed 0, after its reset."""
    environment = task.load(0)
    environment.reset()
    yield environment
    environment.close()


def workspace(heights: tuple[float, ...] = (0.0, 0.01, 0.02, 0.03)) -> list[Pose]:
    """Upright gripper poses over the 10 x 10 cm workspace."""
    across = np.linspace(-0.05, 0.05, 9)
    turned, places = psm.rotation(2, np.pi / 4), itertools.product(across, across, heights)
    return [Pose(turned, np.array(place)) for place in places]


def lay(environment: Environment, x: float, y: float, heading: float, gripper: Pose) -> Pose:
    """Lay the needle on the mat with the gripper elsewhere; gives the needle's pose."""
    pose = Pose(psm.rotation(2, heading), np.array([x, y, geometry.WIRE_RADIUS]))
    with environment.physics.reset_context():
        environment.physics.place(psm.inverse(gripper), needle_supervisor.JAW_OPEN, pose)
    return pose


def command(pose: Pose, jaw: float) -> np.ndarray:
    """The action [7] that truly brings the gripper to ``pose``."""
    return np.append(psm.encoder_readings(psm.inverse(pose)), jaw)


def run(seed: int, policy_name: str) -> dict[str, float]:
    """The measures of an episode."""
    environment = task.load(seed)
    policy = task.policies[policy_name](environment)
    policy.reset(seed)
    step = environment.reset()
    while not step.last():
        step = environment.step(policy.act(step.observation))
    measures = task.outcome(environment)
    environment.close()
    assert step.reward == measures["success"]
    return measures


# Kinematics.


def test_forward_kinematics_is_mujocos(environment: Environment) -> None:
    generator = np.random.default_rng(0)
    low, high = psm.JOINT_RANGES.T
    physics = environment.physics
    for joints in generator.uniform(low, high, (20, 6)):
        with physics.reset_context():
            physics.named.data.qpos[list(psm.JOINTS)] = joints
        gripper = psm.forward(joints)
        np.testing.assert_allclose(gripper.position, physics.named.data.site_xpos["gripper"], atol=1e-7)
        rotation = physics.named.data.site_xmat["gripper"]
        np.testing.assert_allclose(gripper.rotation.ravel(), rotation, atol=1e-6)


def test_inverse_kinematics_is_the_inverse() -> None:
    generator = np.random.default_rng(1)
    for pose in workspace((0.0, 0.03)):
        tilt = psm.rotation(0, generator.uniform(-0.3, 0.3)) @ psm.rotation(1, generator.uniform(-0.3, 0.3))
        wanted = Pose(tilt @ psm.rotation(2, generator.uniform(-0.5, 1.5)), pose.position)
        reached = psm.forward(psm.inverse(wanted))
        np.testing.assert_allclose(reached.position, wanted.position, atol=1e-12)
        np.testing.assert_allclose(reached.rotation, wanted.rotation, atol=1e-12)


def test_kinematic_error_is_the_papers() -> None:
    error = [psm.forward(psm.true_joints(psm.inverse(pose))).position - pose.position for pose in workspace()]
    distance = 1e3 * np.linalg.norm(error, axis=1)
    assert np.sqrt(np.mean(distance**2)) == pytest.approx(3.3, abs=0.3)
    assert np.percentile(distance, 75) == pytest.approx(4.7, abs=0.4)


def test_reported_pose_is_where_the_encoders_were_sent(environment: Environment) -> None:
    wanted = Pose(psm.rotation(2, 0.7), np.array([-0.02, 0.01, 0.03]))
    observation = environment.step(np.append(psm.inverse(wanted), 0.4)).observation
    np.testing.assert_allclose(observation["gripper_pose"][:3], 1e3 * wanted.position, atol=0.8)
    np.testing.assert_allclose(observation["gripper_pose"][3:], [0.0, 0.0, 0.7], atol=0.03)
    true = environment.physics.gripper().position
    # kinematic error, which the report does not show
    assert 1e3 * np.linalg.norm(true - wanted.position) > 1.0


# Vision.


@pytest.mark.parametrize(
    ("x", "y", "heading"), [(-0.02, 0.0, -0.8), (-0.03, 0.015, -0.3), (-0.005, 0.01, -1.3)]
)
def test_ellipse_is_where_the_needle_is(environment: Environment, x: float, y: float, heading: float) -> None:
    pose = lay(environment, x, y, heading, AWAY)
    angles = np.linspace(-geometry.ARC_HALF_ANGLE, geometry.ARC_HALF_ANGLE, 181)
    arc = pose.apply(geometry.ARC_RADIUS * np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], axis=1))
    chord = arc[-1] - arc[0]
    seen = environment.task.get_observation(environment.physics)["needle_ellipse"]
    # within half a millimetre of the centre of the hull's ellipse: both on the axis
    centre = arc[:, :2].mean(axis=0)
    sideways = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord[:2])
    assert abs((seen[:2] - 1e3 * centre) @ chord[:2]) / np.linalg.norm(chord[:2]) < 0.3
    assert abs((seen[:2] - 1e3 * centre) @ sideways) < 1.5
    middle = geometry.lying_needle(seen).position
    np.testing.assert_allclose(middle[:2], pose.position[:2], atol=4e-4)
    angle = vision.principal_angle(seen, near=heading)
    assert np.rad2deg(abs(angle - np.arctan2(chord[1], chord[0]))) < 1.5
    assert seen[2] == pytest.approx(1e3 * np.linalg.norm(chord), abs=3.0)


def test_a_hidden_needle_keeps_its_last_ellipse(environment: Environment, monkeypatch) -> None:
    before = environment.task.get_observation(environment.physics)["needle_ellipse"]
    black = np.zeros((vision.IMAGE_SIZE, vision.IMAGE_SIZE, 3), np.uint8)
    monkeypatch.setattr(needle, "render", lambda *_: black)
    after = environment.task.get_observation(environment.physics)["needle_ellipse"]
    np.testing.assert_array_equal(before, after)


# Grasp and insertion.


def grasp_with_offset(environment: Environment, offset_mm: tuple[float, float, float] = (0, 0, 0)) -> bool:
    """Whether the needle comes up with a gripper off by (along the wire, across it, up) millimetres."""
    pose = lay(environment, -0.018, 0.004, geometry.MIDDLE_HEADING, AWAY)
    at = geometry.grasp_pose(pose)
    at = Pose(at.rotation, pose.apply(1e-3 * np.array(offset_mm)))
    for height, jaw in ((0.015, 0.42), (0.0, 0.42), (0.0, 0.0), (0.02, 0.0)):
        environment.step(command(needle_supervisor.raised(at, height), jaw))
    return bool(environment.physics.held() and environment.physics.needle().position[2] > 0.012)


ALIGNED = (0, 0, 0), (0, 1, 0), (0, -1, 0), (1.5, 0, 0), (0, 0, 0.7), (0, 0, -0.7)
MISPLACED = (0, 4, 0), (0, -4, 0), (0, 0, 4), (0, 0, -4), (0, 2.7, 0), (0, 0, 2.2), (13, 0, 0)


@pytest.mark.parametrize("offset", [*ALIGNED, *MISPLACED])
def test_aligned_jaws_alone_grasp(environment: Environment, offset: tuple[float, float, float]) -> None:
    assert grasp_with_offset(environment, offset) == (offset in ALIGNED)


def insert_with_offset(environment: Environment, sideways_mm: float, turn: float) -> dict[str, float]:
    """The measures after a true grasp and an insertion whose heading and height are off by these offsets."""
    assert grasp_with_offset(environment)
    target = environment.physics.target() + np.array([0.0, 1e-3 * sideways_mm, 0.0])
    into = geometry.insertion_pose(environment.physics.grip(), target)
    tip = environment.physics.grip().apply(geometry.TIP)
    turned = psm.rotation(2, turn) @ into.rotation
    into = Pose(turned, target - turned @ tip)
    for standoff in (-0.012, -0.004, 0.001, 0.006):
        environment.step(command(needle_supervisor.shifted(into, np.array([standoff, 0.0, 0.0])), 0.0))
    return task.outcome(environment)


@pytest.mark.parametrize(("offset", "success"), [(3.0, 1.0), (8.0, 0.0)], ids=["inside", "outside"])
def test_success_is_inside_the_target(environment: Environment, offset: float, success: float) -> None:
    measures = insert_with_offset(environment, offset, 0.0)
    assert (measures["inserted"], measures["success"]) == (1.0, success)
    assert measures["accuracy_mm"] == pytest.approx(offset, abs=0.6)


def test_a_flat_needle_is_turned_away(environment: Environment) -> None:
    measures = insert_with_offset(environment, 0.0, np.deg2rad(55.0))
    assert measures["inserted"] == measures["success"] == 0.0
    assert np.isnan(measures["accuracy_mm"])


def test_nothing_grasped_is_not_applicable(environment: Environment) -> None:
    for _ in range(STEPS):
        step = environment.step(np.append(needle_supervisor.HOME, 0.4))
    measures = task.outcome(environment)
    assert step.last()
    assert measures["grasped"] == measures["success"] == 0.0
    assert np.isnan(measures["inserted"])
    assert np.isnan(measures["accuracy_mm"])


# Policies.


def test_supervisor_succeeds_where_the_open_loop_plan_fails() -> None:
    seeds = range(5)
    assert all(run(seed, "supervisor")["success"] for seed in seeds)
    assert sum(run(seed, "open_loop")["success"] for seed in seeds) <= 2


def test_planned_paths_go_round_obstacles_and_repeat() -> None:
    ranges = np.array([[-1.0, 1.0]] * 3)

    def free(point: np.ndarray) -> bool:
        return not (abs(point[0]) < 0.2 and abs(point[1]) < 0.8)

    start, goal = np.array([-0.5, 0.0, 0.0]), np.array([0.5, 0.1, 0.0])
    path = planning.plan_path(start, goal, ranges, free)
    dense = planning.points_along(path, np.linspace(0, 1, 200))
    np.testing.assert_allclose(dense[[0, -1]], [start, goal], atol=1e-9)
    assert all(free(point) for point in dense)
    np.testing.assert_array_equal(path, planning.plan_path(start, goal, ranges, free))


def test_a_goal_in_an_obstacle_has_no_path() -> None:
    ranges = np.array([[-1.0, 1.0]] * 2)
    ends = np.array([-0.5, 0.0]), np.array([0.5, 0.0])
    with pytest.raises(planning.NoPath, match="goal of the path collides"):
        planning.plan_path(*ends, ranges, lambda point: bool(point[0] < 0.2))
