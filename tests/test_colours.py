from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from ddco_pyro.drawing.colours import CONTROL, OPTIONS, option_colour, option_rgb

# What dichromats see, in linear RGB (Machado, Oliveira & Fernandes 2009, severity 1).
SIGHTS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])


def lab(colour, sight):
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    x, y, z = XYZ @ np.clip(SIGHTS[sight] @ linear, 0, 1) / WHITE
    x, y, z = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16 / 116 for v in (x, y, z))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize(("count", "distance"), [(5, 23), (10, 18)])
def test_colours_are_told_apart_from_each_other_and_from_control(sight, count, distance):
    for one, other in combinations((CONTROL, *OPTIONS[:count]), 2):
        assert np.linalg.norm(lab(one, sight) - lab(other, sight)) > distance, (one, other)


def test_control_is_grey_and_ten_colours_repeat():
    assert option_colour(0) == CONTROL
    assert option_colour(11) == option_colour(1)
    assert option_rgb(1) == (63, 144, 218)
