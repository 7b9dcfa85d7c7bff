"""Random hierarchies of linear networks, which EM trains, with every kind of control."""

import numpy as np
import torch
from hierarchies import make_batch, make_hierarchy
from planted import LINEAR

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.inference import log_likelihood
from ddco_pyro.model.batch import Batch

EVERYTHING = ("levels.", "meta_policy.")
CONSTANT = {"network": "constant"}
LEARNED = {"learn": True, "floor": 0.01}
CLIPPED = (ControlPart("arm", (0, 1), "clipped", (-0.8, -np.inf), (0.9, 1.0)),)
JAW = ControlPart("jaw", (1,), "binary", (0.0,), (1.0,))
MIXED = (ControlPart("arm", (0,), "clipped", (-0.8,), (0.9,)), JAW)
OF_VALUES = ControlPart("action", (0,), "categorical", values=(0.0, 1.0, 2.0))
ACTIONS = (OF_VALUES, ControlPart("b", (1,), "gaussian"))
STUDENT = (ControlPart("arm", (0, 1), "student"),)
HURDLE = (ControlPart("stop", (0, 1), "hurdle", (-np.inf, -np.inf), (np.inf, np.inf), exact=(0.0, 0.0)),)


def batch_for(parts, trajectories=12, steps=9):
    """Random steps whose controls can be of these kinds, and are often on a bound or at a value."""
    batch = make_batch(trajectories, steps)
    actions, state = batch.actions.clone(), batch.inputs.vectors["state"]
    for part in parts or ():
        for place, dim in enumerate(part.dims):
            drawn = actions[..., dim] + state[..., dim]
            if part.kind == "clipped":
                actions[..., dim] = drawn.clamp(part.low[place], part.high[place])
            elif part.kind == "binary":
                actions[..., dim] = (drawn > 0).float()
            elif part.kind == "categorical":
                actions[..., dim] = (drawn + 1).round().clamp(0, 2)
            elif part.kind == "student":
                actions[..., dim] = drawn + batch.actions[..., 0] ** 3
            elif part.kind == "hurdle":
                actions[..., dim] = torch.where(state[..., 2] > 0.3, 0.0, drawn)
    return Batch(batch.inputs, actions, batch.lengths)


def in_double(batch):
    inputs = batch.inputs.map(torch.Tensor.double, batch.inputs.time)
    return Batch(inputs, batch.actions.double(), batch.lengths)


def linear(counts, parts=None, emits=("options",), memoryless=(), above=LINEAR, lowest=LINEAR, **control):
    """A random hierarchy of linear networks over three features, with these kinds of control.

    ``lowest`` are the policies that act, ``above`` all other networks.
    """
    return make_hierarchy(counts, emits, above, 0, memoryless, above, lowest, parts, steps=9, **control)


def score(tables, piece, rows=None):
    return log_likelihood(tables, piece.lengths).sum()
