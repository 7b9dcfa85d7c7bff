"""The eliminated AHMM inside Pyro models: priors and guides see what they see with the enumerated model."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hierarchies import make_batch, make_hierarchy
from pyro.infer import MCMC, NUTS, Trace_ELBO, TraceEnum_ELBO
from pyro.infer.autoguide import AutoDelta, AutoNormal
from torch.func import functional_call

from ddco_pyro.inference import log_likelihood, posterior
from ddco_pyro.inference.marginal import EliminatedAHMM
from ddco_pyro.model.ahmm import ahmm
from ddco_pyro.model.tables import complete


def bayesian(hierarchy, batch, eliminated):
    """Normal priors on all weights; the demonstrations' controls given the observations."""
    shapes = {name: parameter.shape for name, parameter in hierarchy.named_parameters()}

    def model():
        weights = {
            name: pyro.sample(name.replace(".", "_"), dist.Normal(0.0, 0.5).expand(shape).to_event())
            for name, shape in shapes.items()
        }
        weights = {name: weight.float() for name, weight in weights.items()}  # NUTS has float64 weights
        outputs = functional_call(hierarchy, weights, (batch.inputs,))
        if eliminated:
            with pyro.plate("demonstrations", len(batch), dim=-1):
                pyro.sample("controls", EliminatedAHMM(outputs, batch.lengths), obs=batch.actions)
        else:
            ahmm(complete(outputs.tables(), batch.lengths), outputs.emissions, batch.actions)

    return model


def step(model, elbo, guide_class, seed):
    """Loss, and the guide's gradients, of one step."""
    pyro.clear_param_store()
    pyro.set_rng_seed(seed)
    guide = guide_class(pyro.poutine.block(model, hide_fn=lambda site: site["name"][:2] in ("h_", "b_")))
    guide()  # makes its parameters
    pyro.set_rng_seed(seed)
    with pyro.poutine.trace(param_only=True) as seen:
        loss = elbo.differentiable_loss(model, guide)
    sites = [(name, site) for name, site in seen.trace.nodes.items() if site["type"] == "param"]
    leaves = {name: site["value"].unconstrained() for name, site in sites}
    return loss.item(), dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))


@pytest.mark.parametrize("counts", [(3,), (2, 2)])
@pytest.mark.parametrize("guide", [AutoDelta, AutoNormal])
def test_priors_and_guides_see_the_same_as_with_enumeration(counts, guide):
    hierarchy, batch = make_hierarchy(counts, ("options", "control"), network="linear"), make_batch()
    ours, gradients = step(bayesian(hierarchy, batch, True), Trace_ELBO(), guide, 5)
    enumerating = TraceEnum_ELBO(max_plate_nesting=1, strict_enumeration_warning=False)
    theirs, expected = step(bayesian(hierarchy, batch, False), enumerating, guide, 5)
    assert ours == pytest.approx(theirs, rel=1e-6)
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected[name], rtol=1e-4, atol=1e-4)


def test_nuts_moves_with_weights_in_double_precision():
    pyro.clear_param_store()
    pyro.set_rng_seed(0)
    hierarchy, batch = make_hierarchy((2,), network="linear"), make_batch()
    kernel = NUTS(bayesian(hierarchy, batch, True), max_tree_depth=3)
    chain = MCMC(kernel, num_samples=4, warmup_steps=4, disable_progbar=True)
    chain.run()
    for drawn in chain.get_samples().values():
        assert drawn.dtype == torch.float64
        assert (drawn.diff(dim=0) != 0).any()


def test_draws_follow_the_model():
    """Moments of drawn controls against the mixture of every choice's mean, weighted by forward marginals."""
    torch.manual_seed(0)
    hierarchy, batch = make_hierarchy((3,), ("options", "control")), make_batch()
    with torch.no_grad():
        outputs = hierarchy(batch.inputs)
        distribution = EliminatedAHMM(outputs, batch.lengths)
        drawn = torch.stack([distribution.sample() for _ in range(400)])
        tables = outputs.tables(batch.actions)
        uninformed = tables.__class__(
            tables.selection, tables.termination, tuple(torch.zeros_like(c) for c in tables.control)
        )
        weights = posterior(uninformed, batch.lengths).u[0]
        means = torch.cat([outputs.emissions[1].mean, outputs.emissions[0].mean], dim=2).double()
        expected = (weights.unsqueeze(-1) * means).sum(2)
    for n, length in enumerate(batch.lengths.tolist()):
        mean = drawn[:, n, :length].mean(0)
        np.testing.assert_allclose(mean, expected[n, :length], atol=5 * 1.0 / 400**0.5)
        assert not drawn[:, n, length:].any()
    assert drawn[0].shape == (*distribution.batch_shape, *distribution.event_shape)


def test_log_prob_is_the_likelihood_and_other_shapes_are_refused():
    hierarchy, batch = make_hierarchy((3,)), make_batch()
    distribution = EliminatedAHMM(hierarchy(batch.inputs), batch.lengths)
    torch.testing.assert_close(
        distribution.log_prob(batch.actions), log_likelihood(hierarchy.tabulate(batch), batch.lengths)
    )
    with pytest.raises(ValueError, match="one draw at a time"):
        distribution.sample((2,))
