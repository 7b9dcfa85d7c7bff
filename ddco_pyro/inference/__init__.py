"""Exact inference in the AHMM: likelihoods by two engines, posteriors, and paths.

Each function here checks its tables and lengths, and raises :class:`BadTables` (a ``ValueError``) where they
do not fit together. The library's own training and evaluation call the unchecked functions in the modules.
"""

from __future__ import annotations

import torch

from ddco_pyro.inference import engines, paths, posteriors
from ddco_pyro.inference.arguments import BadTables, checked
from ddco_pyro.inference.engines import Engine
from ddco_pyro.inference.paths import Path
from ddco_pyro.inference.posteriors import Posterior
from ddco_pyro.model.tables import Tables

__all__ = [
    "BadTables",
    "Engine",
    "Path",
    "Posterior",
    "compile_all",
    "log_likelihood",
    "most_likely_path",
    "posterior",
    "sample_paths",
    "segment",
]

log_likelihood = checked(engines.log_likelihood)
posterior = checked(posteriors.posterior)
most_likely_path = checked(paths.most_likely_path)
sample_paths = checked(paths.sample_paths)
segment = checked(paths.segment)


def compile_all() -> None:
    """Compile the recursions, or read them from the cache on disk, before other processes look for them
    there.

    Compiling takes 5 CPU seconds, once for each installation.
    """
    half, one = torch.zeros(1, 1, 1, 2).log_softmax(-1), torch.ones(1, dtype=torch.int64)
    tables = Tables((half,), (half,), (half[..., 0], half[..., 1]))
    log_likelihood(tables, one)
    segment(tables, one)
