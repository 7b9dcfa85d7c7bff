"""Principal components of features, from one pass over blocks of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ddco_pyro.data.memory import refuse_too_much


@dataclass(frozen=True)
class Projection:
    """Onto the principal components: (x − ``mean`` [F]) · ``components`` [N, F]ᵀ.

    :param explained: the share of the features' variance that is kept.
    """

    mean: np.ndarray
    components: np.ndarray
    explained: float

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """[..., F] to float32 [..., N]."""
        return ((features - self.mean) @ self.components.T).astype(np.float32)


def principal_components(blocks: Iterable[np.ndarray], size: int) -> Projection:
    """The ``size`` principal components of rows [M, F], at least ``size`` of them in all, exactly as of all at once.

    Holds an F × F matrix. Of each component, the entry that is largest in size is positive.

    :raises DemonstrationsError: that matrix takes more memory than is allowed.
    """
    number, total, products, origin = 0, np.zeros(0), np.zeros((0, 0)), np.zeros(0)
    for block in blocks:
        if not number:
            features = block.shape[1]
            remedy = "take an encoder that gives fewer"
            refuse_too_much(4 * 8 * features**2, f"reducing {features} features to {size}", remedy)
            origin = block[0].astype(np.float64)  # near the mean, so that little is lost when that is taken off
            total, products = np.zeros(features), np.zeros((features, features))
        rows = block - origin
        number += len(rows)
        total += rows.sum(0)
        products += rows.T @ rows
    offset = total / number
    values, vectors = np.linalg.eigh(products - number * np.outer(offset, offset))
    kept = vectors[:, ::-1][:, :size].T
    largest = np.take_along_axis(kept, np.abs(kept).argmax(1)[:, None], 1)
    variance = values.clip(0)
    explained = float(variance[::-1][:size].sum() / variance.sum()) if variance.any() else 1.0
    return Projection(origin + offset, kept * np.where(largest < 0, -1.0, 1.0), explained)
