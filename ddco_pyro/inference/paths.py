"""Whole paths ζ = (b, h) of the latents: the most likely one given a demonstration, and draws from p(ζ | ξ)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.structure import Structure, structure_of
from ddco_pyro.inference.threads import as_many_threads_as_torch
from ddco_pyro.inference.trace import trace
from ddco_pyro.model.tables import Tables


class Path(NamedTuple):
    """Choices h and terminations b of every level, lowest first, each [..., N, T]; -1 past a trajectory's length."""

    choices: tuple[Tensor, ...]
    terminations: tuple[Tensor, ...]


def most_likely_path(tables: Tables, lengths: Tensor) -> Path:
    """argmax over ζ of p(ζ | ξ) (Viterbi), [N, T] for every level.

    Of equally likely paths it is the one that, followed back from the end, has the lowest last choice (of the highest
    level first), keeps its choices rather than selecting them anew, and comes from the lowest choice before.

    :raises BadTables: a trajectory has probability 0, so none of its paths is likelier than another.
    """
    path = _trace(tables, lengths, best=True, uniforms=np.zeros((1, len(lengths), _steps(tables) + 1, _two(tables))))
    return Path(tuple(h[0] for h in path.choices), tuple(b[0] for b in path.terminations))


def sample_paths(tables: Tables, lengths: Tensor, samples: int = 1, seed: int = 0) -> Path:
    """Independent draws from p(ζ | ξ), [samples, N, T] for every level.

    :raises BadTables: a trajectory has probability 0.
    """
    generator = np.random.default_rng(seed)
    uniforms = generator.random((samples, len(lengths), _steps(tables) + 1, _two(tables)))
    return _trace(tables, lengths, best=False, uniforms=uniforms)


def segment(tables: Tables, lengths: Tensor) -> tuple[Tensor, ...]:
    """The choices of :func:`most_likely_path`, a [N, T] per level, lowest first; -1 past the length.

    :raises BadTables: a trajectory has probability 0.
    """
    return most_likely_path(tables, lengths).choices


def _steps(tables: Tables) -> int:
    return tables.steps


def _two(tables: Tables) -> int:
    """Uniform numbers that a step back can need."""
    return 2 * tables.depth


def _trace(tables: Tables, lengths: Tensor, best: bool, uniforms: np.ndarray) -> Path:
    if not tables.depth:
        return Path((), ())
    structure = structure_of(tables)
    shape = (*uniforms.shape[:2], _steps(tables))
    joint, terminated = np.empty(shape, dtype=np.int64), np.empty(shape, dtype=np.int64)
    possible = np.ones(len(lengths), dtype=np.bool_)
    evidence = tables.joint_evidence()
    weight = np.empty((*shape[1:], 0)) if evidence is None else evidence.detach().flatten(2).numpy()
    with as_many_threads_as_torch():
        trace(
            _rows(tables.selection), _rows(tables.termination), _rows(tables.control), weight, lengths.numpy(), best,
            uniforms, joint, terminated, possible, structure.sizes, structure.starts, structure.selects, structure.ends,
            structure.actors,
        )  # fmt: skip
    refuse_impossible(torch.from_numpy(possible))
    return _path(structure, joint, terminated)


def _path(structure: Structure, joint: np.ndarray, terminated: np.ndarray) -> Path:
    alive = joint >= 0
    choices = tuple(torch.from_numpy(np.where(alive, digit, -1)) for digit in structure.digits(joint))
    levels = range(len(structure.sizes))
    terminations = tuple(torch.from_numpy(np.where(alive, terminated > level, -1)) for level in levels)
    return Path(choices, terminations)


def _rows(tables: Sequence[Tensor]) -> np.ndarray:
    """Each level's table, flattened and side by side, float64 [N, T, ...]."""
    rows: np.ndarray = torch.cat([table.detach().flatten(2).double() for table in tables], dim=-1).numpy()
    return rows
