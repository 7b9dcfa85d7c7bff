"""Draws of options from their posterior, and intervals of segment boundaries from draws."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ddco_pyro.errors import BadInput, check_whole, needing, refuse_unknown
from ddco_pyro.evaluation.inferred import Inferred, drawn, within
from ddco_pyro.statistics import matching

if TYPE_CHECKING:
    from xarray import DataTree


class Boundary(NamedTuple):
    """A boundary of the most likely path, and where draws have it.

    :param step: the first step of the new segment.
    :param low: the first step of the interval; ``high`` is its last. Both are ``step`` if no draw has it.
    :param probability: the share of draws that have the boundary.
    """

    step: int
    low: int
    high: int
    probability: float


@dataclass(frozen=True, eq=False)
class Draws:
    """Independent draws from p(ζ | ξ) of each demonstration, by forward filtering, backward sampling.

    :param options: choices by level, int8 [chain, draw, N, T]; −1 past a demonstration's end. A chain is a
        model: the fit, then those of ``fit --seeds`` with options numbered like the fit's (:func:`matched`).
    :param starts: whether an option, maybe the same as before, is selected, bool [chain, draw, N, T].
    :param log_likelihood: log p(ξ), nats, [chain, N].
    :param demonstrations: their names.
    :param names: the names of the choices by level, control first.
    :param seeds: the training seed of each chain.
    """

    options: Mapping[str, np.ndarray]
    starts: Mapping[str, np.ndarray]
    log_likelihood: np.ndarray
    demonstrations: tuple[str, ...]
    names: Mapping[str, Sequence[str]]
    seeds: tuple[int, ...]

    def boundaries(
        self,
        level: str,
        demonstration: int,
        path: np.ndarray,
        starts: np.ndarray | None = None,
        mass: float = 0.9,
    ) -> list[Boundary]:
        """The boundaries of a path of one demonstration, with their intervals over all draws of all chains.

        :param path: the options of the path [T], such as of ``fit.segment``.
        :param starts: the first steps of its segments, bool [T]; None: where the option changes.
        :param mass: as in :func:`~ddco_pyro.evaluation.inferred.within`.
        :raises BadInput: there is no such level, or ``mass`` is not a share.
        """
        refuse_unknown("level", level, self.options)
        if not 0 < mass <= 1:
            raise BadInput(f"mass={mass!r}: has to be a number above 0, at most 1")
        steps = len(path) if (path >= 0).all() else int(np.argmax(path < 0))
        options, chosen = (
            each[level][:, :, demonstration, :steps].reshape(-1, steps)
            for each in (self.options, self.starts)
        )
        if starts is None:
            starts, chosen = (np.diff(each[..., :steps], prepend=-1) != 0 for each in (path, options))
        every = drawn(path[:steps], np.asarray(starts[:steps], dtype=bool), options, chosen)
        return [Boundary(step, *within(at, step, mass), len(at) / len(options)) for step, at in every]

    def to_datatree(self) -> DataTree:
        """The draws as xarray's ``DataTree``, which ArviZ takes as inference data.

        ``posterior`` has a variable for each level with the dimensions chain, draw, demonstration and step;
        int8, −1 past a demonstration's end. The coordinate ``<level>_name`` has the names of choices 0 to k.
        In ``log_likelihood``, ``control`` is log p(ξ) in nats, by chain and demonstration.

        :raises BadInput: xarray is not installed.
        """
        with needing("xarray", "a DataTree"):
            import xarray
        chains, draws, _, steps = next(iter(self.options.values())).shape
        coordinates = {
            "chain": np.arange(chains),
            "draw": np.arange(draws),
            "demonstration": list(self.demonstrations),
            "step": np.arange(steps),
            "training_seed": ("chain", list(self.seeds)),
            **{f"{level}_name": (f"{level}_choice", list(names)) for level, names in self.names.items()},
        }
        dimensions = ("chain", "draw", "demonstration", "step")
        variables = {level: (dimensions, drawn) for level, drawn in self.options.items()}
        known = {key: coordinates[key] for key in ("chain", "demonstration", "training_seed")}
        likelihood = {"control": (("chain", "demonstration"), self.log_likelihood, {"units": "nats"})}
        posterior = xarray.Dataset(variables, coordinates)
        parts = {"posterior": posterior, "log_likelihood": xarray.Dataset(likelihood, known)}
        return xarray.DataTree.from_dict(parts)


def draw(
    models: Sequence[Iterable[Inferred]],
    names: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
    draws: int,
    seed: int,
) -> Draws:
    """Draws for the same demonstrations from each of several models.

    The draws of a demonstration depend on ``seed``, its place and the chain, not on the other demonstrations.

    :param models: the inference of each model.
    :param seeds: the training seed of each model.
    :raises BadInput: ``draws`` or ``seed`` is no such number.
    """
    check_whole("draws", draws, 1)
    check_whole("seed", seed)
    chains = [_chain(model, draws, (seed, number)) for number, model in enumerate(models)]
    demonstrations, _, first, ours = chains[0]
    shape = len(names), len(chains), draws, len(first), max(path.shape[-1] for path in first)
    options = np.full(shape, -1, dtype=np.int8 if max(map(len, names.values())) <= 128 else np.int16)
    starts = np.zeros(shape, dtype=bool)
    for number, (_, _, paths, active) in enumerate(chains):
        for level, order in enumerate(matched(ours, active, [len(own) for own in names.values()])):
            for n, (choices, ends) in enumerate(paths):
                options[level, number, :, n, : choices.shape[-1]] = order[choices[level]]
                starts[level, number, :, n, : choices.shape[-1]] = ends[level] == 1
    return Draws(
        dict(zip(names, options, strict=True)),
        dict(zip(names, starts, strict=True)),
        np.stack([values for _, values, _, _ in chains]),
        tuple(demonstrations),
        dict(names),
        tuple(seeds),
    )


def _chain(
    model: Iterable[Inferred], draws: int, seed: tuple[int, int]
) -> tuple[list[str], np.ndarray, list[np.ndarray], list[torch.Tensor]]:
    """The demonstrations and log p(ξ) under a model, with draws [2, D, draw, T] of choices and terminations.

    At last the posterior u of each demonstration, the levels' choices beside each other, [T, Σ (1 + k_d)].
    """
    names: list[str] = []
    paths: list[np.ndarray] = []
    values, active = [], []
    for piece in model:
        names += piece.names
        values.append(piece.log_likelihood)
        for n, length in enumerate(piece.lengths):
            paths.append(piece.draws(n, draws, (*seed, len(paths))))
            active.append(torch.cat([level[n, :length] for level in piece.posterior.u], dim=1))
    return names, np.concatenate(values), paths, active


def matched(
    ours: Sequence[torch.Tensor], theirs: Sequence[torch.Tensor], sizes: Sequence[int]
) -> list[np.ndarray]:
    """For each level, our number for each choice of another model.

    Options are matched one to one, so that the expected number of steps in which both models have the matched
    options is largest (Hungarian assignment). Choice 0 stays.

    :param ours: the posterior u of each demonstration, levels' choices beside each other, [T, Σ (1 + k_d)].
    :param sizes: 1 + k_d of each level.
    """
    together = torch.cat(list(ours)).T @ torch.cat(list(theirs))
    found, first = [], 0
    for size in sizes:
        both = together[first + 1 : first + size, first + 1 : first + size].numpy()
        found.append(np.concatenate([[0], 1 + matching(both)]))
        first += size
    return found
