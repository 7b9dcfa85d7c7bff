"""Whole paths ζ = (b, h) of the latents: the most likely path of a demonstration, and draws from p(ζ | ξ).

A compiled forward pass in log space takes the maximum over predecessors, or their sum; O(D·S) a step. It leaves the
probabilities of each step back, given the choices after it: 0 or 1 for the best path. A path then takes one step back
after the other, without logarithms; O(D + Σ C_d) a step. ``messages`` and ``spread`` are rows of those of
:mod:`ddco_pyro.inference.kernel`, in logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.kernel import Structure, on_threads, releasing
from ddco_pyro.model.elementary import Array, jit
from ddco_pyro.model.tables import Tables


class Path(NamedTuple):
    """Choices h and terminations b of every level, lowest first, each int64 [..., N, T]; -1 past the lengths."""

    choices: tuple[Tensor, ...]
    terminations: tuple[Tensor, ...]


class Rows(NamedTuple):
    """Logarithms of every step: tables of all levels side by side, [N, T, n].

    :param choice: the evidence of the joint choices; no columns where there is none.
    """

    selection: Array
    termination: Array
    control: Array
    choice: Array


def most_likely_path(tables: Tables, lengths: Tensor) -> Path:
    """argmax over ζ of p(ζ | ξ) (Viterbi), [N, T] for every level.

    Ties are broken from the last step back. The lowest last choice wins, comparing the highest level first. Keeping
    a choice then wins over selecting it anew, and the lowest previous choice over others.

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> selection, ending = torch.tensor([0.0, 0.6, 0.4]).log(), torch.tensor([0.9, 0.1]).log()
    >>> tables = Tables(
    ...     selection=(selection.expand(1, 4, 1, 3),),  # control, option 1, option 2
    ...     termination=(ending.expand(1, 4, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(torch.tensor([[[-1.0, -3], [-1, -3], [-9, -1], [-9, -1]]]), torch.full((1, 4, 1), -torch.inf)),
    ... )
    >>> most_likely_path(tables, torch.tensor([4])).choices
    (tensor([[1, 1, 2, 2]]),)
    """
    path = _trace(tables, lengths, best=True, uniforms=np.zeros((1, len(lengths), tables.steps + 1, 2 * tables.depth)))
    return Path(tuple(h[0] for h in path.choices), tuple(b[0] for b in path.terminations))


def sample_paths(tables: Tables, lengths: Tensor, samples: int = 1, seed: int | Sequence[int] = 0) -> Path:
    """Independent draws from p(ζ | ξ), [samples, N, T] for every level.

    :param lengths: steps of each trajectory, int64 [N].
    :param seed: a number from 0 on, or several.
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> always = torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 3, 1, 3), torch.tensor([0.0, 1.0]).log()
    >>> controls = torch.tensor([[[0.0, -9], [-9, 0], [0, -9]]]), torch.full((1, 3, 1), -torch.inf)
    >>> tables = Tables((always[0],), (always[1].expand(1, 3, 2, 2),), controls)
    >>> sample_paths(tables, torch.tensor([3]), samples=2).choices
    (tensor([[[1, 2, 1]],
    <BLANKLINE>
            [[1, 2, 1]]]),)
    """
    uniforms = np.random.default_rng(seed).random((samples, len(lengths), tables.steps + 1, 2 * tables.depth))
    return _trace(tables, lengths, best=False, uniforms=uniforms)


def segment(tables: Tables, lengths: Tensor) -> tuple[Tensor, ...]:
    """The choices of :func:`most_likely_path`, [N, T] for every level, lowest first; -1 past the lengths.

    >>> from ddco_pyro.model.batch import encode
    >>> batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
    >>> ddco_pyro.inference.segment(fit.hierarchy.tabulate(batch), batch.lengths)[0].shape
    torch.Size([6, 10])

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.
    """
    return most_likely_path(tables, lengths).choices


def _trace(tables: Tables, lengths: Tensor, best: bool, uniforms: np.ndarray) -> Path:
    if not tables.depth:
        return Path((), ())
    structure = Structure.of(tables.sizes)
    joint, terminated = np.full((2, *uniforms.shape[:2], tables.steps), -1, dtype=np.int64)
    possible = np.ones(len(lengths), dtype=np.bool_)
    *levels, meta_policy = tables.control
    evidence = tables.joint_evidence()
    groups = tables.selection, tables.termination, (meta_policy, *levels), () if evidence is None else (evidence,)
    nothing = torch.empty(len(lengths), tables.steps, 0, dtype=torch.float64)
    rows = Rows(
        *(torch.cat([nothing, *(table.detach().flatten(2) for table in group)], -1).numpy() for group in groups)
    )
    others = rows, lengths.numpy(), best, uniforms, joint, terminated, possible, structure

    def some(first: int, last: int) -> None:
        room = np.empty((2, tables.steps + 1, structure.starts[-1]))
        _trace_all(first, last, *others, *room)

    on_threads(some, lengths.numpy())
    refuse_impossible(torch.from_numpy(possible))
    digits = structure.digits(np.arange(len(structure.actors)))
    ended = [np.arange(tables.depth + 1) > level for level in range(tables.depth)]
    return Path(
        tuple(torch.from_numpy(np.append(digit, -1)[joint]) for digit in digits),  # -1, past the end, is the last entry
        tuple(torch.from_numpy(np.append(each.astype(np.int64), -1)[terminated]) for each in ended),
    )


@jit
def _plus(first: float, second: float, best: bool) -> float:
    """The larger of two logarithms, or the logarithm of their sum."""
    larger, smaller = (first, second) if first >= second else (second, first)
    return larger if best or smaller == -np.inf else larger + np.log1p(np.exp(smaller - larger))


@jit
def _cumulative(values: Array, best: bool) -> float:
    """Make logarithms a distribution function, and return the logarithm of their sum; of the maximum, for ``best``.

    A number uniform in [0, 1) draws the first entry above it. Zero draws the first of the largest, for ``best``.
    """
    total = -np.inf
    for i in range(len(values)):
        total = _plus(total, values[i], best)
        values[i] = total
    for i in range(len(values)):
        values[i] = np.exp(values[i] - total) if not best else 1.0 if values[i] == total else 0.0
    return total


@jit
def _share(first: float, second: float, best: bool) -> float:
    """The part of the first of two logarithms in their sum; 1 or 0 for ``best``."""
    if first == -np.inf:
        return 0.0
    if best:
        return 1.0 if first >= second else 0.0
    return 1.0 / (1.0 + np.exp(second - first))


@jit
def _forward(n: int, steps: int, rows: Rows, best: bool, keeps: Array, ways: Array, of: Structure) -> float:
    """Fill ``keeps`` and ``ways``, both [1 + T, messages], of trajectory n; returns log p(ξ), or the best path's.

    keeps[t] has, for each entry of a level's message, the probability that its last choice was kept at t, not selected.
    ways[t] has, for the choices of each level below one entry, the distribution function of the choice that terminated
    at t. The first entries of ways[T] are the distribution function of the last joint choice.
    """
    depth, weighted = len(of.sizes), rows.choice.size > 0
    messages, spread = ways[steps], keeps[steps]  # rows that nothing else needs before the end
    for i in range(len(messages)):
        messages[i] = -np.inf
    messages[of.starts[depth]] = 0.0  # at t = 0 everything is selected
    for t in range(steps):
        for i in range(len(messages)):
            keeps[t, i] = 0.0
        for d in range(depth if t > 0 else 0):
            c, below = of.sizes[d], of.starts[d]
            for above in range(of.starts[d + 1], of.starts[d + 2]):
                ways[t, below] = messages[below]  # choice 0 lasts one step
                for j in range(1, c):
                    ways[t, below + j] = messages[below + j] + rows.termination[n, t, of.ends[d] + 2 * j - 1]
                messages[above] = _cumulative(ways[t, below : below + c], best)
                below += c
        spread[of.starts[depth]] = messages[of.starts[depth]]
        for d in range(depth - 1, -1, -1):
            c, below = of.sizes[d], of.starts[d]
            for above in range(of.starts[d + 1], of.starts[d + 2]):
                mass, first = spread[above], of.callers[above]
                spread[below] = mass if first < 0 else mass + rows.selection[n, t, first]
                for j in range(1, c):
                    if first < 0:
                        spread[below + j] = -np.inf
                    else:
                        kept = -np.inf
                        if t > 0:
                            kept = messages[below + j] + rows.termination[n, t, of.ends[d] + 2 * j - 2]
                        selected = mass + rows.selection[n, t, first + j]
                        spread[below + j] = _plus(kept, selected, best)
                        keeps[t, below + j] = _share(kept, selected, best)
                below += c
        for s in range(len(of.actors)):
            actor = of.actors[s]
            messages[s] = spread[s] + rows.control[n, t, actor] if actor >= 0 else -np.inf
            if weighted:
                messages[s] += rows.choice[n, t, s]
    return _cumulative(ways[steps, : of.starts[1]], best)


@jit
def _pick(distribution: Array, uniform: float) -> int:
    """The first entry of a distribution function above ``uniform``."""
    for i in range(len(distribution)):
        if uniform < distribution[i]:
            return i
    return 0  # of a path that has probability 0


@jit
def _back(
    steps: int, keeps: Array, ways: Array, uniforms: Array, joint: Array, terminated: Array, of: Structure
) -> None:
    """Fill ``joint`` [T] and the number of levels that ``terminated`` [T], from the last step to the first."""
    depth = len(of.sizes)
    index = _pick(ways[steps, : of.starts[1]], uniforms[steps, 0])
    for t in range(steps - 1, -1, -1):
        joint[t] = index
        ended = 0
        while ended < depth and not uniforms[t, ended] < keeps[t, index]:
            index = of.starts[ended + 1] + (index - of.starts[ended]) // of.sizes[ended]
            ended += 1
        terminated[t] = ended
        for d in range(ended - 1 if t > 0 else -1, -1, -1):
            first = of.starts[d] + (index - of.starts[d + 1]) * of.sizes[d]
            index = first + _pick(ways[t, first : first + of.sizes[d]], uniforms[t, depth + d])


@releasing
def _trace_all(
    first: int, last: int, rows: Rows, lengths: Array, best: bool, uniforms: Array, joint: Array, terminated: Array,
    possible: Array, of: Structure, keeps: Array, ways: Array,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill the ``joint`` choices [M, N, T] of M paths, and how many levels
    ``terminated`` before each.

    ``possible`` [N] says which trajectories have a probability above 0; the paths of others mean nothing.

    :param best: the most likely path instead of a draw from the posterior.
    :param uniforms: numbers uniform in [0, 1), [M, N, 1 + T, 2·D].
    :param keeps: room for :func:`_forward`; ``ways`` likewise.
    """
    for n in range(first, last):
        steps = lengths[n]
        possible[n] = _forward(n, steps, rows, best, keeps, ways, of) > -np.inf
        for m in range(len(joint)):
            _back(steps, keeps, ways, uniforms[m, n], joint[m, n], terminated[m, n], of)
