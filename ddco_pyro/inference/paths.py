"""Whole paths ζ = (b, h) of the latents: the most likely path of a demonstration, and draws from p(ζ | ξ).

:mod:`ddco_pyro.inference.kernel` goes forward in logarithms, O(D·S) a step, and takes a path one step back
after the other, O(D + Σ C_d) a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference import kernel
from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.fused import numbers_of
from ddco_pyro.inference.kernel import Structure
from ddco_pyro.model.tables import Tables


class Path(NamedTuple):
    """Choices h and terminations b of each level, lowest first, int64 [..., N, T]; -1 past the lengths."""

    choices: tuple[Tensor, ...]
    terminations: tuple[Tensor, ...]


def most_likely_path(tables: Tables, lengths: Tensor) -> Path:
    """argmax over ζ of p(ζ | ξ) (Viterbi), [N, T] for every level.

    Ties are broken from the last step back. The lowest last choice wins, comparing the highest level first.
    Keeping a choice then wins over selecting it anew, and the lowest previous choice over others.

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> selection, ending = torch.tensor([0.0, 0.6, 0.4]).log(), torch.tensor([0.9, 0.1]).log()
    >>> density = torch.tensor([[[-1.0, -3], [-1, -3], [-9, -1], [-9, -1]]])
    >>> tables = Tables(
    ...     selection=(selection.expand(1, 4, 1, 3),),  # control, option 1, option 2
    ...     termination=(ending.expand(1, 4, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(density, torch.full((1, 4, 1), -torch.inf)),
    ... )
    >>> most_likely_path(tables, torch.tensor([4])).choices
    (tensor([[1, 1, 2, 2]]),)
    """
    path = _trace(
        tables, lengths, kernel.LARGEST, np.zeros((1, len(lengths), tables.steps + 1, 2 * tables.depth))
    )
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
    return _trace(tables, lengths, kernel.LOG_SUM, uniforms)


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


def predicted(tables: Tables, lengths: Tensor) -> Tensor:
    """log p(h_t | s_0..t, a_0..t-1) of each joint choice, float64 [N, T, C_D, ..., C_1]; 0 past the lengths.

    Controls before t count β times, evidence before t counts too.
    """
    found = torch.zeros(len(lengths), tables.steps, *reversed(tables.sizes), dtype=torch.float64)
    no_paths = np.empty((0, len(lengths), 0, 0))
    _recursion(tables, lengths, kernel.LOG_SUM, no_paths, found.flatten(2).numpy())
    return found


def _trace(tables: Tables, lengths: Tensor, semiring: int, uniforms: np.ndarray) -> Path:
    if not tables.depth:
        return Path((), ())
    structure = Structure.of(tables.sizes)
    joint, ended, possible = _recursion(tables, lengths, semiring, uniforms, np.empty((len(lengths), 0, 0)))
    refuse_impossible(torch.from_numpy(possible))
    joint, ended = joint.swapaxes(0, 1), ended.swapaxes(0, 1)
    digits = structure.choices.T - structure.choices[0][:, None]
    ends = (np.arange(tables.depth + 1) > level for level in range(tables.depth))
    return Path(
        tuple(
            torch.from_numpy(np.append(digit, -1)[joint]) for digit in digits
        ),  # -1, past the end, is the last entry
        tuple(torch.from_numpy(np.append(end.astype(np.int64), -1)[ended]) for end in ends),
    )


def _recursion(
    tables: Tables, lengths: Tensor, semiring: int, uniforms: np.ndarray, into: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint choices, ended levels and what is possible, by :func:`ddco_pyro.inference.kernel.trace`."""
    structure, uniforms = Structure.of(tables.sizes), np.ascontiguousarray(uniforms.swapaxes(0, 1))
    joint, ended = np.full((2, *uniforms.shape[:2], tables.steps), -1, dtype=np.int64)
    possible = np.empty(len(uniforms), dtype=np.bool_)
    controls = slice(structure.columns - 1 - sum(tables.sizes) + tables.depth, structure.columns)

    def some(first: int, last: int) -> None:
        longest, size, own = int(lengths[first:last].max()), structure.entries, slice(first, last)
        its = tables.part(torch.arange(first, last), longest).normalised()
        each = [table.T for table in numbers_of(its)]  # the numbers of a step side by side
        columns = sum(table.shape[-1] for table in each)
        rows = np.concatenate(each, -1, kernel.memory("rows", last - first, longest, columns))
        rows[..., controls] *= tables.power
        room = np.empty((longest + 1, size)), np.empty((longest, size))
        kernel.trace(
            semiring, lengths[own].numpy(), rows, uniforms[own], into[own], joint[own],
            ended[own], possible[own], *room, structure.columns, *structure.tables,
        )  # fmt: skip

    kernel.on_threads(some, len(lengths), int(lengths.sum()))
    return joint, ended, possible
