"""Encoders as users write them: good ones, and what they get wrong."""

import numpy as np


def means(pictures):
    """The mean colours of the picture and of its upper half."""
    assert pictures.dtype == np.uint8
    return np.concatenate([pictures.mean((1, 2)), pictures[:, : pictures.shape[1] // 2].mean((1, 2))], 1)


def places(pictures):
    """80 mixtures of where the first channel is bright: row and column, from -1 to 1."""
    share = pictures[..., 0] / pictures[..., 0].sum((1, 2), keepdims=True, dtype=float)
    rows, columns = share.sum(2), share.sum(1)
    both = [weights @ np.linspace(-1, 1, weights.shape[1]) for weights in (rows, columns)]
    return np.stack(both, 1) @ np.random.default_rng(0).normal(size=(2, 80))


def not_finite(pictures):
    return np.where(pictures.mean((1, 2)) > 79, np.nan, 1.0)


def noisy(pictures):
    return pictures.mean((1, 2)) + np.random.default_rng().normal(size=(len(pictures), pictures.shape[-1]))


def together(pictures):
    """As batch normalisation does in training mode."""
    means = pictures.mean((1, 2))
    return means - means.mean(0)


def raises(pictures):
    raise RuntimeError("expected 224 x 224\npixels")


def later_not_finite(pictures):
    """What the first pictures, which are dark, do not show."""
    return np.where(pictures.mean((1, 2)) > 100, np.nan, 1.0)


def blocks(pictures):
    """The mean colours of 16 blocks."""
    count, height, width, channels = pictures.shape
    return pictures.reshape(count, 4, height // 4, 4, width // 4, channels).mean((2, 4)).reshape(count, -1)
