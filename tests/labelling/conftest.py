"""A fit of planted demonstrations, for sessions, their page and their server."""

from dataclasses import replace

import pytest
from labelled import here, refitted
from planted import small_spec

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.fitting.fit import fit
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.session import Session


@pytest.fixture(scope="package")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "demos.hdf5"
    pick_and_place(6).write(path)
    return path


@pytest.fixture(scope="package")
def run(file, tmp_path_factory):
    spec = small_spec(
        (4,),
        name="skill",
        demonstrations={"path": str(file), "valid_fraction": 0},
        observations=["gripper", "object", "goal", "jaw"],
        control={"std": {"learn": True, "floor": 0.01, "per_option": True}, "power": 0.1},
        training={"optimizer": {"name": "em"}, "tune_fraction": 0, "epochs": 5},
        report={"trajectory": "gripper"},
    )
    return fit(spec, out=tmp_path_factory.mktemp("run") / "run")


@pytest.fixture(scope="package")
def demos(file):
    return Demonstrations.read(file)


@pytest.fixture
def begun(run, file, tmp_path, monkeypatch):
    """Begins a session, and leaves it to others at the end; refits are made by this process."""
    monkeypatch.setattr(Background, "_submit", here)
    sessions = []

    def begin(out="out.hdf5", path=file, fit=None, **more):
        sessions.append(Session(fit or replace(run, named={}), path, tmp_path / out, **more))
        return sessions[-1]

    yield begin
    for session in sessions:
        refitted(session)
        session.journal.close()


@pytest.fixture
def begin(begun, demos, tmp_path):
    """The same with a file of its own."""
    demos.write(tmp_path / "demos.hdf5")
    return lambda out="out.hdf5": begun(out, tmp_path / "demos.hdf5")


@pytest.fixture
def quiet(monkeypatch):
    """No refit follows an accepted demonstration."""
    monkeypatch.setattr(Session, "refit", lambda session: None)


@pytest.fixture(scope="package")
def browser():
    from pages import CHROMIUM, playwright

    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def tabs(browser):
    """Opens an address in a tab; whatever a tab complains of fails the test."""
    context, complaints = browser.new_context(viewport={"width": 1200, "height": 850}), []
    context.set_default_timeout(5000)

    def opened(address, script=""):
        tab = context.new_page()
        tab.add_init_script(script)
        tab.on("response", lambda answer: complaints.append(answer.text()) if answer.status == 500 else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on(
            "console", lambda message: complaints.append(message.text) if message.type == "error" else None
        )
        own = (address, "data:", "blob:")
        tab.on("request", lambda asked: None if asked.url.startswith(own) else complaints.append(asked.url))
        tab.goto(address)
        return tab

    yield opened
    context.close()
    expected = ("400", "net::ERR_")  # a command is refused, and says so; the server ends before its tabs
    assert not [text for text in complaints if not any(part in text for part in expected)]
