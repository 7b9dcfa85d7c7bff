"""The model run forward: its sites, what its samples may be and how often, and the tables it is made of."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.inference.engines import known_controls
from ddco_pyro.model.ahmm import ahmm
from ddco_pyro.model.tables import NEVER, Tables, complete

SAMPLES = 4000


def run_forward(tables, lengths, seed=0):
    """The trace of one run of the model."""
    pyro.set_rng_seed(seed)
    trace = pyro.poutine.trace(ahmm).get_trace(complete(tables, lengths), *known_controls(tables))
    trace.compute_log_prob()
    return trace


def latents(trace, depth, steps):
    """Choices h [N, T, D] and terminations b [N, T, D] of a trace, 1 for the b that the first step lacks."""
    nodes = trace.nodes
    choices = [[nodes[f"h_{d}_{t}"]["value"] for d in range(1, depth + 1)] for t in range(steps)]
    ends = [[nodes[f"b_{d}_{t}"]["value"] for d in range(1, depth + 1)] for t in range(1, steps)]
    ends.insert(0, [torch.ones_like(choices[0][0])] * depth)
    return tuple(torch.stack([torch.stack(step, -1) for step in part], 1) for part in (choices, ends))


def repeated(tables, times):
    """The first trajectory's tables, that many times."""
    parts = (tables.selection, tables.termination, tables.control)
    return Tables(*(tuple(table[:1].expand(times, *table.shape[1:]) for table in part) for part in parts))


CASES = [((2,), (True,), 4), ((2, 2), (False, True), 3), ((1, 1, 1), (True, True, True), 3)]


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_latents_are_as_frequent_as_the_sum_over_paths_says(counts, hybrid, steps):
    """Controls of density 1 tell nothing, so what is sampled has the marginals of the prior."""
    tables = random_tables(counts, hybrid, steps=steps, seed=7)
    silent = replace(tables, control=tuple(torch.where(c == NEVER, c, 0.0) for c in tables.control))
    truth = brute_force(silent, 0, steps)
    assert truth.log_likelihood == pytest.approx(0, abs=1e-12)
    h, b = latents(run_forward(repeated(silent, SAMPLES), torch.full((SAMPLES,), steps)), len(counts), steps)
    for d in range(len(counts)):
        chosen = torch.nn.functional.one_hot(h[..., d], 1 + counts[d]).double()
        found = {"u": chosen.mean(0), "v": (chosen * b[..., d, None]).mean(0)}
        found["w"] = (chosen[:, :-1] * (1 - b[:, 1:, d, None])).mean(0)
        expected = {"u": truth.u[d], "v": truth.v[d], "w": truth.w[d][:-1]}
        for name, p in expected.items():
            error = np.sqrt(p * (1 - p) / SAMPLES)
            assert (np.abs(found[name].numpy() - p) <= 4.5 * error + 1e-12).all(), (name, d, found[name], p)
