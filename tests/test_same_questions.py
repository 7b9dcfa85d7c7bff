"""``init``, ``check`` and ``fit`` ask the same questions: what one accepts the next one does not refuse."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from command_line import call
from odd_files.kinds import ROWS, drawn

from ddco_pyro.data.demonstrations import DemonstrationsError
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec

FITTED = ("grey alone", "demonstrations of one step")
"""Rows that are fitted, too."""


def started(path: Path) -> Path | None:
    """The spec that ``init`` writes; None where it refuses the file in one line, and ``inspect`` names the problem."""
    spec = path.with_suffix(".yaml")
    ended = call("init", path, "--out", spec)
    assert ended.status in (0, 2), ended.err
    if ended.status == 0:
        assert call("check", spec).status == 0
        return spec
    assert ended.err.count("\n") == 1
    return None


def fit(spec: Path) -> None:
    ended = call("fit", spec, "--out", spec.with_suffix(".run"), "--jobs", "1", "--set", "training.epochs=2")
    assert ended.status == 0, ended.err


@pytest.mark.parametrize("name", ROWS)
def test_what_init_accepts_check_accepts(name: str, tmp_path: Path) -> None:
    path, says = ROWS[name].make(tmp_path), ROWS[name].says
    spec = started(path)
    assert (spec is None) == (says is not None)
    if says:  # which `inspect` says too: a problem of the file, or a note where an observation is the control
        found = inspect(path)
        with pytest.raises(DemonstrationsError, match=says):
            starting_spec(found, path)
        said = "\n".join([*found.problems, *found.notes])
        assert re.search(says, said) or found.problems or found.leaks or all(d.constant for d in found.control)
    elif name in FITTED:
        fit(spec)


@pytest.mark.parametrize("seed", range(12))
def test_of_generated_files_too(seed: int, tmp_path: Path) -> None:
    started(drawn(tmp_path / "demos.hdf5", seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12, 72))
def test_and_what_check_accepts_is_fitted(seed: int, tmp_path: Path) -> None:
    if spec := started(drawn(tmp_path / "demos.hdf5", seed)):
        fit(spec)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.says is None])
def test_every_row_is_fitted(name: str, tmp_path: Path) -> None:
    spec = started(ROWS[name].make(tmp_path))
    assert spec is not None
    fit(spec)
