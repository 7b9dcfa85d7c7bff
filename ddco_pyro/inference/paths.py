"""Whole paths ζ = (b, h) of the latents: the most likely path of a demonstration, and draws from p(ζ | ξ).

A compiled forward pass in log space is followed by one step back after the other; O(D·S) a step. The forward pass
takes the maximum over predecessors, or their sum. The backward pass then takes the best predecessor, or draws one.
``messages`` and ``spread`` are those of :mod:`ddco_pyro.inference.kernel`, in logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.kernel import Structure, on_threads, releasing
from ddco_pyro.model.elementary import Array
from ddco_pyro.model.passes import Rows
from ddco_pyro.model.tables import Tables

jit = numba.njit(cache=True, error_model="numpy")


class Path(NamedTuple):
    """Choices h and terminations b of every level, lowest first, each int64 [..., N, T]; -1 past the lengths."""

    choices: tuple[Tensor, ...]
    terminations: tuple[Tensor, ...]


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
    rows = Rows(*(torch.cat([nothing, *(table.flatten(2) for table in group)], -1).numpy() for group in groups))
    others = rows, lengths.numpy(), best, uniforms, joint, terminated, possible, structure
    on_threads(lambda first, last: _trace_all(first, last, *others), lengths.numpy())
    refuse_impossible(torch.from_numpy(possible))
    within = joint >= 0
    return Path(
        tuple(torch.from_numpy(np.where(within, digit, -1)) for digit in structure.digits(joint)),
        tuple(torch.from_numpy(np.where(within, terminated > level, -1)) for level in range(tables.depth)),
    )


@jit
def _plus(first: float, second: float, best: bool) -> float:
    """The larger of two logarithms, or the logarithm of their sum."""
    larger, smaller = (first, second) if first >= second else (second, first)
    return larger if best or smaller == -np.inf else larger + np.log1p(np.exp(smaller - larger))


@jit
def _above(d: int, below: int, of: Structure) -> int:
    """The entry of level d + 1's message that holds an entry of level d's without its last choice."""
    return of.starts[d + 1] + (below - of.starts[d]) // of.sizes[d]


@jit
def _selected(t: int, d: int, below: int, rows: Rows, spread: Array, of: Structure) -> float:
    """log-mass that selects, at level d, the choice of message entry ``below``."""
    j, above = (below - of.starts[d]) % of.sizes[d], _above(d, below, of)
    first = of.callers[above]
    if first < 0:
        return spread[t, above] if j == 0 else -np.inf
    return spread[t, above] + rows.selection[t, first + j]


@jit
def _kept(t: int, d: int, below: int, rows: Rows, messages: Array, of: Structure) -> float:
    """log-mass that keeps, at level d, the choice of message entry ``below``; choice 0 never is kept."""
    j = (below - of.starts[d]) % of.sizes[d]
    return messages[t, below] + rows.termination[t, of.ends[d] + 2 * j - 2] if j > 0 else -np.inf


@jit
def _ended(t: int, d: int, below: int, rows: Rows, messages: Array, of: Structure) -> float:
    """log-mass that terminates, at level d, the choice of message entry ``below``; choice 0 always terminates."""
    j = (below - of.starts[d]) % of.sizes[d]
    return messages[t, below] + (rows.termination[t, of.ends[d] + 2 * j - 1] if j > 0 else 0.0)


@jit
def _forward(rows: Rows, best: bool, messages: Array, spread: Array, of: Structure) -> None:
    """Fill ``messages`` [1 + T, messages] and ``spread`` [T, messages] of one trajectory."""
    depth = len(of.sizes)
    messages[0] = -np.inf
    messages[0, of.starts[depth]] = 0.0  # at t = 0 everything is selected
    for t in range(len(spread)):
        for d in range(depth if t > 0 else 0):
            c, below = of.sizes[d], of.starts[d]
            for above in range(of.starts[d + 1], of.starts[d + 2]):
                total = messages[t, below]  # choice 0 lasts one step
                for j in range(1, c):
                    ended = messages[t, below + j] + rows.termination[t, of.ends[d] + 2 * j - 1]
                    total = _plus(total, ended, best)
                messages[t, above] = total
                below += c
        spread[t, of.starts[depth]] = messages[t, of.starts[depth]]
        for d in range(depth - 1, -1, -1):
            c, below = of.sizes[d], of.starts[d]
            for above in range(of.starts[d + 1], of.starts[d + 2]):
                mass, first = spread[t, above], of.callers[above]
                spread[t, below] = mass if first < 0 else mass + rows.selection[t, first]
                for j in range(1, c):
                    if first < 0:
                        spread[t, below + j] = -np.inf
                    else:
                        kept = messages[t, below + j] + rows.termination[t, of.ends[d] + 2 * j - 2]
                        spread[t, below + j] = _plus(kept, mass + rows.selection[t, first + j], best)
                below += c
        for s in range(len(of.actors)):
            actor = of.actors[s]
            messages[t + 1, s] = spread[t, s] + rows.control[t, actor] if actor >= 0 else -np.inf
            if rows.choice.shape[1]:
                messages[t + 1, s] += rows.choice[t, s]


@jit
def _pick(values: Array, best: bool, uniform: float) -> int:
    """The first of the largest logarithms, or a draw in proportion to their exponentials."""
    largest = 0
    for i in range(len(values)):
        if values[i] > values[largest]:
            largest = i
    if best:
        return largest
    total = 0.0
    for i in range(len(values)):
        total += np.exp(values[i] - values[largest])
    left = uniform * total
    for i in range(len(values)):
        left -= np.exp(values[i] - values[largest])
        if left < 0.0:
            return i
    return largest  # rounding left a little


@jit
def _keeps(kept: float, selected: float, best: bool, uniform: float) -> bool:
    """:func:`_pick` of two logarithms: whether the first is picked."""
    if best:
        return kept >= selected
    larger = max(kept, selected)
    first, second = np.exp(kept - larger), np.exp(selected - larger)
    return uniform * (first + second) < first


@jit
def _before(t: int, d: int, index: int, rows: Rows, messages: Array, best: bool, uniforms: Array, of: Structure) -> int:
    """The joint choice at t - 1, given entry ``index`` of level d + 1's message and termination of all levels to d."""
    for level in range(d, -1, -1):
        c = of.sizes[level]
        first = of.starts[level] + (index - of.starts[level + 1]) * c
        ways = np.empty(c)
        for j in range(c):
            ways[j] = _ended(t, level, first + j, rows, messages, of)
        index = first + _pick(ways, best, uniforms[len(of.sizes) + level])
    return index


@jit
def _back(
    rows: Rows, messages: Array, spread: Array, best: bool, uniforms: Array, joint: Array, terminated: Array,
    of: Structure,
) -> bool:  # fmt: skip
    """Fill ``joint`` [T] and the number of levels that ``terminated`` [T], from the last step to the first.

    Returns whether the path has a probability above 0.
    """
    depth, steps = len(of.sizes), len(spread)
    index = _pick(messages[steps, : of.starts[1]], best, uniforms[steps, 0])
    possible = messages[steps, index] > -np.inf
    for t in range(steps - 1, -1, -1):
        joint[t] = index
        ended = depth
        for d in range(depth):
            kept = _kept(t, d, index, rows, messages, of) if t > 0 else -np.inf
            selected = _selected(t, d, index, rows, spread, of)
            if kept > -np.inf and _keeps(kept, selected, best, uniforms[t, d]):
                ended = d
                break
            index = _above(d, index, of)
        terminated[t] = ended
        if t > 0:
            index = _before(t, ended - 1, index, rows, messages, best, uniforms[t], of)
    return bool(possible)


@releasing
def _trace_all(
    first: int, last: int, rows: Rows, lengths: Array, best: bool, uniforms: Array, joint: Array, terminated: Array,
    possible: Array, of: Structure,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill the ``joint`` choices [M, N, T] of M paths, and how many levels
    ``terminated`` before each.

    ``possible`` [N] says which trajectories have a probability above 0; the paths of others mean nothing.

    :param rows: logarithms, [N, T, n]; ``choice`` holds the evidence of the joint choices.
    :param best: the most likely path instead of a draw from the posterior.
    :param uniforms: numbers uniform in [0, 1), [M, N, 1 + T, 2·D].
    """
    for n in range(first, last):
        own = Rows(rows.selection[n], rows.termination[n], rows.control[n], rows.choice[n])
        messages, spread = np.empty((1 + lengths[n], of.starts[-1])), np.empty((lengths[n], of.starts[-1]))
        _forward(own, best, messages, spread, of)
        for m in range(len(joint)):
            possible[n] = _back(own, messages, spread, best, uniforms[m, n], joint[m, n], terminated[m, n], of)
