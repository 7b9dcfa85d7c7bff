"""Skills of the report beside segments written by hand: transitions, instances, sheets, films, drawings."""

import base64
import io
import re
from itertools import combinations

import av
import cv2
import numpy as np
import pytest

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.drawing.figures import transition_graph, typical_paths
from ddco_pyro.drawing.shown import projection
from ddco_pyro.names import CONTROL, OPTIONS, option_rgb
from ddco_pyro.report.skills import Instance, film_of, instances, sheet_of, transitions
from ddco_pyro.segmenting.segments import LevelLabels, Segmented, Segments
from ddco_pyro.simulation.episodes import Episode
from ddco_pyro.simulation.film import FRAMES_PER_SECOND, captioned, write_film

PATHS = ["1112233", "112222", "2211"]
"""The options of three demonstrations of 7, 6 and 4 steps."""


def segmented(paths=PATHS, sure=0.9):
    found = []
    for number, path in enumerate(paths):
        options = np.array([int(step) for step in path])
        begun = np.diff(options, prepend=-1) != 0
        level = LevelLabels(options, begun, np.full(len(path), sure))
        found.append(Segments(f"demo_{number}", {"option": level}, 0.0, False))
    return Segmented(tuple(found), {"option": 3}, None)


def test_transitions_are_those_counted_by_hand():
    counts = transitions(segmented(), "option")
    expected = np.zeros((5, 5), int)  # 1 to 3 are options, 4 is the start (row) and the end (column)
    expected[4, 1], expected[4, 2] = 2, 1
    expected[1, 2], expected[2, 3], expected[2, 1] = 2, 1, 1
    expected[3, 4], expected[2, 4], expected[1, 4] = 1, 1, 1
    np.testing.assert_array_equal(counts, expected)
    shares, names = [0, 7 / 17, 8 / 17, 2 / 17], ["control", "a<b", "place", "go"]
    drawn = transition_graph(counts, shares, names, [1, 2, 3])
    titles = re.findall(r"<title>([^<]*): (\d+) of (\d+)</title>", drawn)
    assert {(name, int(a), int(b)) for name, a, b in titles} == {
        ("start → a&lt;b", 2, 3), ("start → place", 1, 3), ("a&lt;b → place", 2, 3), ("place → go", 1, 3),
        ("place → a&lt;b", 1, 3), ("go → end", 1, 1), ("place → end", 1, 3), ("a&lt;b → end", 1, 3),
    }  # fmt: skip


def test_starts_and_ends_are_drawn_however_many_transitions_there_are():
    """Three demonstrations of 300 segments each: a start is one transition of 900."""
    counts = transitions(segmented(["12" * 150, "12" * 150, "21" * 150]), "option")
    drawn = transition_graph(counts, [0, 0.5, 0.5, 0], ["control", "a", "b", "c"], [1, 2])
    assert {"start → a: 2 of 3", "start → b: 1 of 3", "b → end: 2 of 450", "a → end: 1 of 450"} < set(
        re.findall(r"<title>([^<]*)</title>", drawn)
    )


def test_the_most_typical_segments_come_first_and_of_different_demonstrations():
    found = segmented(["1121122", "11112"])
    found.segments[0].levels["option"].probability[3:5] = 1.0
    assert instances(found, "option", 1) == [
        Instance(0, 3, 5, 1.0),  # the surest
        Instance(1, 0, 4, 0.9),  # of another demonstration
        Instance(0, 0, 2, 0.9),
    ]
    assert instances(found, "option", 3) == []


@pytest.fixture
def shades():
    """Pictures of two demonstrations whose shade is 10 times the step, plus 100 in the second one."""
    steps = 10 * np.arange(12, dtype=np.uint8)[:, None, None, None]
    return [np.broadcast_to(steps + np.uint8(first), (12, 30, 40, 1)) for first in (0, 100)]


CHOSEN = [Instance(0, 4, 10, 1.0), Instance(1, 2, 5, 1.0)]


def test_a_contact_sheet_has_the_first_middle_and_last_picture(shades):
    (content,) = re.findall(r'src="data:image/jpeg;base64,([^"]*)"', sheet_of(shades, CHOSEN, "").content)
    sheet = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)
    cells = sheet.reshape(2, sheet.shape[0] // 2, 3, sheet.shape[1] // 3, 3).mean((1, 3, 4))
    np.testing.assert_allclose(cells, [[40, 60, 90], [120, 130, 140]], atol=3)


def test_a_film_of_pictures_begins_at_onsets(shades):
    content = base64.b64decode(film_of(shades, CHOSEN, 1).content.partition("base64,")[2].partition('"')[0])
    assert len(content) < 300_000
    with av.open(io.BytesIO(content)) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 6
    for step, frame in enumerate(frames):
        left, right = np.hsplit(frame[10:100].astype(float), 2)
        assert left[:, 10:-10].mean() == pytest.approx(10 * (4 + step), abs=8)
        if step < 3:
            assert right[:, 10:-10].mean() == pytest.approx(100 + 10 * (2 + step), abs=8)
        else:
            assert right[:, 10:-10].mean() == pytest.approx(128 + 140 / 2, abs=8)  # ended: paler


def test_a_projection_keeps_distances_in_the_plane_that_it_looks_at():
    """An orthographic view scales every length by the same factor and shortens depth alone."""
    points = np.random.default_rng(0).normal(size=(50, 3))
    turn = projection(points) * np.ptp(points, axis=0).max()
    np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-12)


def test_each_path_of_two_arms_has_a_line_of_its_own():
    """Two demonstrations of two arms."""
    still, moving = np.zeros((6, 2)), np.arange(12.0).reshape(6, 2)
    both = [np.stack([still, moving]), np.stack([moving, still])]
    drawn = typical_paths(both, [(0, 2, 5)], "#123456")
    assert re.findall(r'<polyline[^>]*stroke-dasharray="([^"]*)"', drawn) == ["none", "5 2.5"]
    assert drawn.count('class="faint"') == 4


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


# What people without red, green or blue cones see, in linear RGB (Machado, Oliveira & Fernandes 2009,
# severity 1).
SIGHTS = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
])  # fmt: skip


def lab(colours, sight):
    """Colours [N, 3] in CIELAB; cv2 takes its own way from linear RGB."""
    rgb = np.array([[*bytes.fromhex(colour.removeprefix("#"))] for colour in colours]) / 255
    linear = np.clip(np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ sight.T, 0, 1)
    return cv2.cvtColor(linear[None].astype(np.float32), cv2.COLOR_LRGB2Lab)[0]


@pytest.mark.parametrize(("count", "distance"), [(5, 23), (10, 18)])
def test_colours_are_told_apart_from_each_other_and_from_control(count, distance):
    for sight in SIGHTS:
        for one, other in combinations(lab((CONTROL, *OPTIONS[:count]), sight), 2):
            assert np.linalg.norm(one - other) > distance
