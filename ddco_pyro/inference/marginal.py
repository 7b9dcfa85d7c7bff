"""The AHMM with its latents eliminated: a Pyro distribution, and a program with priors on the weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, cast

import pyro
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.func import functional_call

from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.arguments import BadTables, check_lengths
from ddco_pyro.model.ahmm import run
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import complete


class EliminatedAHMM(TorchDistribution):
    """The controls of N demonstrations given their observations: Σ_ζ p(ζ, a | s), without the dynamics
    (§4.1).

    In a plate over demonstrations it replaces the enumerated model :func:`ddco_pyro.model.ahmm.ahmm`:
    ``pyro.sample("controls", EliminatedAHMM(hierarchy(batch.inputs), batch.lengths), obs=batch.actions)``.
    Its gradient is the posterior; second derivatives raise an error. The batch shape is [N], the event shape
    [T, A]. ``log_prob`` is float64, which NUTS makes the type of all weights: :func:`bayesian_ahmm` gives
    networks their own.

    >>> from ddco_pyro.model.batch import encode
    >>> batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
    >>> controls = ddco_pyro.EliminatedAHMM(fit.hierarchy(batch.inputs), batch.lengths)
    >>> controls.log_prob(batch.actions).shape, controls.sample().shape
    (torch.Size([6]), torch.Size([6, 10, 2]))

    :param outputs: the networks' outputs for the observations.
    :param lengths: steps of each demonstration, integers [N]; steps beyond are ignored.
    :raises BadTables: the lengths are no integers [N] from 1 to T, or controls are NaN or of another shape.
    """

    arg_constraints: ClassVar = {}
    support = constraints.independent(constraints.real, 2)

    def __init__(self, outputs: Outputs, lengths: Tensor, validate_args: bool | None = None) -> None:
        lowest = outputs.emissions[0]
        assert lowest is not None  # the lowest level emits the control
        number, steps, _, size = lowest.shape
        self.outputs, self.lengths = outputs, check_lengths(lengths, number, steps)
        super().__init__(torch.Size([number]), torch.Size([steps, size]), validate_args=validate_args)

    def log_prob(self, value: Tensor) -> Tensor:
        """log p(a | s) of controls [N, T, A] in scaled units, [N] nats."""
        expected = self.batch_shape + self.event_shape
        if value.shape != expected:
            raise BadTables(f"controls: expected the shape {list(expected)}; got {list(value.shape)}")
        return log_likelihood(self.outputs.tables(value), self.lengths)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Controls [N, T, A] in scaled units along the same observations; 0 past the lengths."""
        if tuple(sample_shape):
            raise ValueError("one draw at a time: sample_shape is not supported")
        with torch.no_grad():
            chain = complete(self.outputs.tables(), self.lengths)
            with pyro.poutine.block(), pyro.poutine.trace() as drawn:
                run(chain, self.outputs.emissions)
            steps = range(self.event_shape[0])
            controls = torch.stack([cast(Tensor, drawn.trace.nodes[f"a_{t}"]["value"]) for t in steps], dim=1)
            return torch.where(chain.alive.unsqueeze(-1), controls, 0.0)


def bayesian_ahmm(
    hierarchy: Hierarchy,
    priors: Mapping[str, TorchDistribution] | Callable[[], Mapping[str, Tensor]],
    batch: Batch,
) -> Outputs:
    """The AHMM with priors on its weights, as a Pyro program: options and terminations are eliminated (§4.1).

    Bind hierarchy and priors with :func:`functools.partial` for a guide, SVI or NUTS. Each prior is a site
    with the parameter's name, in which ``_`` replaces each dot. Other parameters are the hierarchy's own.

    >>> import pyro, pyro.distributions as dist
    >>> from ddco_pyro.inference.marginal import bayesian_ahmm
    >>> from ddco_pyro.model.batch import encode
    >>> batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
    >>> weights = dict(fit.hierarchy.named_parameters())
    >>> priors = {name: dist.Normal(0, 1).expand(weight.shape).to_event() for name, weight in weights.items()}
    >>> trace = pyro.poutine.trace(bayesian_ahmm).get_trace(fit.hierarchy, priors, batch)
    >>> len(trace.stochastic_nodes) == len(weights), trace.nodes["controls"]["value"].shape
    (True, torch.Size([6, 10, 2]))

    :param priors: a distribution of each parameter by its name, with the parameter's shape as event shape; or
        a Pyro program that draws parameters by name, such as that of a library
        (:class:`~ddco_pyro.training.prior.Prior`).
    :return: the networks' outputs under the drawn weights.
    """
    if isinstance(priors, Mapping):
        drawn = {name: pyro.sample(name.replace(".", "_"), prior) for name, prior in priors.items()}
    else:
        drawn = dict(priors())
    weights = {name: weight.to(hierarchy.get_parameter(name).dtype) for name, weight in drawn.items()}
    outputs: Outputs = functional_call(hierarchy, weights, (batch.inputs,))
    with pyro.plate("demonstrations", len(batch), dim=-1):
        pyro.sample("controls", EliminatedAHMM(outputs, batch.lengths), obs=batch.actions)
    return outputs
