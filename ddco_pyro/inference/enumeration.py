"""Pyro's enumeration of the program :func:`ddco_pyro.model.ahmm.ahmm`: the definition of the likelihood."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pyro
import torch
from pyro.ops.contract import contract_tensor_tree
from torch import Tensor

from ddco_pyro.model.ahmm import Scored, ahmm
from ddco_pyro.model.emissions import Steps
from ddco_pyro.model.tables import Tables, complete

BATCH_DIMENSIONS = 1
"""Dimensions of the program's plate; enumeration takes the dimensions to their left."""


def log_likelihood(
    tables: Tables, lengths: Tensor, emissions: Sequence[Steps | None] | None = None, actions: Tensor | None = None
) -> Tensor:
    """log p(ξ) of each trajectory, [N] float64, differentiable in the tables.

    This is the elimination of ``TraceEnum_ELBO`` without its sum over the plate of demonstrations.

    :param emissions: score the controls ``actions`` [N, T, A] in place of the tables' densities.
    """
    if emissions is None:
        emissions, actions = known_controls(tables)
    chain = complete(tables, lengths)
    unused = ~chain.alive[..., None, None]  # may hold NaN
    chain = replace(chain, selection=tuple(table.masked_fill(unused, 0.0) for table in chain.selection))
    with pyro.poutine.enum(first_available_dim=-1 - BATCH_DIMENSIONS), pyro.poutine.trace() as traced:
        ahmm(chain, emissions, actions)
    trace = traced.trace
    trace.compute_log_prob()
    trace.pack_tensors()
    factors: list[Any] = [
        site["packed"]["log_prob"] for site in trace.nodes.values() if "log_prob" in site.get("packed", {})
    ]
    enumerated = set("".join(factor._pyro_dims for factor in factors)) - {*trace.plate_to_symbol.values()}
    (parts,) = contract_tensor_tree(OrderedDict([(frozenset(), factors)]), enumerated).values()
    total: Tensor = sum(parts)
    return total.expand(len(lengths))


def known_controls(tables: Tables) -> tuple[list[Scored], Tensor]:
    """Emissions and controls for :func:`ddco_pyro.model.ahmm.ahmm` where tables hold the densities."""
    return [Scored(table) for table in tables.control], torch.empty(*tables.control[-1].shape[:2], 0)
