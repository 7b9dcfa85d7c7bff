"""The page of ``label`` in a browser, with other data: pictures, tasks, levels, people, many steps."""

import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace

import httpx2
import numpy as np
import pytest
from labelled import paint, until
from pages import SOON, at, items, keys, needed, playwright, point, said, served

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.fitting.fit import fit
from ddco_pyro.labelling.team import Team
from ddco_pyro.spec import with_overrides

pytestmark = needed


def test_demonstrations_are_found_by_their_task(tabs, begun, tmp_path):
    path = tmp_path / "demos.hdf5"
    tasks = ("push", "open", "push", "close", "push")
    pairs = zip(pick_and_place(5), tasks, strict=True)
    demos = (replace(demo, attributes={"task": task}) for demo, task in pairs)
    Demonstrations(tuple(demos)).write(path)
    with served(begun(path=path)) as address:
        tab = tabs(address)
        tab.get_by_label("Find a demonstration").fill("push")
        found = tab.locator("#list [role=option]:not([hidden]) strong")
        playwright.expect(found).to_have_count(3)
        assert {*found.all_text_contents()} == {"demo_0", "demo_2", "demo_4"}


PIXEL = """one => {
  const canvas = new OffscreenCanvas(1, 1), context = canvas.getContext("2d");
  context.drawImage(one, 0, 0, 1, 1);
  return [one.naturalWidth, one.naturalHeight, ...context.getImageData(0, 0, 1, 1).data];
}"""


def test_the_picture_is_that_of_the_step_at_the_cursor(tabs, begun, tmp_path):
    def pictured(number, demo):
        shape = (len(demo), 30, 40, 3)
        picture = np.full(shape, np.array([0, 60 + 20 * number, 250]), np.uint8)
        picture[..., 0] = 4 * np.arange(len(demo))[:, None, None]
        return replace(demo, observations={**demo.observations, "camera": picture})

    demos = Demonstrations(tuple(pictured(*one) for one in enumerate(pick_and_place(6))))
    demos.write(tmp_path / "demos.hdf5")
    session = begun(path=tmp_path / "demos.hdf5")

    def shows(index, step):
        def holds():
            size, colour = np.split(np.array(tab.locator("#look img").evaluate(PIXEL)), [2])
            near = np.abs(colour[:3] - [4 * step, 60 + 20 * index, 250]).max() <= 3
            return size.tolist() == [320, 240] and near  # a picture on its way has no size

        until(holds)

    with served(session) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        first = session.state()["order"][0]
        shows(first, 0)
        keys(tab, "ArrowRight", "Shift+ArrowRight")
        shows(first, 11)
        keys(tab, "End")
        shows(first, len(demos[first]) - 1)
        other = session.state()["order"][1]
        items(tab, f"demo_{other}").click()
        shows(other, 0)
        alike, own = tab.get_by_label("Alike elsewhere").locator("img").first, session.nearest(other, 0)[0]
        middle = (own["start"] + own["stop"]) // 2
        until(lambda: abs(alike.evaluate(PIXEL)[2] - 4 * middle) <= 3)


@pytest.mark.slow
def test_a_server_killed_during_an_edit_loses_nothing_that_it_acknowledged(tabs, run, file, tmp_path):
    place = [str(run.folder), str(file), "--out", str(tmp_path / "labels.hdf5"), "--no-browser"]

    @contextmanager
    def program():
        command = [sys.executable, "-m", "ddco_pyro.cli", "label", *place]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                yield process, process.stdout.readline().strip()
            finally:
                process.kill()

    acknowledged = set()

    with program() as (process, address):

        def answered(response):
            if response.url.endswith("/edit") and response.ok:
                acknowledged.add(response.request.post_data_json["step"])
                if len(acknowledged) == 3:  # the next one is under way
                    process.kill()

        tab = tabs(address)
        tab.on("response", answered)
        tab.get_by_role("slider", name="Step").focus()
        first = state_of(address)["order"][0]
        before = starts_of(address, first)
        for _ in range(12):
            keys(tab, "ArrowRight", "s")
        playwright.expect(tab.get_by_role("alert")).to_contain_text("start it again", timeout=6 * SOON)
    assert 3 <= len(acknowledged) < 10
    with program() as (_, address):
        kept = starts_of(address, first) - before
        assert acknowledged - before <= kept
        assert len(kept - acknowledged) <= 1
        playwright.expect(tabs(address).get_by_role("button", name="Undo")).to_be_enabled()


def state_of(address):
    return httpx2.get(f"{address}level/0/state", trust_env=False).json()


def starts_of(address, demo):
    """The first steps of the shown segments of a demonstration."""
    return {start for start, *_ in state_of(address)["demos"][demo]["strip"]}


FRAMES = """async work => {
  const times = [];
  let going = true;
  const turn = now => {
    times.push(now);
    if (work === "scroll") document.getElementById("list").scrollBy(0, 40);
    if (going) requestAnimationFrame(turn);
  };
  requestAnimationFrame(turn);
  await new Promise(done => setTimeout(done, 1000));
  going = false;
  return (times.length - 1) / (times.at(-1) - times[0]) * 1000;
}"""


@pytest.mark.slow
def test_two_hundred_demonstrations_of_two_thousand_steps_stay_smooth(tabs, begun, tmp_path):
    def slowed(demo):
        rows = np.linspace(0, len(demo) - 1, 2000).astype(int)
        seen = {key: own[rows] for key, own in demo.observations.items()}
        return Demonstration(demo.name, seen, demo.actions[rows])

    Demonstrations(tuple(map(slowed, pick_and_place(200)))).write(tmp_path / "demos.hdf5")
    with served(begun(path=tmp_path / "demos.hdf5")) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        assert items(tab).count() == 200
        assert tab.evaluate(FRAMES, "scroll") >= 30
        tab.get_by_label("Speed").select_option("4")
        tab.get_by_role("slider", name="Step").focus()
        keys(tab, "+", "+", "+", "+", " ")
        assert tab.evaluate(FRAMES, "play") >= 30
        assert at(tab) > 40


def test_a_click_on_a_lane_edits_its_level_and_both_are_saved(tabs, begun, run, tmp_path):
    linear = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
    levels = [{"name": "skill", "count": 4, **linear}, {"name": "stage", "count": 2, **linear}]
    fitted = fit(with_overrides(run.spec, {"hierarchy.levels": levels, "training.epochs": 3}))
    lower = begun("labels.hdf5", fit=fitted)
    upper = begun("labels.hdf5", fit=fitted, level="stage", first=lower)
    lower.beside, upper.beside = [upper], [lower]
    with served(lower, upper) as address:
        tab = tabs(address)
        heading = tab.get_by_role("heading", level=2).text_content()
        tab.mouse.click(*point(tab, 5, 45, below=24))
        said(tab, "Level stage")
        assert tab.get_by_role("heading", level=2).text_content() == heading
        playwright.expect(tab.get_by_label("Name of option 3")).to_have_count(0)
        keys(tab, "2")
        said(tab, "option 2 in")
        assert (upper.document.labels[heading] == 2).any()
        tab.mouse.click(*point(tab, 5, 45, below=75))
        said(tab, "Level skill")
        keys(tab, "x", "3")
        said(tab, "option 3 in")
        tab.get_by_role("button", name="Save").click()
        said(tab, "labels.hdf5")
    saved = Demonstrations.read(tmp_path / "labels.hdf5")
    (demo,) = (demo for demo in saved if demo.name == heading)
    assert ((demo.labels["stage"] == 2).any(), (demo.labels["skill"] == 3).any()) == (True, True)
    assert saved.masks["exclude"] == (heading,)


@pytest.mark.usefixtures("quiet")
def test_the_page_shows_another_annotators_time_line_and_takes_it_with_a_click(tabs, begun):
    ann, bob = (begun(f"labels_{me}.hdf5", team=Team(me, ("ann", "bob"), 1.0)) for me in ("ann", "bob"))
    for demo in range(6):
        paint(ann, demo, 0, 9, 3)
    with served(bob) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        keys(tab, "f", "n")
        tab.keyboard.type("look again")
        keys(tab, "Enter", "Escape")
        said(tab, "Marked")
        tab.mouse.click(*point(tab, 5, 45, below=24))
        tab.get_by_role("menuitem", name="Take the labels of ann").click()
        said(tab, "Labels of ann taken")
        playwright.expect(tab.locator("#summary")).to_contain_text("ann: 0 of 6, κ")
        tab.get_by_label("Show").select_option("flag")
        playwright.expect(items(tab).and_(tab.locator(":visible"))).to_have_count(1)
        name = tab.get_by_role("heading", level=2).text_content()
        assert (bob.document.labels[name][:9] == 3).all()
        assert bob.document.marks[name] == {"flag": True, "note": "look again"}
        sheet = tab.locator("#timeline").bounding_box()
        assert sheet["y"] + sheet["height"] <= 850, "the time line is in view"
