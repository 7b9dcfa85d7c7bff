"""Surgical bin picking: clear a foam bin of tangled pins, suturing needles and wires, each into its cup.

After the paper's second physical experiment (Physical Experiment 2 and SM 1.4). A da Vinci-like arm with
inexact encoders takes objects out of a bin, one grasp after another; in each control step it is given six
joint angles, or a pose of the gripper, and the jaw, moves there and settles. It is seen through its encoders
and through a stereo pair 650 mm above the bin. An episode is a whole bin. Simulated lengths are metres; what
is observed is in millimetres and pixels.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import dm_env
import numpy as np
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from ddco_pyro.simulation.task import Task

from .. import psm
from ..rendering import render
from . import camera, candidates, supervisor
from .controls import JOINTS, MATRIX, POSE, Controls, Scripted
from .geometry import CUPS, IMAGE_SIZE, NEUTRAL_TURN, in_bin, lying_at, upright
from .instrument import Instrument
from .objects import KINDS, UNSEEN, scene
from .physics import MOVE_TIME, SETTLE_TIME, Physics
from .shape import load_of
from .supervisor import JAW_OPEN, OVER_CUP
from .trials import MOST_STEPS, Attempt, End, Trials, most_attempts

HERE = Path(__file__).parent
FEWEST, MOST = 3, 8  # objects in a bin
# rad, m: standard deviations, 0.2 mm at the gripper
REPEATABILITY = np.array([6e-4, 6e-4, 1e-4, 2e-3, 2e-3, 2e-3])
# rad: standard deviation of the angle that the jaws' encoder reads, as the backlash of the wrist
JAW_ERROR = 0.01
LIFTED_HEIGHT = 0.018  # m: a gripper above this has lifted what it holds
BIN_SEEN = in_bin(lying_at(np.stack(np.meshgrid(*2 * [np.arange(IMAGE_SIZE, dtype=float)]), axis=-1)))
FRAME_SIZE = (360, 480)
SHARED_SOURCES = ("arm.py", "psm.py", "rendering.py", "vision.py")


class BinPicking(base.Task):
    """Starts, observes and rewards an episode; ``controls`` is the form of its controls.

    ``trials`` has what became of the attempts; of the trial at hand, ``remaining`` are the objects that were
    in no cup when it began, and ``lifted`` those that the jaws first lifted, None before.
    """

    def __init__(
        self, kinds: Sequence[str], random: np.random.RandomState, controls: Controls = JOINTS
    ) -> None:
        super().__init__(random=random)
        self.controls = controls
        self.trials = Trials(kinds)
        self.remaining = frozenset(range(len(kinds)))
        self.lifted: frozenset[int] | None = None
        self.jaw_open = True
        self._grasp = np.zeros(6)
        self._masks = np.zeros((IMAGE_SIZE, IMAGE_SIZE, len(camera.EYES)), np.uint8)
        self._jaw = JAW_OPEN

    def initialize_episode(self, physics: Physics) -> None:
        """The objects dropped into the bin, the gripper open over one of the cups."""
        cup = CUPS[("accept", "reject")[self.random.randint(2)]]
        pose = upright(NEUTRAL_TURN, np.array([*cup, OVER_CUP]))
        physics.place_arm(psm.inverse(pose), JAW_OPEN)
        physics.drop(self.random)
        self.trials = Trials(self.trials.kinds)
        self.jaw_open = self._was_open = True
        self._held: frozenset[int] = frozenset()
        self.lifted = None
        self.remaining = frozenset(range(physics.objects))
        self._see(physics)
        self._next_candidate()

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Set points [A]: what the encoders are to read, in the form of the task's controls, and the jaw,
        which opens above one half and closes otherwise.
        """
        del physics
        return self.controls.spec()

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Send the arm to where the encoders will read ``action`` [A], within the joints' limits."""
        spec = self.action_spec(physics)
        action = np.clip(np.asarray(action, float), spec.minimum, spec.maximum)
        self._held, self._was_open, self.jaw_open = physics.held(), self.jaw_open, bool(action[-1] > 0.5)
        noise = REPEATABILITY * self.random.standard_normal(6)
        physics.move_to(self.controls.joints(action), JAW_OPEN * self.jaw_open, noise)
        self.trials.steps += 1

    def after_step(self, physics: Physics) -> None:
        """See what became of the attempt, and whether the bin has ended."""
        self._see(physics)
        if not self.jaw_open and self.lifted is None and physics.gripper().position[2] > LIFTED_HEIGHT:
            self.lifted = physics.held()
        released = self.jaw_open and not self._was_open
        if released or self.trials.steps >= MOST_STEPS:
            self._end_trial(physics, released)
        self.trials.end = self.trials.end or _gone_wrong(physics)

    def _see(self, physics: Physics) -> None:
        self._masks = camera.masks(physics)
        self._jaw = physics.jaw() + JAW_ERROR * self.random.standard_normal()

    def _end_trial(self, physics: Physics, released: bool) -> None:
        places, lifted = physics.places(), self.lifted or frozenset()
        own = self._held if released else physics.held()
        held = own & (self.remaining | lifted)  # not what lies in a cup
        where = [places[number] for number in sorted(held)] or [physics.gripper_place()]
        found = tuple(where) if released else ()
        self.trials.add(Attempt(len(self.remaining), lifted, held, found, self.trials.steps))
        self.lifted = None
        self.remaining = frozenset(number for number, place in enumerate(places) if place not in CUPS)
        if not self.remaining:
            self.trials.end = End.CLEARED
        elif self.trials.missed():
            self.trials.end = End.MISSED
        else:
            self._next_candidate()

    def _next_candidate(self) -> None:
        """Draw the grasp of the next trial from what is seen in the bin."""
        left = np.where(BIN_SEEN, self._masks[..., 0], 0)
        candidate = candidates.sample(left, self.random)
        if candidate is None:
            self.trials.end = End.UNSEEN
            return
        right = camera.matched(self._masks, candidate.pixel)
        self._grasp = np.array([*candidate.pixel, *right, np.cos(candidate.turn), np.sin(candidate.turn)])

    def get_observation(self, physics: Physics) -> OrderedDict[str, np.ndarray]:
        """What cameras and encoders tell.

        ``image`` uint8 [72, 72, 2]: masks of the objects, 0 and 255, of the left and the right eye; ``grasp``
        [6]: the trial's candidate, column and row (pixels of 288) in the left and the right picture, cosine
        and sine of the gripper's turn; ``kin`` [7]: position (mm) and rotation vector (rad) of the gripper as
        the encoders give them, with kinematic error, and the angle between the jaws (rad), which an object
        holds open; ``load`` [18]: the shape in the part of the left mask that shows a load, at 288 pixels a
        side (:func:`ddco_tasks.bin_picking.shape.described`).
        """
        reported = psm.forward(physics.encoders())
        turn = psm.rotation_vector(reported.rotation)
        observation = OrderedDict()
        observation["image"] = camera.observed(self._masks)
        observation["grasp"] = self._grasp.copy()
        observation["kin"] = np.concatenate([reported.position * 1e3, turn, [self._jaw]])
        observation["load"] = load_of(self._masks[..., 0])
        return observation

    def get_reward(self, physics: Physics) -> float:
        """1 at the end of a bin that was cleared into the right cups, otherwise 0."""
        del physics
        return self.trials.measures()["success"]

    def get_termination(self, physics: Physics) -> float | None:
        """The episode ends when the bin is cleared, or has gone wrong."""
        del physics
        return None if self.trials.end is None else 0.0


def _gone_wrong(physics: Physics) -> End | None:
    if physics.unstable:
        return End.UNSTABLE
    held = physics.held()
    if any(place == "outside" and number not in held for number, place in enumerate(physics.places())):
        return End.LOST
    return End.FOAM if physics.pressed() else None


class Environment(control.Environment):
    """A dm-control environment that frees its simulation and renderer when closed."""

    def close(self) -> None:
        """Free the simulation; the environment cannot be used afterwards."""
        self.physics.free()


def outcome(environment: dm_env.Environment) -> dict[str, float]:
    """The measures of the bin that just ended (:meth:`ddco_tasks.bin_picking.trials.Trials.measures`)."""
    return dict(environment.task.trials.measures())


def frame(environment: dm_env.Environment) -> np.ndarray:
    """The scene in perspective, uint8 [360, 480, 3]."""
    return render(environment.physics, "overview", *FRAME_SIZE)


def load(
    seed: int, instrument: int = 1, controls: Controls = JOINTS, kinds: Sequence[str] | None = None
) -> Environment:
    """A fresh environment with objects and episodes by the seed alone, with the instrument of that number.

    :param kinds: of the objects; drawn where they are not given.
    """
    random = np.random.RandomState(seed)
    if kinds is None:
        drawn = random.randint(len(KINDS), size=random.randint(FEWEST, MOST + 1))
        kinds = [KINDS[number] for number in drawn]
    physics = Physics.from_xml_string(scene(HERE / "bin_picking.xml", kinds))
    physics.instrument = Instrument.numbered(instrument)
    sub_steps = round((MOVE_TIME + SETTLE_TIME) / physics.timestep())
    return Environment(physics, BinPicking(kinds, random, controls), n_sub_steps=sub_steps)


MEASURES = Trials(()).measures()
RATES = {"success", "cleared"}


def make_task(
    name: str, instrument: int = 1, controls: Controls = JOINTS, kinds: tuple[str, ...] | None = None
) -> Task:
    """The task with the instrument of that number, controls of that form, and objects of these kinds."""
    shared = (HERE.parent / name for name in SHARED_SOURCES)
    scripted = {"open_loop": supervisor.OpenLoop, "supervisor": supervisor.Supervisor}
    return Task(
        name=name,
        load=partial(load, instrument=instrument, controls=controls, kinds=kinds),
        policies={name: partial(Scripted, policy, controls) for name, policy in scripted.items()},
        outcome=outcome,
        frame=frame,
        steps=most_attempts(MOST) * MOST_STEPS,
        measures={key: "rate" if key in RATES or key.startswith("ended") else "mean" for key in MEASURES},
        sources=(HERE / "bin_picking.xml", candidates.WEIGHTS, *sorted(HERE.glob("*.py")), *shared),
    )


task = make_task("bin_picking")
other_instrument = make_task("bin_picking_other_instrument", instrument=2)
pose = make_task("bin_picking_pose", controls=POSE)
matrix = make_task("bin_picking_matrix", controls=MATRIX)
alone = {kind: make_task(f"bin_picking_{kind}", kinds=(kind,)) for kind in (*KINDS, *UNSEEN)}
"""The task with a single object in the bin, by its kind."""
