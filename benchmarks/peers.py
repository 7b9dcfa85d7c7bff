"""The same inference with other tools: what ``make bench`` compares with (``pip install -e '.[bench]'``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import Chain, Tables
from ddco_pyro.spec.training import RidgeSpec
from ddco_pyro.training.em import Expectation

NEVER = -1e3
"""The others' gradients are NaN where a logarithm is -inf; this is as good as never here."""


def transitions(chain: Chain) -> Tensor:
    """log p(h_t | h_{t-1}) of a chain with one level, for an HMM, [N, T, S, S]; row t leads to step t."""
    keep, end = chain.termination[0].clamp(min=NEVER).unbind(-1)
    kept = torch.where(torch.eye(keep.shape[-1], dtype=torch.bool), keep.unsqueeze(-1), NEVER)
    return torch.logaddexp(end.unsqueeze(-1) + chain.selection[0].clamp(min=NEVER), kept)


def dynamax_smoother(chain: Chain) -> Callable[[], float]:
    """dynamax's jitted ``hmm_smoother`` with ready transitions: sum of log-likelihoods, and posteriors."""
    import jax
    from dynamax.hidden_markov_model import hmm_smoother

    jax.config.update("jax_enable_x64", True)
    initial = jax.numpy.asarray(chain.selection[0][:, 0, 0].exp().numpy())
    matrices = jax.numpy.asarray(transitions(chain)[:, 1:].exp().numpy())
    emission = jax.numpy.asarray(chain.emission.numpy())

    # the posteriors that our pass gives too: of choices and of transitions
    def smooth(first, matrix, likelihood):
        found = hmm_smoother(first, matrix, likelihood)
        return found.marginal_loglik, found.smoothed_probs, found.trans_probs

    batched = jax.jit(jax.vmap(smooth))
    return lambda: float(np.sum(jax.block_until_ready(batched(initial, matrices, emission))[0]))


def discrete_hmm(chain: Chain) -> Callable[[], float]:
    """Pyro's ``DiscreteHMM`` with ready transition matrices: value and gradient."""
    import pyro.distributions as dist

    initial = chain.selection[0][:, 0, 0].clamp(min=NEVER)
    matrices = transitions(chain).clamp(min=NEVER).requires_grad_()
    # A Normal whose log-density is the table's: N(0; m, 1) = -m²/2 - log sqrt(2π).
    offset = chain.emission.amax() + 1.0
    means = (2 * (offset - chain.emission.clamp(min=NEVER))).sqrt().requires_grad_()
    steps = chain.emission.shape[1]
    shift = steps * (offset + 0.5 * np.log(2 * np.pi))
    # DiscreteHMM makes a transition before its first observation: from a state that leads everywhere as the
    # start does.
    arriving = torch.cat([initial[:, None, None].expand(-1, 1, initial.shape[-1], -1), matrices[:, 1:]], 1)

    def value_and_gradient() -> float:
        model = dist.DiscreteHMM(
            torch.zeros_like(initial), arriving, dist.Normal(means, 1.0), validate_args=False, duration=steps
        )
        value = model.log_prob(torch.zeros(steps, dtype=torch.float64)).sum()
        torch.autograd.grad(value, [matrices, means], retain_graph=True)
        return float(value.detach() + shift * len(initial))

    return value_and_gradient


def funsor_elimination(chain: Chain) -> Tensor:
    """Σ_n log p(ξ_n) by the parallel scan behind ``pyro.vectorized_markov``, differentiable."""
    import funsor
    from funsor.sum_product import sequential_sum_product

    funsor.set_backend("torch")
    funsor.util._JAX_COMPILED_FUNCTION_TYPE = ()  # funsor 0.4.8 fails where a recent jax is imported too
    factors = transitions(chain) + chain.emission.unsqueeze(2)
    start = chain.selection[0][:, 0] + chain.emission[:, 0].unsqueeze(1)
    first = start.expand(-1, chain.emission.shape[-1], -1)
    factors = torch.cat([(first - np.log(first.shape[1])).unsqueeze(1), factors[:, 1:]], 1).clamp(min=NEVER)
    sizes = factors.shape
    inputs = {
        "n": funsor.Bint[sizes[0]],
        "time": funsor.Bint[sizes[1]],
        "before": funsor.Bint[sizes[2]],
        "now": funsor.Bint[sizes[3]],
    }
    tensor = funsor.Tensor(factors, inputs)
    time = funsor.Variable("time", funsor.Bint[sizes[1]])
    adding = (funsor.ops.logaddexp, funsor.ops.add)
    whole = sequential_sum_product(*adding, tensor, time, {"before": "now"})
    total = whole.reduce(funsor.ops.logaddexp, frozenset({"before", "now"})).reduce(funsor.ops.add, "n")
    return total.data


def plain_hmm(number: int, steps: int, options: int = 5, controls: int = 3) -> tuple[Tables, Any, np.ndarray]:
    """A hidden Markov model as our tables and as hmmlearn's, and controls [N·T, A]: blind options."""
    from hmmlearn.hmm import GaussianHMM

    random = np.random.default_rng(0)
    values, means = random.normal(size=(number, steps, controls)), random.normal(size=(options, controls))
    end, choice = random.uniform(0.05, 0.3, options), random.dirichlet(np.ones(options))
    model = GaussianHMM(options, "diag")
    model.startprob_, model.means_, model.covars_ = choice, means, np.ones((options, controls))
    model.transmat_ = np.diag(1 - end) + end[:, None] * choice
    density = -0.5 * ((values[:, :, None] - means) ** 2 + np.log(2 * np.pi)).sum(-1)
    selection = np.log(np.append(1e-300, choice))
    selection[0] = -np.inf
    tables = Tables(
        selection=(torch.as_tensor(selection).expand(number, steps, 1, -1),),
        termination=(torch.as_tensor(np.log(np.stack([1 - end, end], -1))).expand(number, steps, -1, -1),),
        control=(torch.as_tensor(density), torch.full((number, steps, 1), -torch.inf, dtype=torch.float64)),
    )
    return tables, model, values.reshape(-1, controls)


def em_steps(hierarchy: Hierarchy, batch: Batch) -> tuple[Callable[[], object], Callable[[], object]]:
    """An iteration of EM of linear options, and one of dynamax's for an HMM with linear regressions.

    Ours learns terminations and a meta-policy that see the state, dynamax's a matrix of transitions.
    """
    import jax
    from dynamax.hidden_markov_model import LinearRegressionHMM

    jax.config.update("jax_enable_x64", True)
    seen = jax.numpy.asarray(torch.cat(list(batch.inputs.vectors.values()), -1).double().numpy())
    controls = jax.numpy.asarray(batch.actions.double().numpy())
    model = LinearRegressionHMM(hierarchy.levels[0].count, seen.shape[-1], controls.shape[-1])
    parameters, properties = model.initialize(jax.random.PRNGKey(0))

    @jax.jit
    def iteration(parameters, state):
        statistics, values = jax.vmap(lambda u, a: model.e_step(parameters, a, u))(seen, controls)
        return model.m_step(parameters, properties, statistics, state), values.sum()

    state = model.initialize_m_step_state(parameters, properties)

    def theirs() -> None:
        jax.block_until_ready(iteration(parameters, state))

    def score(tables: Tables, piece: Batch, rows: Tensor) -> Tensor:
        return log_likelihood(tables, piece.lengths).sum()

    ours = Expectation(hierarchy, ("",), score, RidgeSpec())
    return lambda: ours.step(batch), theirs
