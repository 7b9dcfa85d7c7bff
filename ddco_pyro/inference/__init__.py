"""Exact inference in the AHMM: two engines for one likelihood, and what follows from it.

Each function refuses tables and lengths that do not go together (:class:`BadTables`, a ``ValueError``).
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
    "total_log_likelihood",
]

log_likelihood = checked(engines.log_likelihood)
total_log_likelihood = checked(engines.total_log_likelihood)
posterior = checked(posteriors.posterior)
most_likely_path = checked(paths.most_likely_path)
sample_paths = checked(paths.sample_paths)
segment = checked(paths.segment)
