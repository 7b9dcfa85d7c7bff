"""Encoders as users write them: good ones, and what they get wrong."""

from __future__ import annotations

import numpy as np


class Means:
    """The mean colours of the picture and of its upper half."""

    def __call__(self, pictures):
        assert pictures.dtype == np.uint8
        return np.concatenate([pictures.mean((1, 2)), pictures[:, : pictures.shape[1] // 2].mean((1, 2))], 1)


class Integers:
    def __call__(self, pictures):
        return pictures[:, 0, 0].astype(int)


class Flat:
    def __call__(self, pictures):
        return pictures.mean((1, 2, 3))


class NotFinite:
    def __call__(self, pictures):
        return np.where(pictures.mean((1, 2)) > 79, np.nan, 1.0)


class Noisy:
    def __call__(self, pictures):
        return pictures.mean((1, 2)) + np.random.default_rng().normal(size=(len(pictures), pictures.shape[-1]))


class Together:
    """As batch normalisation does in training mode."""

    def __call__(self, pictures):
        means = pictures.mean((1, 2))
        return means - means.mean(0)


class Raises:
    def __call__(self, pictures):
        raise RuntimeError("expected 224 x 224\npixels")


class NotMade:
    def __init__(self):
        raise OSError("no weights")


class NotCallable:
    pass


class LaterNotFinite:
    """What the first pictures, which are dark, do not show."""

    def __call__(self, pictures):
        return np.where(pictures.mean((1, 2)) > 100, np.nan, 1.0)
