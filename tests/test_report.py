import html
import re
from html.parser import HTMLParser

import h5py
import imageio.v3 as imageio
import numpy as np
import pytest

from ddco_pyro.data import demonstrations
from ddco_pyro.demonstrations import Demonstration, Demonstrations
from ddco_pyro.report import film, words, write_report
from ddco_pyro.report.activity import LevelActivity, activity, bins
from ddco_pyro.report.plot_rows import order
from ddco_pyro.report.plot_timing import shares, terminations
from ddco_pyro.report.plot_trajectories import position_key, view
from ddco_pyro.rollout import paired_difference, summarize
from ddco_pyro.run import fit, write_metrics
from ddco_pyro.spec import parse_spec

LINEAR = {"network": "linear"}


class Quiet:
    def collected(self, done, total): ...
    def training(self, name, epochs): ...
    def epoch(self, row): ...
    def trained(self, name): ...


def made(number=8, size=3):
    rng = np.random.default_rng(0)
    demos = []
    for n in range(number):
        steps = 12 + n
        place = np.cumsum(rng.normal(size=(steps, size)), axis=0)
        phase = (np.arange(steps) >= steps // 2).astype(int)
        actions = np.where(phase[:, None], 1.0, -1.0) * place[:, :2] + 0.1 * rng.normal(size=(steps, 2))
        demos.append(Demonstration(f"demo_{n}", {"place": place}, actions, {"phase": phase}))
    return Demonstrations(tuple(demos))


def run(folder, demos, **changes):
    demos.write(folder / "demos.hdf5")
    labels = {"labels": "phase"} if changes.pop("labelled", True) else {}
    level = {"count": 2, "policy": LINEAR, "termination": LINEAR}
    data = {
        "demonstrations": {"path": str(folder / "demos.hdf5"), "valid_fraction": 0.3, **labels},
        "observations": ["place"],
        "hierarchy": {"levels": [level], "meta_policy": LINEAR},
        "training": {"epochs": 3, "optimizer": {"lr": 0.05}},
        "compare_with": [{"kind": "flat", "policy": LINEAR}],
    }
    spec = parse_spec({key: value for key, value in (data | changes).items() if value is not None})
    found = fit(spec, folder / changes.get("name", "run"), Quiet())
    return found, demonstrations(spec)


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Small pictures are drawn faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ddco_pyro.report.pictures.DOTS_PER_INCH", 40)
        yield


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    found, demos = run(tmp_path_factory.mktemp("labelled"), made())
    return found, write_report(found, demos).read_text(), demos


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    """Two hybrid levels, two restarts, two baselines, no labels, no position, rollouts and films."""
    lower = {"name": "skill", "count": 2, "policy": LINEAR, "termination": LINEAR}
    upper = {"name": "phase", "count": 2, "policy": {**LINEAR, "emits": ["options", "control"]}, "termination": LINEAR}
    found, demos = run(
        tmp_path_factory.mktemp("deep"),
        made(size=2),
        labelled=False,
        hierarchy={"levels": [lower, upper], "meta_policy": {**LINEAR, "emits": ["options", "control"]}},
        training={"epochs": 2, "restarts": 2},
        compare_with=[{"kind": "flat", "policy": LINEAR}, {"kind": "per_timestep"}],
    )
    write_metrics(found.folder, found.metrics | {"rollouts": rollouts(), "options": unused(found.metrics["options"])})
    frames = np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), dtype=np.uint8)
    (found.folder / "videos").mkdir()
    for name in ("flat-1000", "ddco-1000", "ddco-1001"):
        imageio.imwrite(found.folder / "videos" / f"{name}.mp4", frames, plugin="FFMPEG", fps=3, macro_block_size=1)
    (found.folder / "rollouts.csv").write_text("method,seed,success\nddco,1000,1.0\nddco,1001,0.0\nflat,1000,\n")
    return found, write_report(found, demos).read_text()


OURS, THEIRS = [1.0, 1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]


def rollouts():
    def outcomes(successes):
        return summarize([{"success": s, "accuracy_mm": 2.0 + n if s else np.nan} for n, s in enumerate(successes)])

    methods = {
        "flat": {"measures": outcomes(THEIRS), "against": paired_difference(OURS, THEIRS)},
        "ddco": {"measures": outcomes(OURS)},
    }
    return {"seed": 1000, "episodes": 4, "methods": methods}


def unused(options):
    options[0][2]["share"] = 0.001
    return options


class Resources(HTMLParser):
    """Collects every address a page would load, and every picture's stand-in text."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.alts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.addresses += [found[key] for key in ("src", "href", "poster", "srcset") if key in found]
        self.alts += [found.get("alt")] if tag == "img" else []
        assert tag not in ("script", "link", "iframe", "object")


def ids(page):
    return re.findall(r'<section id="(\w+)">', page)


def text(page):
    return html.unescape(re.sub(r"<[^>]*>", " ", re.sub(r'"data:[^"]*"', '""', page)))


def test_the_page_is_one_self_contained_file(labelled, deep):
    for page in (labelled[1], deep[1]):
        found = Resources(page)
        assert all(address.startswith(("data:", "#")) for address in found.addresses)
        assert all(found.alts)
        rest = re.sub(r'"data:[^"]*"', '""', page)
        assert "url(" not in rest
        assert "@import" not in rest
        assert not re.search(r"https?://", rest)


def test_figures_are_also_files(labelled, deep):
    names = {path.name for path in (labelled[0].folder / "figures").iterdir()}
    assert names == {
        f"{one}.png" for one in ("likelihood", "learning", "posterior", "segments", "trajectories", "timing")
    }
    assert (deep[0].folder / "figures" / "film.png").read_bytes()[:4] == b"\x89PNG"


def test_sections_are_there_where_they_apply(labelled, deep):
    assert ids(labelled[1]) == ["likelihood", "learning", "options", "warnings", "particulars"]
    everything = ["likelihood", "rollouts", "learning", "options", "warnings", "films", "particulars"]
    assert ids(deep[1]) == everything
    assert "trajectories" not in {path.stem for path in (deep[0].folder / "figures").iterdir()}
    assert "mutual information" in labelled[1]
    assert "mutual information" not in deep[1]


def test_a_baseline_has_no_options(labelled):
    found, _, demos = labelled
    before = found.baselines["flat"].metrics
    page = write_report(found.baselines["flat"], demos).read_text()
    assert found.baselines["flat"].metrics == before
    assert ids(page) == ["likelihood", "learning", "particulars"]
    assert "no other model was trained to compare with" in page


def test_numbers_are_those_of_the_metrics(labelled):
    found, page, _ = labelled
    metrics, shown = found.metrics, text(page)
    for one in (metrics["log_likelihood_per_step"], metrics["comparison"]["flat"]["log_likelihood_per_step"]):
        assert f" {words.number(one['valid'])} " in shown
        assert f" {words.number(one['train'])} " in shown
    difference = metrics["comparison"]["flat"]["difference"]
    mean, error = words.signed(difference["nats_per_step"]), words.number(difference["standard_error"])
    assert f"{mean} ± {error}" in shown
    for use in metrics["options"][0][1:]:
        assert f" {words.percent(use['share'], 1)} " in shown
        assert f" {words.number(use['duration'], 1)} " in shown
    for part in ("train", "valid"):
        assert words.number(metrics["agreement"][part][0]) in shown
    assert f"{metrics['engine_check']['value']:.1e}" in shown
    assert metrics["versions"]["torch"] in shown


def test_success_is_shown_with_trials_intervals_and_the_paired_comparison(deep):
    shown = " ".join(text(deep[1]).split())
    assert "DDCO 3 of 4 (30 to 95 %) 3.33 ± 1.53 [−0.46 to 7.13], n = 3" in shown
    assert "flat 1 of 4 (5 to 70 %) 3.00, n = 1" in shown
    assert "flat 2 0 4 0.5" in shown
    assert "DDCO succeeds in 3 of 4 episodes (30 to 95 %); flat in 1 of 4 (5 to 70 %)." in shown


def test_warnings_are_in_words_with_their_numbers(labelled, deep):
    assert "Option 2 of level “skill” is unused: it is active in 0.1 % of all steps." in deep[1]
    assert 'href="#warnings"' in deep[1]
    if "No sign of a degenerate solution" in labelled[1]:
        assert 'href="#warnings"' not in labelled[1]


def test_films_begin_with_the_model(deep):
    shown = text(deep[1])
    places = [shown.index(one) for one in ("DDCO, seed 1000: success", "DDCO, seed 1001: failure", "flat, seed 1000")]
    assert places == sorted(places)
    assert deep[1].count('src="data:video/mp4') == 3


def test_films_past_the_limit_are_links(deep, monkeypatch):
    size = (deep[0].folder / "videos" / "ddco-1000.mp4").stat().st_size
    monkeypatch.setattr(film, "MOST_BYTES", size)
    found = film.films(deep[0].folder, first="ddco")
    assert [one.uri is None for one in found] == [False, True, True]
    assert found[1].link == "videos/ddco-1001.mp4"


def test_names_are_escaped(tmp_path):
    folder = tmp_path / "<b>&run"
    folder.mkdir()
    path = tmp_path / "demos.hdf5"
    made(5).write(path)
    with h5py.File(path, "a") as file:
        for group in list(file["data"]):
            file["data"].move(group, f"<i>{group}")
            file[f"data/<i>{group}/obs"].move("place", "$x_{<img>$")
    spec = parse_spec(
        {
            "demonstrations": {"path": str(path), "labels": "phase"},
            "observations": ["$x_{<img>$"],
            "hierarchy": {"levels": [{"policy": LINEAR, "count": 2}], "meta_policy": LINEAR},
            "training": {"epochs": 1, "initialize": "random"},
        }
    )
    page = write_report(fit(spec, folder, Quiet()), demonstrations(spec)).read_text()
    assert "<b>" not in page
    assert "<i>" not in page
    assert "<img>" not in page
    assert "&lt;b&gt;&amp;run" in page
    assert "stages named vq" not in page.lower()


def comparison(mean, error, held_out=10):
    return {
        "model": "ddco",
        "valid": [{}] * held_out,
        "log_likelihood_per_step": {"train": 2.0, "valid": 1.0},
        "comparison": {"flat": {"difference": {"nats_per_step": mean, "standard_error": error}}},
    }


@pytest.mark.parametrize(
    ("mean", "error", "held_out", "said"),
    [
        (0.42, 0.05, 10, "0.42 ± 0.05 nats per step better than flat"),
        (-0.42, 0.05, 10, "0.42 ± 0.05 nats per step worse than flat"),
        (0.1, 0.05, 10, "with no clear difference from flat (+0.10 ± 0.05 nats per step)"),
        (0.1, 0.04, 100, "0.10 ± 0.04 nats per step better than flat"),
        (0.1, 0.04, 3, "with no clear difference from flat"),
        (0.1, float("nan"), 1, "0.10 nats per step better than flat (error unknown) (1 held-out demonstration;"),
    ],
)
def test_the_verdict_is_honest(mean, error, held_out, said):
    assert said in words.verdict(comparison(mean, error, held_out))


def test_numbers_in_words():
    assert [words.number(one) for one in (None, float("nan"), -1.234, -0.001)] == ["–", "–", "−1.23", "0.00"]
    assert [words.signed(one) for one in (1.0, -1.0, 0.0)] == ["+1.00", "−1.00", "0.00"]
    assert [words.p_value(one) for one in (0.0004, 0.0123, 1.0)] == ["< 0.001", "0.012", "1"]
    assert [words.measure(one) for one in ("success", "accuracy_mm", "picked_up")] == [
        "Success",
        "Accuracy (mm)",
        "Picked up",
    ]


def test_activity_is_what_the_fit_says_in_one_go(labelled, monkeypatch):
    found, _, demos = labelled
    monkeypatch.setattr("ddco_pyro.hierarchy.STEPS_AT_ONCE", 1)  # one demonstration at a time
    level = activity(found, demos).levels[0]
    np.testing.assert_allclose(level.active, found.posterior(demos).u[0], atol=1e-5)
    np.testing.assert_array_equal(level.path, found.segment(demos)[0])


def test_bins_are_steps_where_demonstrations_are_equally_long():
    found = bins(np.array([4, 4]))
    np.testing.assert_array_equal(found.index, [[0, 1, 2, 3]] * 2)
    np.testing.assert_array_equal(found.edges, [-0.5, 0.5, 1.5, 2.5, 3.5])


def test_bins_are_normalised_time_otherwise():
    found = bins(np.array([2, 4]))
    np.testing.assert_array_equal(found.index, [[0, 1, -1, -1], [0, 0, 1, 1]])
    assert len(bins(np.array([2000, 1999])).edges) == 61


def test_shares_and_terminations_are_weighted_means():
    active = np.array([[[0, 1, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]], dtype=float)
    termination = np.array([[[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]], [[0.1, 0.2], [0.7, 0.8], [0.9, 1.0]]])
    level = LevelActivity("option", active, np.zeros((2, 3), int), termination)
    gathered = bins(np.array([3, 3]))
    np.testing.assert_allclose(shares(level, gathered), [[0, 1, 0], [0, 0.75, 0.25], [0, 0, 1]])
    nan = np.nan  # nobody can end before the first step, and option 2 is not there before the last
    expected = [[nan, nan], [0.5, nan], [(0.5 + 0.5 * 0.9) / 1.5, 1.0]]
    np.testing.assert_allclose(terminations(level, gathered), expected)


def test_rows_are_sorted_by_length_then_by_the_first_change(labelled):
    found, _, demos = labelled
    np.testing.assert_array_equal(order(activity(found, demos)), np.arange(len(demos)))


def test_positions_are_seen_from_where_they_spread():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * [0.01, 1.0, 1.0]  # a plane across the first axis
    elevation, azimuth = view(points, np.ones(3))
    assert elevation == 15
    assert min(abs(azimuth % 180), 180 - azimuth % 180) <= 15.0001


@pytest.mark.parametrize(("size", "key"), [(2, None), (3, "place"), (7, "place")])
def test_position_is_the_first_vector_of_three_numbers(size, key):
    assert position_key(made(2, size)) == key
