"""Every odd file with every command that takes one: done, or refused in a line, and nothing else changed."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import forked
import pytest
import yaml
from command_line import call
from odd_files import Row, lerobot, rows, snapshot

MEMORY = 500 * 10**6
ROWS = rows()
TESTED = {*lerobot.PATHS, *lerobot.EPISODES_NOT_WHOLE}
PROGRESS = re.compile(r"\w+: \d+/\d+|note: ")


def commands(path: Path, out: Path, run: Path) -> Iterator[tuple[object, ...]]:
    """Those that take such a file; what they write is named ``written`` in ``out``."""
    written = out / "written"
    if path.suffix == ".yaml":
        yield "check", path
        yield "fit", path, "--out", written
        return
    yield "inspect", path
    if not path.is_dir():  # the others are to be imported first
        yield "init", path, "--out", written
        spec, policy = out / "spec.yaml", {"kind": "flat", "policy": {"network": "linear"}}
        data = {"demonstrations": {"path": str(path)}, "observations": ["offsets"], "baseline": policy}
        spec.write_text(yaml.safe_dump(data))
        yield "check", spec
    yield "import", path, "--out", written
    yield "segment", run, path, "--csv", written


ASIDE = "check", "segment"
"""What these say of a file may be something else: the spec and the run may be about other observations."""


def tried(command: tuple[object, ...], folder: Path, out: Path, before: dict[str, tuple[object, ...]]):
    """A command, how it ended, whether other files stayed as they were, and the names of those written."""
    ended = call(*command)
    stayed, wrote = snapshot(folder, out) == before, {one.name for one in out.iterdir()}
    for one in out.glob("*"):
        one.unlink()
    return command, ended, stayed, wrote


@pytest.fixture(scope="module")
def warm(toy_run, tmp_path_factory) -> Path:
    """The folder of a run, once every command was called here: what they import and compile is then there."""
    folder, out = tmp_path_factory.mktemp("warm"), tmp_path_factory.mktemp("out")
    for row in (ROWS["hdf5: ordinary"], ROWS["hdf5: spec: of a device"]):
        for command in commands(row.make(folder), out, toy_run.folder):
            call(*command)
            (out / "written").unlink(missing_ok=True)
    return toy_run.folder


ELSEWHERE = ("kinds", "layouts")
"""Tables whose rows have tests of their own, beside the reader that they are about."""


HERE = [name for name in ROWS if not name.startswith(ELSEWHERE)]


@pytest.mark.parametrize("name", [name for name in HERE if name.removeprefix("lerobot: ") not in TESTED])
@pytest.mark.usefixtures("undecided")  # but once, in ``warm``
def test_an_odd_file(name: str, tmp_path: Path, warm: Path) -> None:
    row: Row = ROWS[name]
    folder, out = tmp_path / "odd", tmp_path / "out"
    folder.mkdir()
    path = row.make(folder)
    out.mkdir()
    before = snapshot(tmp_path, out)

    def all_but_segment():
        given = commands(path, out, warm)
        return [tried(command, tmp_path, out, before) for command in given if command[0] != "segment"]

    child = forked.run(all_but_segment)
    assert (child.status, child.grown < MEMORY) == (0, True), child
    began, found = time.process_time(), child.value
    for command in commands(path, out, warm):
        if command[0] == "segment":  # kernels that run on threads cannot be called in a fork
            found.append(tried(command, tmp_path, out, before))
    assert time.process_time() - began < forked.SECONDS
    refused = []
    for command, ended, stayed, wrote in found:
        shown = f"{' '.join(map(str, command))}\n{ended}"
        assert ended.status in (0, 2), shown
        lines = [line for line in ended.err.splitlines() if not PROGRESS.match(line)]
        assert [line[:11] for line in lines] == ["ddco-pyro: "] * (ended.status == 2), shown
        assert stayed, shown
        assert wrote <= {"written", "spec.yaml"}, shown
        if command[0] not in ASIDE or path.suffix == ".yaml":
            if ended.status and (row.says is not None or command[0] != "import"):
                refused.append(command[0])
            if row.says is not None and (ended.status or command == ("inspect", path)):
                assert re.search(row.says, ended.err + ended.out), shown
    assert (row.says is None) == (not refused), refused
