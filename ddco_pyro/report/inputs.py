"""Inputs in the report: what policies and terminations read, and the use of each branch of the networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.page import Section, Table, note
from ddco_pyro.drawing.words import number, percent
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.networks import Inputs
from ddco_pyro.names import name_in_level

GRADIENT_DEMONSTRATIONS, GRADIENT_STEPS = 8, 1000
"""Demonstrations and steps, with padding, over which gradients with respect to observations are averaged."""


def deciding(fit: Fit, demos: Demonstrations) -> dict[str, dict[str, dict[int, str]]]:
    """For each level, what the policy and the termination of each option depend on, in words, by choice.

    With branches, these are the nats per step lost without the branch. Otherwise they are shares of the
    gradient's size, Σ_i (∂y/∂x_i · σ_i)², with σ_i the standard deviation of feature i of an observation.
    Here y are all numbers of the policy, or the termination's logit, at the steps where the option is active.
    With pictures without branches nothing is said.
    """
    found: dict[str, dict[str, dict[int, str]]] = {level: {} for level in fit.names}
    levels = list(fit.names)
    for use in fit.metrics.branches:
        if use.level < len(levels):
            found[levels[use.level]]["Policy needs, nats lost without"] = {
                choice: _largest(dict(zip(use.branches, loss, strict=True)), number)
                for choice, loss in enumerate(use.loss, start=1)
                if None not in loss
            }
    if fit.metrics.branches or fit.hierarchy.encoder.images:
        return found
    count = max(1, min(GRADIENT_DEMONSTRATIONS, GRADIENT_STEPS // max(demos.lengths), len(demos)))
    few = demos.select([demos.names[row] for row in np.linspace(0, len(demos) - 1, count).astype(int)])
    for piece in fit.infer(few):
        seen, time, alive = piece.batch.inputs.vectors, piece.batch.inputs.time, piece.batch.alive
        spread = {key: array[alive].std(0) for key, array in seen.items()}
        vectors = {key: array.detach().clone().requires_grad_() for key, array in seen.items()}
        with torch.enable_grad():
            outputs = fit.hierarchy(Inputs(vectors, {}, time))
        for level, u, caller, ends in zip(
            levels, piece.posterior.u, outputs.callers, outputs.termination_logits, strict=False
        ):
            said = {"Policy reads": caller.numbers if caller.numbers is not None else caller.logits}
            said |= {"Ending reads": None if ends is None else ends.unsqueeze(-1)}
            for what, numbers in said.items():
                if numbers is not None and numbers.requires_grad:
                    found[level][what] = {
                        option: _largest(_shares(numbers[:, :, option - 1], weight, vectors, spread), percent)
                        for option, weight in enumerate(u.unbind(-1)[1:], start=1)
                        if weight.sum() >= 1
                    }
        break
    return found


def _shares(
    numbers: Tensor, weight: Tensor, vectors: Mapping[str, Tensor], spread: Mapping[str, Tensor]
) -> dict[str, float]:
    """Each observation's share in the gradient's size, of ``numbers`` [N, T, P], weighted by ``weight``."""
    sizes = dict.fromkeys(vectors, 0.0)
    for each in numbers.unbind(-1):
        if not each.requires_grad:
            continue
        slopes = torch.autograd.grad(each.sum(), [*vectors.values()], retain_graph=True, allow_unused=True)
        for key, slope in zip(vectors, slopes, strict=True):
            if slope is not None:
                size = (slope * spread[key]).square().sum(-1).double().cpu()
                sizes[key] += float((weight * size).sum())
    total = sum(sizes.values()) or 1.0
    return {key: size / total for key, size in sizes.items()}


def _largest(values: Mapping[str, float | None], words: Callable[[float | None], str]) -> str:
    """The three largest values in words, without those that round to nothing."""
    first = sorted(values, key=lambda key: -(values[key] or 0.0))[:3]
    return ", ".join(f"{key} {words(values[key])}" for key in first if (values[key] or 0.0) >= 0.005)


def branches(fit: Fit) -> Section | None:
    """Activation and loss of each branch of the networks, by option; None where no network has branches."""
    levels, rows = [*fit.names.items()], list[list[str]]()
    for use in fit.metrics.branches:
        for row, losses in enumerate(use.loss):
            inner = use.level < len(levels)
            highest = "meta-policy" if levels else "policy"
            name = name_in_level(1 + row, *levels[use.level]) if inner else highest
            for branch, activation, loss in zip(use.branches, use.activation[row], losses, strict=True):
                rows.append([name, branch, number(activation, 3), number(loss, 3)])
    if not rows:
        return None
    explained = (
        "Mean activation: size of a branch's output to the joint layer while the option is active. Nats "
        "lost: when the branch reads the observation of another step. Held-out demonstrations, or all where "
        "none is held out, weighted by the posterior of the options. Activations can be compared between the "
        "options of a branch, not between branches. Nats lost can be compared everywhere."
    )
    table = Table(["Option", "Branch", "Mean activation", "Nats per step lost"], rows, {0, 1})
    return Section("branches", "Which inputs matter", [table, note(explained)], folded=True)
