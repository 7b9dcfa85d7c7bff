"""The page of ``label`` in a browser: what keys and the mouse do, and what a person sees of it."""

import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
from labelled import POOL, until
from pages import SOON, at, items, keys, labels, needed, playwright, point, said, served, starts

from ddco_pyro.events import Counted
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.document import FREE, OPEN

pytestmark = needed


@pytest.fixture
def session(begun, monkeypatch):
    """A session of the fit; no refit follows an accepted demonstration."""
    session = begun("labels.hdf5")
    monkeypatch.setattr(session, "refit", lambda: None)
    yield session
    session.close()


@pytest.fixture
def tab(tabs, session):
    with served(session) as address:
        tab = tabs(address)
        tab.get_by_role("slider", name="Step").focus()
        yield tab


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
"""Holds answers to what is asked while ``held`` matches it, until released, and delays all answers."""

SHUFFLED = "let seed = 1; window.wait = () => (seed = seed * 16807 % 2147483647) % 100"


def test_an_answer_that_comes_late_changes_nothing(tabs, session):
    with served(session) as address:
        tab = tabs(address, LATE)
        heading, first = tab.get_by_role("heading", level=2), session.state()["order"][0]
        playwright.expect(heading).to_have_text(f"demo_{first}")
        tab.get_by_role("slider", name="Step").focus()
        tab.evaluate(f"window.held = 'view/{first}$'")
        # as another tab does; the page asks anew
        session.edit({"do": "split", "demo": (first + 1) % 6, "step": 3})
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
        both = "[document.activeElement.ariaLabel, document.activeElement.textContent]"
        reached.add(tab.evaluate(f"{both}.join(' ')"))
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


def test_the_page_says_how_far_features_of_pictures_are(tab, session):
    told, go = tab.locator("#features"), threading.Event()

    def compute(on_event):
        on_event(Counted("encoding", 4, done=1))
        go.wait()
        return {name: np.zeros((steps, 2), np.float32) for name, steps in session.document.lengths.items()}

    session.encoding.begin(compute, session._look)
    playwright.expect(told).to_have_text("features of pictures: 25%")
    go.set()
    playwright.expect(told).to_have_text("proposals read the pictures")


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_has_no_serious_complaint(browser, session, scheme):
    why = "axe-playwright-python is not installed"
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason=why)
    context = browser.new_context(color_scheme=scheme, bypass_csp=True)
    with served(session) as address:
        tab = context.new_page()
        tab.goto(address)

        def complaints():
            found = axe.Axe().run(tab).response["violations"]
            serious = [one for one in found if one["impact"] in ("serious", "critical")]
            return [(one["id"], one["nodes"][0]["html"]) for one in serious]

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
