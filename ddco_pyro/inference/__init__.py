"""Exact inference in the AHMM: likelihoods by two engines, posteriors, and paths.

Each function here checks its tables and lengths, and raises :class:`BadTables` (a ``ValueError``) where they do not fit
together. The library's own training and evaluation call the unchecked functions in the modules.
"""

from __future__ import annotations

from ddco_pyro.inference import engines, paths, posteriors
from ddco_pyro.inference.arguments import BadTables, checked
from ddco_pyro.inference.engines import Engine
from ddco_pyro.inference.paths import Path
from ddco_pyro.inference.posteriors import Posterior

__all__ = [
    "BadTables",
    "Engine",
    "Path",
    "Posterior",
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
