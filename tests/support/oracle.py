"""Independent truth for the inference: every latent path of a small AHMM, one by one, in plain Python."""

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

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
    """Random normalised tables: ``counts`` options a level, lowest first; ``hybrid[d]`` says whether the
    callers of level d may emit control."""
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
        never = torch.full((trajectories, steps, caller), NEVER)
        control.append(2 * normal(caller) if hybrid[level] else never)
    logits = [normal(count) for count in counts]
    termination = [torch.stack([(-x).sigmoid().log(), x.sigmoid().log()], -1) for x in logits]
    return Tables(tuple(selection), tuple(termination), tuple(control if counts else [normal(1)]))


@dataclass
class Predicted:
    """Of each joint choice: its probability before a control, and the control's log-density."""

    probability: dict[tuple[int, ...], float]
    log_density: dict[tuple[int, ...], float]

    @property
    def value(self) -> float:
        """log p(a_t | s_0..t, a_0..t-1)."""
        return math.log(sum(p * math.exp(self.log_density[h]) for h, p in self.probability.items()))


def predictions(tables: Tables, n: int, length: int) -> list[Predicted]:
    """Of each step of a trajectory, by summing over all paths up to it."""
    found, sizes = [], list(tables.sizes)
    for t in range(length):
        known = [table.clone() for table in tables.control]
        for table in known:
            table[:, t] = torch.where(table[:, t] > NEVER, 0.0, NEVER)
        weights: dict[tuple[int, ...], float] = {}
        for h, _, probability in paths(replace(tables, control=tuple(known)), n, t + 1, sizes):
            weights[h[-1]] = weights.get(h[-1], 0.0) + probability
        density = {h: log_density(_lists(tables, n), t, h) for h in weights}
        total = sum(weights.values())
        found.append(Predicted({h: weight / total for h, weight in weights.items()}, density))
    return found


@dataclass
class Truth:
    """Sums over every path of one trajectory; ``u``, ``v``, ``w``: [level][t][choice]."""

    log_likelihood: float
    u: list[np.ndarray] = field(default_factory=list)
    v: list[np.ndarray] = field(default_factory=list)
    w: list[np.ndarray] = field(default_factory=list)


def brute_force(tables: Tables, n: int, length: int) -> Truth:
    """p(ξ_n) and the marginals of §4.1 by summing over all (b, h) paths."""
    sizes = [table.shape[-1] for table in tables.selection]
    u, v, w = ([[[0.0] * size for _ in range(length)] for size in sizes] for _ in range(3))
    total = 0.0
    for path, ends, probability in paths(tables, n, length, sizes):
        total += probability
        for t in range(length):
            for d, h in enumerate(path[t]):
                u[d][t][h] += probability
                if ends[t][d]:
                    v[d][t][h] += probability
                if t + 1 < length and not ends[t + 1][d]:
                    w[d][t][h] += probability
    return Truth(math.log(total), *([np.array(table) / total for table in part] for part in (u, v, w)))


Choices = tuple[int, ...]
Path = tuple[Choices, ...]


def paths(tables: Tables, n: int, length: int, sizes: list[int]) -> Iterator[tuple[Path, Path, float]]:
    """Every possible (h, b) with its joint density; a step that follows another is looked up from then on."""
    joint = list(itertools.product(*map(range, sizes)))
    ends = list(itertools.product((0, 1), repeat=len(sizes)))
    known = _lists(tables, n)

    @functools.cache
    def following(t: int, before: tuple[int, ...] | None) -> list[tuple[Choices, Choices, float]]:
        steps = ((h, b) for h in joint for b in (ends if t else [(1,) * len(sizes)]))
        return [(h, b, p) for h, b in steps if (p := _step(known, t, h, b, before)) > 0]

    def walk(h: Path, b: Path, probability: float) -> Iterator[tuple[Path, Path, float]]:
        if len(h) == length:
            yield h, b, probability
            return
        for choices, ended, p in following(len(h), h[-1] if h else None):
            yield from walk((*h, choices), (*b, ended), probability * p)

    yield from walk((), (), 1.0)


def _lists(tables: Tables, n: int) -> Tables:
    """The tables of one trajectory as lists."""
    parts = (tables.selection, tables.termination, tables.control, tables.evidence)
    cut = (tuple(None if table is None else table[n].tolist() for table in part) for part in parts)
    return Tables(*cut, power=tables.power)


def _step(tables: Tables, t: int, h: Choices, b: Choices, before: Choices | None) -> float:
    probability = 1.0
    for d in range(len(h)):
        if before is not None:
            if d > 0 and b[d - 1] == 0:
                probability *= float(b[d] == 0)
            elif before[d] == 0:
                probability *= float(b[d] == 1)
            else:
                probability *= math.exp(tables.termination[d][t][before[d] - 1][b[d]])
        caller = h[d + 1] if d + 1 < len(h) else None
        if b[d] == 0:
            probability *= float(before is not None and h[d] == before[d])
        elif caller == 0:
            probability *= float(h[d] == 0)
        else:
            probability *= math.exp(tables.selection[d][t][0 if caller is None else caller - 1][h[d]])
    known = zip(tables.evidence, h, strict=False)
    evidence = sum(table[t][choice] for table, choice in known if table is not None)
    return probability * math.exp(tables.power * log_density(tables, t, h) + evidence)


def log_density(tables: Tables, t: int, h: tuple[int, ...]) -> float:
    """log π(a_t | h_t) of tables as lists of one trajectory."""
    for d, choice in enumerate(h):
        if choice != 0:
            return tables.control[d][t][choice - 1]
    return tables.control[-1][t][0]
