"""The page of ``label`` in a browser, as a person uses it."""

from contextlib import contextmanager
from pathlib import Path

import pytest

from ddco_pyro.labelling.server import Listening, running

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = Path("/usr/bin/chromium")
needed = pytest.mark.skipif(not CHROMIUM.exists(), reason="there is no /usr/bin/chromium")

GUTTER = 108
SOON = 5000
"""Milliseconds that the page has for what is expected."""


@contextmanager
def served(*sessions):
    """The address of sessions that are served."""
    listening = Listening.at()
    with running(sessions, listening):
        yield listening.address


def said(tab, text):
    """Wait until the page says a text."""
    playwright.expect(tab.get_by_role("status")).to_contain_text(text, timeout=SOON)


def keys(tab, *pressed):
    for key in pressed:
        tab.keyboard.press(key)


def items(tab, name=None):
    """The demonstrations in the list."""
    return tab.get_by_role("listbox").get_by_role("option", name=name)


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
