"""The study of pushing from pictures: its networks, and features of pictures that are moved."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from pushing_pictures import SIZE, encoded

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations


def test_features_have_versions_of_pictures_that_are_moved():
    """Each demonstration by moves of its own, all of its pictures alike; what is read here is the picture itself."""
    pictures = np.random.default_rng(0).integers(0, 256, (10, 4, *SIZE, 3), dtype=np.uint8)
    demos = Demonstrations(
        tuple(Demonstration(f"demo_{at}", {"camera": own}, np.zeros((4, 2))) for at, own in enumerate(pictures))
    )
    reader = SimpleNamespace(encode=lambda seen: seen.reshape(len(seen), -1).astype(np.float32))
    kept, by = encoded(reader, demos, versions=6, seed=3), set()
    assert kept.names == demos.names
    for demo, whole in zip(kept, pictures, strict=True):
        np.testing.assert_array_equal(demo.observations["camera_features"], whole.reshape(4, -1))
        inside = whole[:, 3:-3, 3:-3]
        height, width = inside.shape[1:3]
        for version in demo.observations["camera_features_moved"].swapaxes(0, 1):
            seen = version.reshape(4, *SIZE, 3)
            places = [
                (row, column)
                for row in range(7)
                for column in range(7)
                if (seen[:, row : row + height, column : column + width] == inside).all()
            ]
            assert len(places) == 1
            by.update(places)
    assert len(by) > 20  # of 49
    assert list(encoded(reader, demos)[0].observations) == ["camera_features"]
