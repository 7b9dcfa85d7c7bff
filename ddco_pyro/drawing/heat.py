"""A picture with a second quantity over it, as colours."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps

HEIGHT = 240
"""Rows of what is drawn; pixels stay squares."""

FADED = 0.5
"""How far a picture is made paler, so that colours stand out."""

PERCENTILE = 99.5
"""What this part of the pixels does not exceed has the strongest colour: single pixels do not make the rest pale."""


def overlaid(picture: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A picture uint8 [H, W, C], pale and grey, under the values [H, W] ≥ 0 of its pixels, uint8 [HEIGHT, W', 3].

    Colours go from yellow to dark red, for each picture by itself; 0 has none.
    """
    grey = 255 - (1 - FADED) * (255 - picture.astype(float).mean(-1, keepdims=True))
    most = np.percentile(values, PERCENTILE) or values.max() or 1.0
    share = np.clip(values / most, 0, 1)
    colours = 255 * colormaps["YlOrRd"](share)[..., :3]
    drawn = ((1 - share[..., None]) * grey + share[..., None] * colours).astype(np.uint8)
    width = round(HEIGHT * drawn.shape[1] / drawn.shape[0])
    import cv2

    return np.asarray(cv2.resize(drawn, (width, HEIGHT), interpolation=cv2.INTER_NEAREST))
