"""The classifier of grasp candidates: labelled images, its weights, and its precision on other images.

    python studies/bin_picking_candidates.py [--images 40] [--candidates 12] [--jobs 2]

An image is a pile of 3 to 8 objects; its labels are what came of simulated grasps, one after another from the same pile,
at points drawn on what is seen: a person would have marked them by hand. Writes the weights that the task reads
(``tasks/bin_picking/grasp_classifier.json``), and ``docs/results/bin_picking/candidates.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from ddco_tasks import psm
from ddco_tasks.bin_picking import camera, candidates, supervisor
from ddco_tasks.bin_picking.environment import load
from ddco_tasks.bin_picking.physics import MOVE_TIME, SETTLE_TIME, Physics
from joblib import Parallel, delayed
from provenance import record, sentence, text
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from ddco_pyro.data.files import write_text
from ddco_pyro.simulation.episodes import rate

OUT = Path("docs/results/bin_picking")
TRAINING, TESTING = 310_000, 320_000
"""Seeds of the first labelled image, and of the first other one."""
HAND = 0.0004
"""Standard deviation of where the gripper is put, in each direction (m)."""


def labelled(seed: int, count: int) -> dict[str, Any]:
    """Features [N, F] of the grasps drawn on one image, and how many objects each lifted [N]."""
    environment = load(seed)
    environment.reset()
    physics: Physics = environment.physics
    random = np.random.RandomState(seed)
    mask = camera.masks(physics)[..., 0]
    drawn = candidates.draw(mask, random, count)
    before, joints, numbers = physics.get_state(), physics.true_joints(), []
    for candidate in drawn:
        physics.set_state(before)
        physics.place_arm(joints, supervisor.JAW_OPEN)
        numbers.append(lifted(physics, candidate, random))
    environment.close()
    inputs = [candidates.features(mask, candidate) for candidate in drawn]
    return {"features": np.array(inputs), "lifted": np.array(numbers)}


def lifted(physics: Physics, candidate: candidates.Candidate, random: np.random.RandomState) -> int:
    """How many objects are held after a grasp with true kinematics was lifted and shown."""
    grasp = np.array([*candidate.pixel, 0.0, 0.0, np.cos(candidate.turn), np.sin(candidate.turn)])
    offset = HAND * random.standard_normal(3)
    for way_point in supervisor.grasp_plan(grasp):
        pose = psm.Pose(way_point.pose.rotation, way_point.pose.position + offset)
        physics.move_to(physics.command(psm.inverse(pose)), supervisor.JAW_OPEN * way_point.open, np.zeros(6))
        physics.step(round((MOVE_TIME + SETTLE_TIME) / physics.timestep()))
    return len(physics.held())
