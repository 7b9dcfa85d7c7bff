"""The page of ``label`` in a browser: what keys and the mouse do, and what a person sees of it."""

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import h5py
import httpx2
import numpy as np
import pytest

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.fitting.fit import fit
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.document import FREE, OPEN
from ddco_pyro.labelling.server import Listening, running
from ddco_pyro.labelling.session import Session
from ddco_pyro.labelling.team import Team
from ddco_pyro.spec import with_overrides

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = Path("/usr/bin/chromium")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason="there is no /usr/bin/chromium")

GUTTER = 108
SOON = 5000
"""Milliseconds that the page has for what is expected."""


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def session(run, file, tmp_path, monkeypatch):
    """A session of the fit; its refits are made by this process, and not after every acceptance."""
    monkeypatch.setattr(Background, "_submit", here)
    begun = Session(replace(run, named={}), file, tmp_path / "labels.hdf5")
    monkeypatch.setattr(begun, "refit", lambda: None)
    yield begun
    begun.close()


POOL = ThreadPoolExecutor()


def here(background, call):
    """Have a call made by this process."""
    return POOL.submit(call)


@contextmanager
def served(session):
    """The address of a session that is served."""
    listening = Listening.at()
    with running([session], listening):
        yield listening.address


@pytest.fixture
def tabs(browser):
    """Opens an address in a tab; whatever a tab complains of fails the test."""
    context, complaints = browser.new_context(viewport={"width": 1200, "height": 850}), []
    context.set_default_timeout(SOON)

    def opened(address, script=""):
        tab = context.new_page()
        tab.add_init_script(script)
        tab.on("response", lambda answer: complaints.append(answer.text()) if answer.status == 500 else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        tab.on(
            "request",
            lambda asked: (
                complaints.append(asked.url) if not asked.url.startswith((address, "data:", "blob:")) else None
            ),
        )
        tab.goto(address)
        return tab

    yield opened
    context.close()
    expected = ("400", "net::ERR_")  # a command is refused, and says so; the server ends before its tabs
    assert not [text for text in complaints if not any(part in text for part in expected)]


@pytest.fixture
def tab(tabs, session):
    with served(session) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        yield tab


def said(tab, text):
    """Wait until the page says a text."""
    playwright.expect(tab.get_by_role("status")).to_contain_text(text, timeout=SOON)


def keys(tab, *pressed):
    for key in pressed:
        tab.keyboard.press(key)


def items(tab, name=None):
    """The demonstrations in the list."""
    return tab.get_by_role("listbox").get_by_role("option", name=name)


def until(holds):
    """Wait until something holds."""
    end = time.monotonic() + SOON / 1000
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def at(tab):
    return int(tab.get_by_role("slider", name="Step").get_attribute("aria-valuenow"))


def point(tab, step, steps, below=40):
    """Where a step is on the time line; `below` its top is the labelled level."""
    box = tab.locator("#timeline").bounding_box()
    return box["x"] + GUTTER + step * (box["width"] - GUTTER) / steps, box["y"] + below


def labels(session, demo):
    return session.document.labels[session.demos.names[demo]]


def starts(session, demo):
    return [one.start for one in session.segments[session.demos.names[demo]]]


def test_each_key_does_what_the_list_says(tab, session):
    demo = session.state()["order"][0]
    first = starts(session, demo)
    keys(tab, "ArrowRight", "ArrowRight", "Shift+ArrowRight", "ArrowLeft")
    assert at(tab) == 11
    keys(tab, "Home", "j")
    assert at(tab) == first[1]
    keys(tab, "j", "k")
    assert at(tab) == first[1]
    keys(tab, "ArrowRight", "ArrowRight", "s")
    said(tab, "Split in")
    assert starts(session, demo)[2] == first[1] + 2
    keys(tab, "3")
    said(tab, "option 3 in")
    assert set(labels(session, demo)[first[1] + 2 : first[2]]) == {3}
    assert (labels(session, demo)[: first[1] + 2] == FREE).all()
    keys(tab, "k", "m")
    said(tab, "Merged")
    keys(tab, "0")
    said(tab, "Left open")
    assert (labels(session, demo) == OPEN).any()
    keys(tab, "u", "Control+z")
    said(tab, "Undone")
    keys(tab, "Control+z", "u")
    playwright.expect(tab.get_by_role("button", name="Undo")).to_be_disabled()
    assert starts(session, demo) == first
    assert (labels(session, demo) == FREE).all()
    keys(tab, "Shift+U", "Control+Shift+Z", "Shift+U")
    said(tab, "Done again")
    keys(tab, "Shift+Digit2")
    said(tab, "option 2 everywhere")
    assert sum((labels(session, other) == 2).any() for other in range(6)) > 1
    keys(tab, "9")
    said(tab, "There are 4 options")
    keys(tab, "?")
    playwright.expect(tab.get_by_role("dialog")).to_be_visible()
    keys(tab, "Escape", "/")
    tab.keyboard.type("demo_4")
    playwright.expect(items(tab)).to_have_count(1)
    keys(tab, "Enter")
    playwright.expect(tab.get_by_role("heading", name="demo_4")).to_be_visible()
    playwright.expect(items(tab)).to_have_count(6)
    keys(tab, "g")
    said(tab, "Boundary 1 of the")


def test_brackets_move_the_nearest_boundary_once_they_are_released(tab, session):
    demo = session.state()["order"][0]
    first = starts(session, demo)
    keys(tab, "j")
    for _ in range(2):
        tab.keyboard.down("]")
    said(tab, f"to step {first[1] + 2}")
    assert not session.document.done
    tab.keyboard.up("]")
    said(tab, "Moved in")
    assert first[1] + 2 in starts(session, demo)
    assert first[1] not in starts(session, demo)
    assert at(tab) == first[1] + 2
    keys(tab, "Shift+BracketLeft")
    said(tab, "Moved in")
    keys(tab, "Control+z", "Control+z")
    playwright.expect(tab.get_by_role("button", name="Undo")).to_be_disabled()
    assert starts(session, demo) == first


def test_a_number_that_is_held_while_playing_paints(tab, session):
    demo = session.state()["order"][0]
    keys(tab, " ")
    until(lambda: at(tab) > 3)
    before = at(tab)
    tab.keyboard.down("2")
    begin = at(tab)
    until(lambda: at(tab) > begin + 8)
    tab.keyboard.up("2")
    said(tab, "option 2 from step")
    keys(tab, " ")
    painted = np.flatnonzero(labels(session, demo) == 2)
    assert before <= painted[0] <= begin + 1
    assert len(painted) == painted[-1] - painted[0] + 1 >= 8
    assert painted[-1] < at(tab) + 1
    assert (labels(session, demo) != FREE).sum() == len(painted)


def test_the_mouse_does_it_too(tab, session):
    demo = session.state()["order"][0]
    first, steps = starts(session, demo), session.state()["demos"][demo]["steps"]

    def place(step):
        return point(tab, step, steps)

    tab.mouse.click(*place(first[1] + 3.5))
    assert at(tab) == first[1] + 3
    tab.mouse.move(*place(first[2]))
    tab.mouse.down()
    tab.mouse.move(*place(first[2] + 2.2), steps=4)
    tab.mouse.up()
    said(tab, "Moved in")
    assert first[2] + 2 in starts(session, demo)
    tab.mouse.dblclick(*place(7.5))
    said(tab, "Split in")
    assert starts(session, demo)[1] == 7
    tab.mouse.click(*place(8.5), button="right")
    tab.get_by_role("menuitem", name="option 4").click()
    said(tab, "option 4 in")
    assert set(labels(session, demo)[7 : first[1]]) == {4}
    items(tab, "demo_0").click()
    playwright.expect(tab.get_by_role("heading", name="demo_0")).to_be_visible()
    tab.get_by_role("button", name="Accept").click()
    said(tab, "Accepted in demo_0")
    assert set(session.document.accepted) == {"demo_0"}
    tab.get_by_label("Alike elsewhere").get_by_role("button").first.click()
    with tab.expect_download() as sent:
        tab.get_by_role("button", name="Export").click()
        tab.get_by_role("menuitem", name="csv").click()
    assert len(Path(sent.value.path()).read_text().splitlines()) == 1 + sum(session.demos.lengths)


def test_an_undo_goes_to_the_demonstration_that_it_changes(tab, session):
    first = session.state()["order"][0]
    keys(tab, "2", "Enter")
    said(tab, "Accepted")
    playwright.expect(tab.get_by_role("heading", level=2)).not_to_have_text(f"demo_{first}")
    keys(tab, "u")
    playwright.expect(tab.get_by_role("heading", level=2)).to_have_text(f"demo_{first}")
    said(tab, f"Undone in demo_{first}")
    assert not session.document.accepted


LATE = """
const real = window.fetch, kept = [];
window.held = null;
window.wait = () => 0;
window.release = () => { window.held = null; kept.splice(0).forEach(done => done()); };
window.fetch = async (...asked) => {
  const held = window.held && new RegExp(window.held).test(asked[0]), answer = await real(...asked);
  if (held) await new Promise(done => kept.push(done));
  await new Promise(done => setTimeout(done, window.wait()));
  return answer;
};
"""
"""Holds answers to what is asked while ``held`` matches it, until they are released, and delays every answer."""

SHUFFLED = "let seed = 1; window.wait = () => (seed = seed * 16807 % 2147483647) % 100"


def test_demonstrations_are_found_by_their_task(tabs, run, tmp_path):
    path = tmp_path / "demos.hdf5"
    tasks = ("push", "open", "push", "close", "push")
    demos = (replace(demo, attributes={"task": task}) for demo, task in zip(pick_and_place(5), tasks, strict=True))
    Demonstrations(tuple(demos)).write(path)
    session = Session(replace(run, named={}), path, tmp_path / "labels.hdf5")
    with served(session) as address:
        tab = tabs(address)
        tab.get_by_label("Find a demonstration").fill("push")
        found = tab.locator("#list [role=option]:not([hidden]) strong")
        playwright.expect(found).to_have_count(3)
        assert {*found.all_text_contents()} == {"demo_0", "demo_2", "demo_4"}
    session.close()


def test_an_answer_that_comes_late_changes_nothing(tabs, session):
    with served(session) as address:
        tab = tabs(address, LATE)
        heading, first = tab.get_by_role("heading", level=2), session.state()["order"][0]
        playwright.expect(heading).to_have_text(f"demo_{first}")
        tab.get_by_role("slider", name="Step").focus()
        tab.evaluate(f"window.held = 'view/{first}$'")
        session.edit({"do": "split", "demo": (first + 1) % 6, "step": 3})  # as another tab does; the page asks anew
        tab.wait_for_timeout(1500)
        tab.evaluate("window.held = null")
        keys(tab, "2", "Enter")
        playwright.expect(heading).not_to_have_text(f"demo_{first}")
        second = heading.text_content()
        tab.evaluate("release()")
        tab.wait_for_timeout(300)
        assert heading.text_content() == second
        keys(tab, "Enter")
        playwright.expect(heading).not_to_have_text(second)
        assert set(session.document.accepted) == {f"demo_{first}", second}


def test_enter_accepts_one_after_the_other_in_whichever_order_answers_come(tabs, session):
    with served(session) as address:
        tab = tabs(address, LATE)
        heading = tab.get_by_role("heading", level=2)
        tab.get_by_role("slider", name="Step").focus()
        tab.evaluate(SHUFFLED)
        for number in range(6):
            before = heading.text_content()
            keys(tab, "Enter", "Enter")  # the second one is for nothing
            if number < 5:
                playwright.expect(heading).not_to_have_text(before)
        said(tab, "All demonstrations are accepted")
        keys(tab, "Enter")
        said(tab, "All demonstrations are accepted")
        assert len(session.document.accepted) == len(session.document.done) == 6
        tab.get_by_role("button", name="Take back").click()
        said(tab, "Taken back")
        assert len(session.document.accepted) == 5


def test_new_options_that_are_typed_one_after_the_other_have_their_own_names(tabs, session):
    with served(session) as address:
        tab = tabs(address, LATE)
        added = tab.get_by_label("Name of a new option")
        added.click()  # once it can be seen
        tab.evaluate(SHUFFLED)
        for name in ("wait", "none", "turn"):
            tab.keyboard.type(name)
            keys(tab, "Enter")
        playwright.expect(tab.get_by_label("Name of option 7")).to_have_value("turn")
        assert session.document.names[4:] == ("wait", "none", "turn")
        playwright.expect(added).to_have_value("")


def test_an_undo_of_a_name_stays_where_it_is_and_what_changes_nothing_cannot_be_undone(tab, session):
    heading = tab.get_by_role("heading", level=2).text_content()
    tab.get_by_label("Name of option 2").fill("squeeze")
    keys(tab, "Enter", "Escape")
    said(tab, "Renamed")
    keys(tab, "u")
    said(tab, f"Undone in {heading}")
    playwright.expect(tab.get_by_label("Name of option 2")).to_have_value("option 2")
    keys(tab, "0")
    said(tab, "Left open")
    keys(tab, "0")
    said(tab, "That changes nothing")
    keys(tab, "u")
    playwright.expect(tab.get_by_role("button", name="Undo")).to_be_disabled()


def test_the_keyboard_alone_does_everything(tab, session):
    first = session.state()["order"][0]
    reached = set()
    for _ in range(60):
        keys(tab, "Shift+Tab")
        reached.add(tab.evaluate("[document.activeElement.ariaLabel, document.activeElement.textContent].join(' ')"))
    for name in ("Name of option 2", "Name of a new option", "Demonstrations", "Save", "Step"):
        assert any(name in one for one in reached), f"Tab does not lead to {name}"
    tab.get_by_label("Name of a new option").focus()
    tab.keyboard.type("wait 1")
    keys(tab, "Enter")
    said(tab, "New option")
    assert (labels(session, first) == FREE).all(), "what is typed into a name is no key"
    keys(tab, "Escape", "5")
    said(tab, "wait 1 in")
    assert (labels(session, first) == 5).any()
    keys(tab, "Shift+F10", "ArrowDown", "Enter")
    said(tab, "option 2 in")
    assert (labels(session, first) == 2).any()
    tab.get_by_role("listbox").focus()
    before = tab.get_by_role("heading", level=2).text_content()
    keys(tab, "ArrowDown")
    playwright.expect(tab.get_by_role("heading", level=2)).not_to_have_text(before)
    tab.get_by_role("button", name="Save").focus()
    keys(tab, "Enter")
    said(tab, "labels.hdf5")
    with h5py.File(session.out) as written:
        saved = {name: demo["labels/skill"][:] for name, demo in written["data"].items()}
    assert {name for name, own in saved.items() if (own != FREE).any()} == {session.demos.names[first]}


def test_two_tabs_agree_and_a_reload_loses_nothing(tab, tabs, session):
    other = tabs(tab.url.partition("#")[0])
    demo = session.state()["order"][0]
    keys(tab, "j", "ArrowRight", "s")
    said(tab, "Split in")
    playwright.expect(other.get_by_role("button", name="Undo")).to_be_enabled()
    other.get_by_role("slider", name="Step").focus()
    keys(other, "u")
    said(other, "Undone")
    playwright.expect(tab.get_by_role("button", name="Undo")).to_be_disabled()
    step = at(tab)
    until(lambda: tab.url.endswith(f"#{demo}/{step}"))
    tab.reload()
    playwright.expect(tab.get_by_role("heading", level=2)).to_have_text(f"demo_{demo}")
    assert at(tab) == step


def test_what_changed_elsewhere_is_marked_until_it_is_looked_at(tab, session):
    keys(tab, "Shift+Digit2", "Shift+Digit3")
    said(tab, "option 3 everywhere")
    other = session.state()["order"][-1]
    row = items(tab, f"demo_{other}")
    playwright.expect(row).to_contain_text("changed")
    row.click()
    playwright.expect(row).not_to_contain_text("changed")


def test_a_refit_says_how_far_it_is_is_cancelled_and_said_when_it_is_done(tab, session, monkeypatch):
    monkeypatch.undo()
    going = threading.Event()

    def waiting(call):
        assert going.wait(SOON)
        return call()

    monkeypatch.setattr(Background, "_submit", lambda background, call: POOL.submit(waiting, call))
    keys(tab, "2", "Enter")
    bar = tab.get_by_role("progressbar")
    playwright.expect(bar).to_be_visible()
    assert bar.get_attribute("value") is None
    session.background._told.write_text("0.2500\n")
    playwright.expect(bar).to_have_js_property("value", 0.25)
    playwright.expect(tab.get_by_role("button", name="Refit")).to_be_disabled()
    keys(tab, "c")
    said(tab, "Cancelled")
    playwright.expect(bar).to_be_hidden()
    keys(tab, "r")
    playwright.expect(bar).to_be_visible()
    going.set()
    said(tab, "Refit 1 is done: expected wrong steps")
    playwright.expect(bar).to_be_hidden()


PIXEL = """one => {
  const canvas = new OffscreenCanvas(1, 1), context = canvas.getContext("2d");
  context.drawImage(one, 0, 0, 1, 1);
  return [one.naturalWidth, one.naturalHeight, ...context.getImageData(0, 0, 1, 1).data];
}"""


def test_the_picture_is_that_of_the_step_at_the_cursor(tabs, run, tmp_path):
    def pictured(number, demo):
        shape = (len(demo), 30, 40, 3)
        picture = np.full(shape, np.array([0, 60 + 20 * number, 250]), np.uint8)
        picture[..., 0] = 4 * np.arange(len(demo))[:, None, None]
        return replace(demo, observations={**demo.observations, "camera": picture})

    demos = Demonstrations(tuple(pictured(*one) for one in enumerate(pick_and_place(6))))
    demos.write(tmp_path / "demos.hdf5")
    session = Session(replace(run, named={}), tmp_path / "demos.hdf5", tmp_path / "labels.hdf5")

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
    session.close()


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


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_has_no_serious_complaint(browser, session, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")
    context = browser.new_context(color_scheme=scheme, bypass_csp=True)
    with served(session) as address:
        tab = context.new_page()
        tab.goto(address)

        def complaints():
            found = axe.Axe().run(tab).response["violations"]
            return [(one["id"], one["nodes"][0]["html"]) for one in found if one["impact"] in ("serious", "critical")]

        assert complaints() == []
        tab.get_by_role("slider", name="Step").focus()
        keys(tab, "0")
        said(tab, "Left open")
        keys(tab, "9")
        said(tab, "There are 4 options")
        keys(tab, "Enter")
        said(tab, "Accepted")
        assert complaints() == []
        keys(tab, "?")
        assert complaints() == []
        keys(tab, "Escape", "Shift+F10")
        assert complaints() == []
    context.close()


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
def test_two_hundred_demonstrations_of_two_thousand_steps_stay_smooth(tabs, run, tmp_path):
    def slowed(demo):
        rows = np.linspace(0, len(demo) - 1, 2000).astype(int)
        return Demonstration(demo.name, {key: own[rows] for key, own in demo.observations.items()}, demo.actions[rows])

    Demonstrations(tuple(map(slowed, pick_and_place(200)))).write(tmp_path / "demos.hdf5")
    session = Session(replace(run, named={}), tmp_path / "demos.hdf5", tmp_path / "labels.hdf5")
    with served(session) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        assert items(tab).count() == 200
        assert tab.evaluate(FRAMES, "scroll") >= 30
        tab.get_by_label("Speed").select_option("4")
        tab.get_by_role("slider", name="Step").focus()
        keys(tab, "+", "+", "+", "+", " ")
        assert tab.evaluate(FRAMES, "play") >= 30
        assert at(tab) > 40
    session.close()


def test_a_click_on_a_lane_edits_its_level_and_both_are_saved(tabs, run, file, tmp_path, monkeypatch):
    monkeypatch.setattr(Background, "_submit", here)
    linear = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
    levels = [{"name": "skill", "count": 4, **linear}, {"name": "stage", "count": 2, **linear}]
    fitted = fit(with_overrides(run.spec, {"hierarchy.levels": levels, "training.epochs": 3}))
    lower = Session(fitted, file, tmp_path / "labels.hdf5")
    upper = Session(fitted, file, tmp_path / "labels.hdf5", "stage", first=lower)
    lower.beside, upper.beside = [upper], [lower]
    listening = Listening.at()
    with running([lower, upper], listening):
        tab = tabs(listening.address)
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
    for session in (lower, upper):
        session.close()


def test_the_page_shows_another_annotators_time_line_and_takes_it_with_a_click(tabs, run, file, tmp_path, monkeypatch):
    monkeypatch.setattr(Session, "refit", lambda session: None)
    sessions = [
        Session(replace(run, named={}), file, tmp_path / f"labels_{me}.hdf5", team=Team(me, ("ann", "bob"), 1.0))
        for me in ("ann", "bob")
    ]
    for demo in range(6):
        sessions[0].edit({"do": "paint", "demo": demo, "start": 0, "stop": 9, "option": 3})
    with served(sessions[1]) as address:
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
        assert (sessions[1].document.labels[name][:9] == 3).all()
        assert sessions[1].document.marks[name] == {"flag": True, "note": "look again"}
        sheet = tab.locator("#timeline").bounding_box()
        assert sheet["y"] + sheet["height"] <= 850, "the time line is in view"
    for session in sessions:
        session.journal.close()
