"""The prior that a library of options is for a new task: a Gaussian centred at its weights, and one of σ.

The library is a fitted model of the same networks, with weights W0 and standard deviations s. A ridge of ρ
stands for as many steps that say W0, and a spread of c for as many controls that have the σ of the library:

    W ~ N(W0, 1/ρ),    W ~ N(W0, σ²/ρ) for means of continuous controls,    1/σ² ~ Gamma(c/2, c s²/2).

Biases have it, too. Without the prior of σ a ridge that is centred elsewhere than 0 counts residuals of 0,
and σ collapses. The density of σ is that of log σ. What is of policies' controls counts β times
(``control.power``), as the density of their controls does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pyro
import torch
from pyro.distributions import Gamma, Normal, TorchDistribution, TransformedDistribution
from torch import Tensor
from torch.distributions.transforms import AffineTransform, ExpTransform

from ddco_pyro.model.controls import raw_of
from ddco_pyro.model.emissions import KINDS
from ddco_pyro.model.hierarchy import Caller, Hierarchy

Site = Callable[[str, TorchDistribution, Tensor, float], Tensor]
"""What is done at a site: name, distribution, present value, and how many times its log-density counts."""


@dataclass(frozen=True)
class Prior:
    """The prior that a library is.

    :param model: of the library; it has the same networks as a model of the new task.
    :param ridge: ρ; 0 leaves the weights without this prior.
    :param spread: c.
    """

    model: Hierarchy
    ridge: float
    spread: float

    def log_density(self, model: Hierarchy) -> Tensor:
        """The log-density of a model's parameters, nats, a number in float64."""
        total = torch.zeros((), dtype=torch.float64)

        def score(name: str, distribution: TorchDistribution, value: Tensor, times: float) -> Tensor:
            nonlocal total
            total = total + times * distribution.log_prob(value).sum()
            return value

        self._sites(model, score)
        return total

    def program(self, model: Hierarchy) -> dict[str, Tensor]:
        """A Pyro program that draws a model's parameters, by name.

        >>> from functools import partial
        >>> from ddco_pyro.inference.marginal import bayesian_ahmm
        >>> from ddco_pyro.model.batch import encode
        >>> from ddco_pyro.training.prior import Prior
        >>> batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
        >>> prior = partial(Prior(fit.hierarchy, ridge=30, spread=20).program, fit.hierarchy)
        >>> bayesian_ahmm(fit.hierarchy, prior, batch).emissions[0].shape
        torch.Size([6, 10, 2, 2])
        """

        def draw(name: str, distribution: TorchDistribution, value: Tensor, times: float) -> Tensor:
            with pyro.poutine.scale(scale=times):
                drawn: Tensor = pyro.sample(name, distribution)
            return drawn

        return self._sites(model, draw)

    def _sites(self, model: Hierarchy, site: Site) -> dict[str, Tensor]:
        """Every site in turn, σ of a caller before its weights; the parameters by name, in float64."""
        found: dict[str, Tensor] = {}
        callers = model.named_callers()
        for place in model.networks():
            caller, scale = callers.get(place), None
            if caller is not None and caller.std is not None:
                scale = self._stds(place, caller, float(model.power), site, found)
            if self.ridge:
                self._weights(place, model, scale, site, found)
        return found

    def _stds(self, place: str, caller: Caller, power: float, site: Site, found: dict[str, Tensor]) -> Tensor:
        """σ of a caller, [K, C]. Options that share σ are as many times the prior of one."""
        std, known = caller.std, self.model.named_callers()[place].std
        assert std is not None
        assert known is not None
        columns = list(std.table().double().expand(caller.copies, -1).unbind(-1))
        for key, places in (("raw", std.shared), ("raw_own", std.own)):
            if not places:
                continue
            copies = slice(0, 1 if key == "raw" else caller.copies)
            value = torch.stack([columns[column] for column in places], -1)[copies]
            squares = known.table().detach().double().expand(caller.copies, -1)[copies, places].square()
            half = 0.5 * self.spread * (caller.copies if key == "raw" else 1)
            precision = Gamma(torch.full_like(squares, half), half * squares)
            to_log = [ExpTransform().inv, AffineTransform(0.0, -0.5)]
            of_log = TransformedDistribution(precision, to_log).to_event()
            drawn = site(f"{place}.log_{key}".replace(".", "_"), of_log, value.log(), power).exp()
            for column, own in zip(places, drawn.unbind(-1), strict=True):
                columns[column] = own.expand(caller.copies)
            raw = raw_of(drawn, std.floor[places])
            found[f"{place}.std.{key}"] = raw[0] if key == "raw" else raw
        return torch.stack(columns, -1)

    def _weights(
        self, place: str, model: Hierarchy, std: Tensor | None, site: Site, found: dict[str, Tensor]
    ) -> None:
        """The weights of a network: those of choices and those of a control are sites of their own."""
        network, center = model.networks()[place], self.model.networks()[place]
        caller = model.named_callers().get(place)
        last = f"layers.{len(network.layers) - 1}."
        pairs = zip(network.named_parameters(), center.named_parameters(), strict=True)
        for (name, value), (_, known) in pairs:
            is_last = name.startswith(last)
            choices = value.shape[-1]
            if caller is not None and std is not None:
                choices = caller.sizes[0] if is_last else 0
            parts = []
            for kind, columns in (("", slice(0, choices)), ("_control", slice(choices, None))):
                own, at = value.double()[..., columns], known.detach().double()[..., columns]
                if own.shape[-1]:
                    scale = torch.ones_like(own)
                    if kind and is_last and caller is not None and std is not None:
                        scale = scale * _scales(caller, model, std).unsqueeze(1)
                    normal = Normal(at, scale / math.sqrt(self.ridge)).to_event()
                    times = float(model.power) if kind else 1.0
                    parts.append(site(f"{place}.{name}{kind}".replace(".", "_"), normal, own, times))
            prefix = place if caller is None else f"{place}.network"
            found[f"{prefix}.{name}"] = torch.cat(parts, -1)


def _scales(caller: Caller, model: Hierarchy, std: Tensor) -> Tensor:
    """σ [K, C] of each number of a caller's control that is a mean, and 1 of the others, [K, size]."""
    assert caller.std is not None
    one, columns, place = std.new_ones(len(std)), list[Tensor](), 0
    for part in model.scaling.parts:
        size = KINDS[part.kind].size(part)
        count = len(part.dims) if part.continuous else 0
        own = [one if at in caller.std.of_state else std[:, at] for at in range(place, place + count)]
        columns += [one] * (size - count) + own
        place += count
    return torch.stack([*columns, *[one] * len(caller.std.of_state)], -1)
