"""The server of ``label``: who may ask, what may be asked, and how it answers what it cannot do."""

import json
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

import anyio
import httpx2
import pytest
from killing import HANGS
from starlette.testclient import TestClient

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.server import HEADERS, MOST_BYTES, Listening, application
from ddco_pyro.labelling.session import Session

TOKEN, PORT = "a-token", 4321
BASE = f"http://127.0.0.1:{PORT}"


@pytest.fixture
def session(run, file, tmp_path, monkeypatch):
    """A session whose refits never end, and which writes two formats."""
    monkeypatch.setattr(Background, "_submit", lambda background, call: Future())
    begun = Session(
        replace(run, named={}), file, tmp_path / "labels.hdf5", exporters={"csv": one_file, "elan": a_folder}
    )
    yield begun
    begun.close()


def one_file(segmented, fit, folder, level):
    path = folder / "segments.csv"
    path.write_text(f"{len(segmented.segments)} demonstrations\n")
    return path


def a_folder(segmented, fit, folder, level):
    path = folder / "segments"
    path.mkdir()
    (path / "demo_0.eaf").write_text(f"{len(segmented.segments)} demonstrations\n")
    return path


@pytest.fixture
def client(session):
    return TestClient(application(session, TOKEN, PORT), base_url=BASE, follow_redirects=False)


def post(client, path, body, **headers):
    return client.post(f"/{TOKEN}/{path}", json=body, headers=headers)


@pytest.mark.parametrize(
    "path", ["/", "//", "/state", "/another/state", "/a-toke/state", f"/{TOKEN}", f"/x/{TOKEN}/state"]
)
def test_without_the_token_there_is_nothing(client, path):
    answer = client.get(path)
    assert (answer.status_code, answer.json()) == (404, {"error": "there is nothing here"})


def test_foreign_hosts_and_origins_are_refused_whatever_they_know(client, session):
    step = {"do": "split", "demo": 0, "step": 3}
    foreign = [{"Host": "evil.example"}, {"Host": f"evil.example:{PORT}"}]
    foreign += [
        {"Origin": origin}
        for origin in ("http://evil.example", "null", "http://127.0.0.1:1", f"https://127.0.0.1:{PORT}")
    ]
    for headers in foreign:
        assert post(client, "edit", step, **headers).status_code in (400, 403), headers
        assert client.get(f"/{TOKEN}/state", headers=headers).status_code in (400, 403), headers
    assert not session.document.done
    assert post(client, "edit", step, Host=f"localhost:{PORT}", Origin=f"http://localhost:{PORT}").status_code == 200
    assert len(session.document.done) == 1


OUTSIDE = [
    "../pyproject.toml", "../../../etc/passwd", "/etc/passwd", "static/app.js", "server.py", "../server.py",
    "app.js/../../server.py", "page.css\0", "view/-1", "demo/0/picture/x", "demo/0/../0", "export/../state",
    "export/..%2f",
]  # fmt: skip


@pytest.mark.parametrize("path", OUTSIDE)
def test_a_path_outside_the_page_is_not_there(session, path):
    """As it comes over the wire: clients resolve dots themselves."""
    sent = []

    async def asked():
        async def receive():
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message):
            sent.append(message)

        scope = {"type": "http", "method": "GET", "path": f"/{TOKEN}/{path}", "query_string": b"", "root_path": ""}
        await application(session, TOKEN, PORT)(
            {**scope, "headers": [(b"host", f"127.0.0.1:{PORT}".encode())]}, receive, send
        )

    anyio.run(asked)
    assert sent[0]["status"] in (400, 404)
    assert list(json.loads(b"".join(message.get("body", b"") for message in sent))) == ["error"]


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
        client.get("/"),
        client.get(f"/{TOKEN}/view/99"),
        client.post(f"/{TOKEN}/state"),
    ):
        assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS
    policy = HEADERS["Content-Security-Policy"]
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy


def test_methods_bodies_and_commands_are_checked(client, session):
    assert client.post(f"/{TOKEN}/state").status_code == 405
    assert client.get(f"/{TOKEN}/edit").status_code == 404
    assert client.delete(f"/{TOKEN}/save").status_code == 405
    long = json.dumps({"do": "new", "text": "x" * MOST_BYTES})
    kind = {"Content-Type": "application/json"}
    for body, headers, status in [
        (long, kind, 413),
        ((piece.encode() for piece in [long[:9], long[9:]]), kind, 413),
        ("{", kind, 400),
        ("[" * 60_000, kind, 400),
        ("[]", kind, 400),
        ("\xff".encode("latin1"), kind, 400),
        ('{"do": "undo"}', {"Content-Type": "text/plain"}, 415),
        ('{"do": "undo"}', kind, 400),
        ('{"do": "fly"}', kind, 400),
        ("{}", kind, 400),
    ]:
        answer = client.post(f"/{TOKEN}/edit", content=body, headers=headers)
        assert answer.status_code == status, answer.text
        assert "\n" not in answer.json()["error"]
    assert client.get(f"/{TOKEN}/view/99").status_code == 400
    assert client.get(f"/{TOKEN}/view/{'9' * 6000}").status_code == 400
    assert client.get(f"/{TOKEN}/export/floppy").status_code == 400
    assert not session.document.done


def test_a_failure_of_the_program_is_one_line(session):
    session.edit = lambda command: {}[0]
    answer = post(TestClient(application(session, TOKEN, PORT), base_url=BASE), "edit", {"do": "undo"})
    assert (answer.status_code, answer.json()) == (500, {"error": "unexpected KeyError: 0"})


def test_what_a_session_says_arrives(client, session, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    first = session.revision
    assert client.get(f"/{TOKEN}/state").json() == session.state()
    assert client.get(f"/{TOKEN}/poll").json() == session.progress()
    assert client.get(f"/{TOKEN}/view/2").json() == {"demo": session.demo(2), "state": session.state()}
    assert client.get(f"/{TOKEN}/demo/2/nearest/5").json() == session.nearest(2, 5)
    said = post(client, "edit", {"do": "name", "demo": 1, "step": 4, "option": 3}).json()
    assert (said["revision"] > first, said["demo"], said["done"]) == (True, 1, True)
    while session.behind:
        time.sleep(0.01)
    assert client.get(f"/{TOKEN}/state").json() == session.state()
    assert post(client, "save", {}).json() == {"message": session.save()}
    sent = client.get(f"/{TOKEN}/export/csv")
    assert (sent.text, "segments.csv" in sent.headers["content-disposition"]) == ("6 demonstrations\n", True)
    sent = client.get(f"/{TOKEN}/export/elan")
    assert "segments.zip" in sent.headers["content-disposition"]
    assert ZipFile(BytesIO(sent.content)).read("demo_0.eaf") == b"6 demonstrations\n"
    client.get(f"/{TOKEN}/export/floppy")
    assert not list(temporary.iterdir()), "an export leaves files behind"
    assert post(client, "refit", {}).status_code == 200
    assert client.get(f"/{TOKEN}/poll").json()["refit"]["running"]


def test_a_port_that_is_taken_is_named_and_tokens_differ():
    first, second = Listening.at(), Listening.at()
    try:
        assert first.socket.getsockname()[0] == "127.0.0.1"
        assert first.token != second.token
        with pytest.raises(Failed, match=f"port {first.port}: .*in use.*--port"):
            Listening.at(first.port)
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
            assert client.post("edit", json=asked).status_code == 200
            process.terminate()
            said, err = process.communicate(timeout=HANGS)
    assert (process.returncode, err) == (0, "")
    assert re.fullmatch(rf"{out}: labels/skill, 5 of \d+ steps", said.splitlines()[-1])
    assert Demonstrations.read(out)[0].labels["skill"][:6].tolist() == [2] * 5 + [-1]
