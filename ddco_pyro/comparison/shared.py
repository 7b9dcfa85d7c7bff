"""The held-out demonstrations that runs share; runs that share none cannot be compared, and are told why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ddco_pyro.data.controls import difference
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import same
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.training.data import parts


class NotShared(BadInput):
    """Runs that were not held out on the same data; one line with the two runs and what is different."""


@dataclass(frozen=True)
class Held:
    """A run and log p(ξ) of each of its held-out demonstrations, in the order of ``names``."""

    run: str
    fit: Fit
    names: tuple[str, ...]
    steps: tuple[int, ...]
    values: np.ndarray


def held_out(fits: Sequence[Fit]) -> list[Held]:
    """Every run on the held-out demonstrations that all of them share.

    :raises NotShared: a run held nothing out, its demonstrations are no longer those it was fitted to, or the others
        held out others, or score other dimensions of the control.
    """
    own = [_own(fit) for fit in fits]
    for fit, demos in zip(fits[1:], own[1:], strict=True):
        _check_same(fits[0], own[0], fit, demos)
        _check_dimensions(fits[0], fit)
    return [_held(fit, demos.select(own[0].names)) for fit, demos in zip(fits, own, strict=True)]


def _own(fit: Fit) -> Demonstrations:
    """What a run held out."""
    split = parts(fit.spec, fit.demonstrations)
    if "valid" not in split:
        raise NotShared(f"{fit}: held nothing out (demonstrations.valid_fraction: 0); there is nothing to compare")
    return split["valid"]


def _check_same(first: Fit, ours: Demonstrations, second: Fit, theirs: Demonstrations) -> None:
    """Held-out demonstrations have the same names, controls, and observations where both runs see them."""
    lead = f"{first} and {second} were not held out on the same data"
    only = sorted(set(ours.names) ^ set(theirs.names))
    if only:
        where = first if only[0] in ours.names else second
        remedy = "fit both with the same demonstrations, valid_fraction and seed"
        raise NotShared(f"{lead}: {only[0]} was held out by {where} alone; {remedy}")
    for mine, yours in zip(ours, theirs.select(ours.names), strict=True):
        different = _different(mine, yours)
        if different:
            raise NotShared(f"{lead}: {mine.name} has other {different}; fit both to the same demonstrations")


def _check_dimensions(first: Fit, second: Fit) -> None:
    """Both likelihoods are of the same control dimensions (constant ones are no part of a model), in one measure."""
    ours, theirs = (set(fit.hierarchy.scaling.varying.tolist()) for fit in (first, second))
    if ours != theirs:
        dimension = min(ours ^ theirs)
        scored, left = (first, second) if dimension in ours else (second, first)
        raise NotShared(
            f"{first} and {second} score different things: control dimension {dimension} is in the "
            f"likelihood of {scored} and not in that of {left}; fit both to the same demonstrations, "
            "with the same version"
        )
    if different := difference(first.hierarchy.scaling.parts, second.hierarchy.scaling.parts):
        raise NotShared(
            f"{first.folder} and {second.folder} measure different things: {different}; densities and probabilities "
            "cannot be ranked, so fit both with the same control.kind"
        )


def _different(mine: Demonstration, yours: Demonstration) -> str:
    """What two demonstrations differ in, among what both have; nothing where they are the same."""
    both = [key for key in mine.observations if key in yours.observations]
    arrays = {f"obs/{key}": (mine.observations[key], yours.observations[key]) for key in both}
    arrays["actions"] = (mine.actions, yours.actions)
    return ", ".join(key for key, (left, right) in arrays.items() if not same(left, right))


def _held(fit: Fit, demos: Demonstrations) -> Held:
    values = fit.log_likelihood(demos)
    for name, value in zip(demos.names, values, strict=True):
        if not fit.was_held_out(name, float(value)):
            raise NotShared(f"{fit}: {name} has changed since this run was fitted to it; fit it again")
    return Held(str(fit), fit, demos.names, demos.lengths, values)
