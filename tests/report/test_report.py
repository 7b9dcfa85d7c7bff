import html
import re
from dataclasses import replace
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
import toy_task
from planted import LINEAR, small_spec
from random_demonstrations import numbered
from time_lines import embedded, tracks

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing import words
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import load
from ddco_pyro.metrics import Metrics
from ddco_pyro.report import rollouts as rolling
from ddco_pyro.report import training, write_report
from ddco_pyro.simulation.episodes import Episode, summarize
from ddco_pyro.simulation.film import write_film
from ddco_pyro.spec import with_overrides
from ddco_pyro.statistics import paired_difference
from ddco_pyro.training.data import demonstrations, train_and_valid


def made(number=8, size=3):
    """Demonstrations of something that moves."""
    rng, rows = np.random.default_rng(0), []
    for steps in range(12, 12 + number):
        place = np.cumsum(rng.normal(size=(steps, size)), axis=0)
        phase = (np.arange(steps) >= steps // 2).astype(int)
        actions = np.where(phase[:, None], 1.0, -1.0) * place[:, :2] + 0.1 * rng.normal(size=(steps, 2))
        rows.append(({"place": place}, actions, {"phase": phase}))
    return replace(numbered(rows), attributes={"control_frequency": 20.0})


def run(folder, demos, name="run", labels="phase", **changes):
    demos.write(folder / "demos.hdf5")
    spec = small_spec(**{
        "name": "option",
        "demonstrations": {"path": str(folder / "demos.hdf5"), "valid_fraction": 0.3, "labels": labels},
        "observations": ["place"],
        "training": {"epochs": 12, "optimizer": {"lr": 0.05}},
        "compare_with": [{"kind": "flat", "policy": LINEAR}],
        **changes,
    })  # fmt: skip
    return fit(spec, out=folder / name), demonstrations(spec)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    found, demos = run(tmp_path_factory.mktemp("labelled"), made())
    return found, write_report(found, demos).read_text(), demos


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    """Two hybrid levels, two restarts, two baselines, no labels, no position, rollouts and films."""
    lower = {"name": "skill", "count": 2, "policy": LINEAR, "termination": LINEAR}
    policy = {**LINEAR, "emits": ["options", "control"]}
    upper = {"name": "phase", "count": 2, "policy": policy, "termination": LINEAR}
    found, demos = run(
        tmp_path_factory.mktemp("deep"),
        made(size=2),
        labels=None,
        hierarchy={"levels": [lower, upper], "meta_policy": {**LINEAR, "emits": ["options", "control"]}},
        training={"epochs": 12, "starts": ["vq", "vq"]},
        compare_with=[{"kind": "flat", "policy": LINEAR}, {"kind": "per_timestep"}],
    )
    Metrics.model_validate(found.metrics.model_dump() | {"rollouts": rollouts()}).write(found.folder)
    frames = np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), dtype=np.uint8)
    (found.folder / "videos").mkdir()
    for name in ("flat-1000", "ddco-1000", "ddco-1001"):
        episode = Episode(1000, demos[0], {}, np.zeros((4, 0), int), frames)
        write_film(found.folder / "videos" / f"{name}.mp4", episode)
    table = "method,seed,success\nddco,1000,1.0\nddco,1001,0.0\nflat,1000,\n"
    (found.folder / "rollouts.csv").write_text(table)
    found = load(found.folder)
    return found, write_report(found, demos).read_text()


def rollouts():
    """Of four episodes of two methods."""
    ours, theirs = [1.0, 1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]
    measures = [summarize(toy_task.task, [{"success": one} for one in own]) for own in (ours, theirs)]
    flat = {"measures": measures[1], "against": paired_difference(ours, theirs)}
    return {"seed": 1000, "episodes": 4, "methods": {"flat": flat, "ddco": {"measures": measures[0]}}}


def test_the_page_is_one_self_contained_file(labelled, deep):
    for page in (labelled[1], deep[1]):
        code = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
        addresses = re.findall(r'\b(?:src|href|poster|srcset)="([^"]*)"', code)
        assert {address.partition(":")[0][:5].partition("#")[0] for address in addresses} <= {"data", ""}
        assert all(re.search(' alt="[^"]', picture) for picture in re.findall("<img[^>]*>", code))
        assert not re.search("<(link|iframe|object)", code)
        rest = re.sub(r'"data:[^"]*"', '""', page)
        assert rest.count("url(") == rest.count("url(${track.k.strip})")  # a picture of the page's own data
        assert "@import" not in rest
        assert not re.search(r"https?://", rest)


def rows_of(page):
    """The list of demonstrations: (name, where its link leads, whether it is held out, numbers) of each."""
    (section,) = re.findall(r'<section id="demonstrations">(.*?)</section>', page, re.DOTALL)
    found = []
    for row in re.findall(r"<tr><td>(.*?)</tr>", section, re.DOTALL):
        link = re.match(r'<a href="#([^"]*)">', row)
        name, mark, *numbers = re.findall(r"([^<>]*)(?:</a>|</span>)?</td>", row)
        found.append((html.unescape(name), link[1] if link else None, mark == "held out", numbers))
    return found


def test_demonstrations_are_listed_worst_first_with_links_to_their_segments(labelled):
    found, page, demos = labelled
    values = found.log_likelihood(demos) / demos.lengths
    per_step = dict(zip(demos.names, values, strict=True))
    valid = train_and_valid(found.spec, demos)["valid"].names
    listed = rows_of(page)
    assert [name for name, *_ in listed] == sorted(demos.names, key=per_step.__getitem__)
    for name, link, held_out, numbers in listed:
        assert held_out == (name in valid)
        steps = len(demos[demos.names.index(name)])
        assert numbers[:2] == [words.duration(20, steps), words.number(per_step[name])]
        assert page.count(f'id="{link}"') == 1
        assert tracks(page)[name][:2] == (link, held_out)


def test_agreement_and_lengths_are_shown_beside_a_yardstick(labelled):
    """Agreement beside that of equal lengths, here the labels or a step off; steps beside seconds."""
    found, page, _ = labelled
    (section,) = re.findall(r'<section id="agreement">(.*?)</section>', page, re.DOTALL)
    rows = dict(re.findall(r"<tr><td>([a-z][^<]*)</td><td>([^<]*)</td>", section))
    assert list(rows)[:4] == [
        "options, held out",
        "equal lengths, held out",
        "options, training",
        "equal lengths, training",
    ]
    assert rows["options, held out"] == words.number(found.metrics.agreement.valid[0].nmi)
    assert float(rows["equal lengths, training"]) > 0.7
    for use in found.metrics.options[0][1:]:
        assert f"<td>{use.segments}</td><td>{words.duration(20, use.length)}</td>" in page
        length = f"<dt>Median length</dt><dd>{words.duration(20, use.length)}</dd>"
        assert f"<dd>{use.segments}</dd>\n{length}" in page


def test_every_option_is_shown_beside_the_one_that_it_is_most_like(deep):
    """Of two options of a level each is most like the other."""
    found, page = deep
    expected = [
        f"{names[3 - use.choice]}, {words.number(pair.divergence)} nats per step apart"
        for names, uses, (pair,) in zip(
            found.names.values(), found.metrics.options, found.metrics.divergences, strict=True
        )
        for use in uses[1:]
        if use.segments
    ]
    assert sorted(re.findall("<dt>Most like</dt><dd>(.*?)</dd>", page)) == sorted(expected) != []
    assert "Drawings:" not in page  # its spec names no position


def test_the_segments_are_those_of_the_most_likely_path(labelled):
    found, page, demos = labelled
    (path,) = found.segment(demos)
    for name, *_ in rows_of(page):
        lanes = tracks(page)[name][2]
        steps = [option for option, start, end in lanes["option"] for _ in range(start, end)]
        row = demos.names.index(name)
        np.testing.assert_array_equal(steps, path[row])
        half = len(steps) // 2
        assert lanes["phase"] == [(0, 0, half), (1, half, len(steps))]


def sections(page):
    """The names of the sections in order, and whether each is folded."""
    found = re.findall(r'(</summary>\n)?<section id="([^"]*)">', page)
    return [(name, bool(folded)) for folded, name in found]


def test_the_top_of_the_page_is_skills_their_agreement_and_what_is_doubtful(labelled):
    found, page, _ = labelled
    names = sections(page)
    assert [name for name, folded in names if not folded] == ["test", "skills", "segments", "agreement"]
    folded = {(name, True) for name in ("learning", "dimensions", "demonstrations", "likelihood")}
    assert folded < set(names)
    header = re.search("<header>.*?</header>", page, re.DOTALL)[0]
    fitted = datetime.fromtimestamp((found.folder / "model.safetensors").stat().st_mtime)
    assert "<h1>demos.hdf5 <small>options, " in header
    assert f"{found.folder.name}, fitted {fitted:%Y-%m-%d %H:%M}</small>" in header
    for use in found.metrics.options[0][1:]:
        if use.length:
            share = words.percent(use.steps / sum(one.steps for one in found.metrics.options[0]))
            assert f'<p class="note">{share} of steps, {use.length / 20:.2g} s each' in header
    ours, equal = (words.number(scores[0].nmi) for scores in (
        found.metrics.agreement.valid, found.metrics.agreement.equal_valid
    ))  # fmt: skip
    assert f"NMI {ours} against {equal}" in header or f"NMI {equal} against {ours}" in header
    assert header.index("of steps") < header.index(" against ")
    assert [text for text, _ in training.doubts(found)] == [
        html.unescape(text) for text in re.findall('<div class="warning"><p><strong>(.*?)</strong>', header)
    ]
    assert "nats per step better" not in header
    assert '<div class="tracks" style="max-height:336px">' in page  # six of 56 pixels


def test_a_label_has_the_colour_of_the_option_that_it_is_matched_with(labelled):
    found, page, _ = labelled
    lanes = {lane["name"]: lane["colours"] for lane in embedded(page)["lanes"]}
    (table,) = found.metrics.agreement.confusion
    assert lanes["phase"] == {
        str(label): lanes["option"][option]
        for option, label in zip(table.options, table.matched, strict=True)
        if label is not None
    }
    assert lanes["phase"]


def test_a_long_list_is_folded_and_long_timelines_are_cut(labelled, monkeypatch):
    found, _, demos = labelled
    monkeypatch.setattr("ddco_pyro.report.likelihood.SHOWN", 3)
    monkeypatch.setattr("ddco_pyro.report.options.MOST_STEPS", 1)
    page = write_report(found, demos).read_text()
    seen, _, _ = page.partition("<details><summary>The other 5 demonstrations</summary>")
    listed = rows_of(page)
    assert [name for name, *_ in listed[:3]] == [name for name, *_ in rows_of(seen + "</section>")]
    assert [link is not None for _, link, *_ in listed] == [True] + 7 * [False]
    assert len(tracks(page)) == 1
    assert "ddco-pyro segment RUN FILE --html PAGE" in seen


def test_films_past_the_limit_are_links(deep, monkeypatch):
    size = (deep[0].folder / "videos" / "ddco-1000.mp4").stat().st_size
    monkeypatch.setattr(rolling, "MOST_BYTES", size)
    paths = sorted((deep[0].folder / "videos").glob("*.mp4"))
    found = rolling.films_of(deep[0].folder, paths)
    assert ["<video" in one.content for one in found] == [True, False, False]
    assert '<a href="videos/ddco-1001.mp4">' in found[1].caption


def test_names_are_escaped(tmp_path):
    key, training = "$x_{<img>$", {"epochs": 1, "starts": ["random"]}
    places = [(one, {key: one.observations["place"]}) for one in made(5)]
    odd = [replace(one, name=f"<i>{one.name}", observations=seen) for one, seen in places]
    changes = {"observations": [key], "training": training, "compare_with": []}
    page = write_report(*run(tmp_path, Demonstrations(tuple(odd)), "<b>&run", **changes)).read_text()
    assert not re.search("<(b|i|img)>", page)
    assert "&lt;b&gt;&amp;run" in page
    assert "from clusters" not in page


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """A run of two arms: one observation with six numbers."""
    training = {"epochs": 1, "starts": ["random"]}
    return run(tmp_path_factory.mktemp("arms"), made(5, 6), training=training, compare_with=[])


@pytest.mark.parametrize(
    ("drawn", "numbers", "said"),
    [
        ("place", [[0, 1, 2]], "observation “place” (the first three of its 6 numbers)"),
        (["place", "2:4"], [[2, 3]], "observation “place[2:4]”"),
        (
            [["place", "0:3"], ["place", "3:6"]],
            [[0, 1, 2], [3, 4, 5]],
            "observations “place[0:3]” (solid), “place[3:6]” (dashed)",
        ),
    ],
)
def test_what_is_drawn_is_what_the_spec_names(arms, drawn, numbers, said):
    found, demos = arms
    picture = found.folder / "figures" / "trajectories.svg"
    page = write_report(replace(found, spec=with_overrides(found.spec, {"report.trajectory": drawn})), demos)
    page = html.unescape(page.read_text())
    assert f"Drawings: {said}." in page
    assert f"by the most likely option: {said}." in page
    shown = embedded(page)["tracks"][0]
    names = [[shown["n"]["names"][place] for place in path] for path in shown["paths"]]
    assert names == [[f"place[{number}]" for number in path] for path in numbers]
    assert len(set(re.findall('stroke-dasharray="([^"]*)"', picture.read_text()))) == len(numbers)
    circles = ElementTree.parse(picture).findall("{http://www.w3.org/2000/svg}circle")
    assert len(circles) == len(demos) * len(numbers)


def test_numbers_in_words():
    assert [words.number(one) for one in (None, float("nan"), -1.234, -0.001)] == ["–", "–", "−1.23", "0.00"]
    assert [words.signed(one) for one in (1.0, -1.0, 0.0)] == ["+1.00", "−1.00", "0.00"]
    assert [words.p_value(one) for one in (0.0004, 0.0123, 1.0)] == ["< 0.001", "0.012", "1"]
    assert [words.measure(one) for one in ("success", "accuracy_mm", "picked_up")] == [
        "Success",
        "Accuracy (mm)",
        "Picked up",
    ]
