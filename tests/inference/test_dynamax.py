"""One level against dynamax's smoother of hidden Markov models (`pip install -e '.[bench]'`)."""

import numpy as np
import pytest
import torch
from oracle import random_tables

from ddco_pyro.inference import log_likelihood, posterior
from ddco_pyro.model.tables import complete

pytest.importorskip("jax").config.update("jax_enable_x64", True)
inference = pytest.importorskip("dynamax.hidden_markov_model")


@pytest.mark.parametrize("hybrid", [False, True])
@pytest.mark.parametrize("options", [1, 5])
def test_likelihood_and_posterior_are_those_of_dynamax(options: int, hybrid: bool) -> None:
    tables = random_tables((options,), (hybrid,), trajectories=2, steps=200, seed=options)
    lengths = torch.tensor([200] * 2)
    chain, found = complete(tables, lengths), posterior(tables, lengths)
    selection, (keep, end) = chain.selection[0].exp(), chain.termination[0].exp().unbind(-1)
    transitions = (end.unsqueeze(-1) * selection + torch.diag_embed(keep))[:, 1:]  # row t leads to step t
    for n, value in enumerate(log_likelihood(tables, lengths)):
        own = (selection[n, 0, 0], transitions[n], chain.emission[n])
        truth = inference.hmm_smoother(*(table.numpy() for table in own))
        np.testing.assert_allclose(value, truth.marginal_loglik, rtol=1e-12)
        np.testing.assert_allclose(found.u[0][n], truth.smoothed_probs, atol=1e-10)
        stayed = torch.diagonal(transitions[n], dim1=-2, dim2=-1)
        kept = keep[n, 1:] / stayed * torch.einsum("tss->ts", torch.from_numpy(np.array(truth.trans_probs)))
        np.testing.assert_allclose(found.w[0][n, :-1, 1:], kept[:, 1:], atol=1e-10)  # choice 0 lasts one step
