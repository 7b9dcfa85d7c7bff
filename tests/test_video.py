"""Films: what is read back is what was filmed, with the active options marked."""

from __future__ import annotations

import av
import numpy as np
import pytest

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.drawing.colours import option_rgb
from ddco_pyro.simulation.episodes import Episode
from ddco_pyro.simulation.film import FRAMES_PER_SECOND, captioned, write_film

HEIGHT, WIDTH = 121, 161


@pytest.fixture
def episode():
    """Three steps of options 2, 1, 1 and the end; each frame is greyer than the last."""
    frames = [np.full((HEIGHT, WIDTH, 3), 60 * t, np.uint8) for t in range(4)]
    record = Demonstration("demo_0", {"x": np.zeros((3, 1))}, np.zeros((3, 1)))
    return Episode(0, record, {}, np.array([[2], [1], [1]]), frames)


def test_a_film_has_every_frame_in_even_size(episode, tmp_path):
    path = tmp_path / "videos" / "film.mp4"
    write_film(path, episode)
    with av.open(path) as container:
        stream = container.streams.video[0]
        film = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(stream)])
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")  # what browsers play
        assert stream.average_rate == FRAMES_PER_SECOND
    assert film.shape == (4, HEIGHT - 1, WIDTH - 1, 3)
    centres = film[:, 70:100, 60:100].mean((1, 2, 3))
    np.testing.assert_allclose(centres, [0, 60, 120, 180], atol=6)
    assert [one.name for one in path.parent.iterdir()] == ["film.mp4"]


def test_the_border_has_the_colour_of_the_active_option(episode):
    for t, choice in enumerate([2, 1, 1]):
        frame = captioned(episode, t)
        for edge in (frame[0], frame[-1], frame[:, 0], frame[:, -1]):
            assert (edge == option_rgb(choice)).all()
    assert not (captioned(episode, 3)[-1] == option_rgb(1)).all(-1).any()
    assert (episode.frames[0] == 0).all()  # the episode's own frames stay as they are
