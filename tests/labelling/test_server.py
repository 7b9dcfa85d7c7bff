"""The server of ``label``: who may ask, what may be asked, and how it answers what it cannot do."""

import re
import socket
import subprocess
import sys
import time
from concurrent.futures import Future
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import httpx2
import pytest
from killing import HANGS
from starlette.testclient import TestClient

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.server import HEADERS, Listening, application
from ddco_pyro.labelling.session import Session

TOKEN, PORT = "a-token", 4321
BASE = f"http://127.0.0.1:{PORT}"


@pytest.fixture
def session(run, file, tmp_path, monkeypatch):
    """A session whose refits never end."""
    monkeypatch.setattr(Background, "_submit", lambda background, call: Future())
    begun = Session(replace(run, named={}), file, tmp_path / "labels.hdf5")
    yield begun
    begun.close()


@pytest.fixture
def client(session):
    return TestClient(application([session], TOKEN), base_url=BASE, follow_redirects=False)


def post(client, path, body, **headers):
    return client.post(f"/{TOKEN}/level/0/{path}", json=body, headers=headers)


OUTSIDE = ["/a-toke/state", f"/{TOKEN}/../state", f"/{TOKEN}/..%2f..%2fserver.py"]


@pytest.mark.parametrize("path", ["/", "/state", "/another/state", *OUTSIDE])
def test_without_the_token_or_outside_the_page_there_is_nothing(client, path):
    answer = client.get(path)
    assert (answer.status_code, [*answer.json()]) == (404, ["error"])


def test_foreign_hosts_are_refused_whatever_they_know(client, session):
    step = {"do": "split", "demo": 0, "step": 3}
    assert post(client, "edit", step, Host="evil.example").status_code == 400
    assert client.get(f"/{TOKEN}/level/0/state", headers={"Host": f"evil.example:{PORT}"}).status_code == 400
    assert not session.document.done
    assert post(client, "edit", step, Host=f"localhost:{PORT}").status_code == 200
    assert len(session.document.done) == 1


def test_the_page_asks_for_nothing_outside_its_table_and_every_answer_is_guarded(client):
    folder = Path(__file__).parents[2] / "ddco_pyro"
    for file in (*(folder / "labelling" / "static").iterdir(), folder / "drawing" / "canvas.js"):
        answer = client.get(f"/{TOKEN}/{file.name.replace('index.html', '')}")
        assert answer.content == file.read_bytes()
        assert answer.headers["content-type"].startswith(
            {".js": "text/javascript", ".css": "text/css"}.get(file.suffix, "text/html")
        )
        assert "//" not in answer.text.replace("// ", ""), f"{file} names an address"
        assert " style=" not in answer.text
    for answer in (
        client.get(f"/{TOKEN}/"),
        client.get(f"/{TOKEN}/level/0/view/99"),
        client.post(f"/{TOKEN}/level/0/state"),
    ):
        assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS
    policy = HEADERS["Content-Security-Policy"]
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy


def test_bodies_and_commands_are_checked(client, session):
    for body in ("{", '{"do": "undo"}', '{"do": "fly"}', "{}"):
        answer = client.post(f"/{TOKEN}/level/0/edit", content=body)
        assert answer.status_code == 400, answer.text
        assert "\n" not in answer.json()["error"]
    assert client.get(f"/{TOKEN}/level/0/view/99").status_code == 400
    assert client.get(f"/{TOKEN}/level/0/export/floppy").status_code == 400
    assert not session.document.done


def test_a_failure_of_the_program_is_one_line(session):
    session.edit = lambda command: {}[0]
    answer = post(TestClient(application([session], TOKEN), base_url=BASE), "edit", {"do": "undo"})
    assert (answer.status_code, answer.json()) == (500, {"error": "unexpected KeyError: 0"})


def test_what_a_session_says_arrives(client, session, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    first = session.revision
    assert client.get(f"/{TOKEN}/level/0/state").json() == session.state()
    assert client.get(f"/{TOKEN}/level/0/poll").json() == session.progress()
    shown = {"demo": session.demo(2), "state": session.state()}
    assert client.get(f"/{TOKEN}/level/0/view/2").json() == shown
    assert client.get(f"/{TOKEN}/level/0/demo/2/nearest/5").json() == session.nearest(2, 5)
    said = post(client, "edit", {"do": "name", "demo": 1, "step": 4, "option": 3}).json()
    assert (said["revision"] > first, said["demo"], said["done"]) == (True, 1, True)
    while session.behind:
        time.sleep(0.01)
    assert client.get(f"/{TOKEN}/level/0/state").json() == session.state()
    assert post(client, "save", {}).json() == {"message": session.save()}
    sent = client.get(f"/{TOKEN}/level/0/export/csv")
    assert "segments.csv" in sent.headers["content-disposition"]
    assert len(sent.text.splitlines()) == 1 + sum(session.demos.lengths)
    sent = client.get(f"/{TOKEN}/level/0/export/elan")
    assert "segments.zip" in sent.headers["content-disposition"]
    assert {*ZipFile(BytesIO(sent.content)).namelist()} >= {f"{name}.eaf" for name in session.demos.names}
    client.get(f"/{TOKEN}/level/0/export/floppy")
    assert not list(temporary.iterdir()), "an export leaves files behind"
    assert post(client, "refit", {}).status_code == 200
    assert client.get(f"/{TOKEN}/level/0/poll").json()["refit"]["running"]


def test_a_port_that_is_taken_is_named_and_tokens_differ():
    first, second = Listening.at(), Listening.at()
    try:
        assert first.socket.getsockname()[0] == "127.0.0.1"
        assert first.token != second.token
        with pytest.raises(Failed, match=f"port {first.socket.getsockname()[1]}: .*in use.*--port"):
            Listening.at(first.socket.getsockname()[1])
        with pytest.raises(Failed, match="--port"):
            Listening.at(70000)
    finally:
        first.socket.close()
        second.socket.close()


def test_an_interrupt_saves_and_ends_with_one_line(run, file, tmp_path):
    out = tmp_path / "labels.hdf5"
    command = [sys.executable, "-m", "ddco_pyro.cli", "label", run.folder, file, "--out", out, "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline().strip()
        with httpx2.Client(base_url=address, trust_env=False) as client, socket.socket() as idle:
            idle.connect(("127.0.0.1", httpx2.URL(address).port))
            asked = {"do": "paint", "demo": 0, "start": 0, "stop": 5, "option": 2}
            assert client.post("level/0/edit", json=asked).status_code == 200
            process.terminate()
            said, err = process.communicate(timeout=HANGS)
    assert (process.returncode, err) == (0, "")
    assert re.fullmatch(rf"{out}: labels/skill, 5 of \d+ steps", said.splitlines()[-1])
    assert Demonstrations.read(out)[0].labels["skill"][:6].tolist() == [2] * 5 + [-1]
