"""Independent truth for the inference: every latent path of a small AHMM, one after another, in plain Python."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch

from ddco_pyro.model.tables import NEVER, Tables


def random_tables(
    counts: tuple[int, ...],
    hybrid: tuple[bool, ...],
    trajectories: int = 1,
    steps: int = 4,
    seed: int = 0,
) -> Tables:
    """Random normalised tables: ``counts`` options a level, lowest first; ``hybrid[d]`` says whether the callers of
    level d may emit control."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(trajectories, steps, *shape, generator=generator, dtype=torch.float64)

    callers = (*counts[1:], 1)
    selection, control = [], [2 * normal(counts[0])] if counts else []
    for level, (count, caller) in enumerate(zip(counts, callers, strict=False)):
        logits = normal(caller, 1 + count)
        if not hybrid[level]:
            logits[..., 0] = NEVER
        selection.append(logits.log_softmax(-1))
        control.append(2 * normal(caller) if hybrid[level] else torch.full((trajectories, steps, caller), NEVER))
    logits = [normal(count) for count in counts]
    termination = [torch.stack([(-x).sigmoid().log(), x.sigmoid().log()], -1) for x in logits]
    return Tables(tuple(selection), tuple(termination), tuple(control if counts else [normal(1)]))


@dataclass
class Truth:
    """Sums over every path of one trajectory; ``u``, ``v``, ``w``: [level][t][choice]."""

    log_likelihood: float
    best: tuple[tuple[int, ...], ...]
    u: list[np.ndarray] = field(default_factory=list)
    v: list[np.ndarray] = field(default_factory=list)
    w: list[np.ndarray] = field(default_factory=list)


def brute_force(tables: Tables, n: int, length: int) -> Truth:
    """p(ξ_n) and the marginals of §4.1 by summing over all (b, h) paths."""
    tables = Tables(
        *(tuple(t.detach() for t in part) for part in (tables.selection, tables.termination, tables.control))
    )
    sizes = [table.shape[-1] for table in tables.selection]
    shape = [(length, size) for size in sizes]
    u, v, w = ([np.zeros(s) for s in shape] for _ in range(3))
    total, by_path = 0.0, {}
    for path, ends, probability in paths(tables, n, length, sizes):
        total += probability
        by_path[path] = by_path.get(path, 0.0) + probability
        for t in range(length):
            for d, h in enumerate(path[t]):
                u[d][t, h] += probability
                v[d][t, h] += probability * ends[t][d]
                if t + 1 < length:
                    w[d][t, h] += probability * (1 - ends[t + 1][d])
    one_path = max(
        ((probability, path) for path, _, probability in paths(tables, n, length, sizes)), key=lambda item: item[0]
    )
    for table in (*u, *v, *w):
        table /= total
    return Truth(math.log(total), one_path[1], u, v, w)


Path = tuple[tuple[int, ...], ...]


def paths(tables: Tables, n: int, length: int, sizes: list[int]) -> Iterator[tuple[Path, Path, float]]:
    joint = list(itertools.product(*map(range, sizes)))
    ends = list(itertools.product((0, 1), repeat=len(sizes)))
    first = tuple(1 for _ in sizes)
    for path in itertools.product(joint, repeat=length):
        for later in itertools.product(ends, repeat=length - 1):
            b = (first, *later)
            probability = 1.0
            for t in range(length):
                probability *= _step(tables, n, t, path[t], b[t], path[t - 1] if t else None)
                if probability == 0.0:
                    break
            else:
                yield path, b, probability


def _step(
    tables: Tables, n: int, t: int, h: tuple[int, ...], b: tuple[int, ...], before: tuple[int, ...] | None
) -> float:
    probability = 1.0
    for d in range(len(h)):
        if before is not None:
            if d > 0 and b[d - 1] == 0:
                probability *= float(b[d] == 0)
            elif before[d] == 0:
                probability *= float(b[d] == 1)
            else:
                probability *= math.exp(tables.termination[d][n, t, before[d] - 1, b[d]])
        caller = h[d + 1] if d + 1 < len(h) else None
        if b[d] == 0:
            probability *= float(before is not None and h[d] == before[d])
        elif caller == 0:
            probability *= float(h[d] == 0)
        else:
            probability *= math.exp(tables.selection[d][n, t, 0 if caller is None else caller - 1, h[d]])
    return probability * math.exp(_control(tables, n, t, h))


def _control(tables: Tables, n: int, t: int, h: tuple[int, ...]) -> float:
    for d, choice in enumerate(h):
        if choice != 0:
            return float(tables.control[d][n, t, choice - 1])
    return float(tables.control[-1][n, t, 0])
