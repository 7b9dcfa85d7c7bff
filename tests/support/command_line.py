"""The command line as tests call it."""

import contextlib
import io
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest

from ddco_pyro.cli.app import main

HERE = Path(__file__).parent
"""The folder of the toy task."""

COMMAND = Path(sys.executable).with_name("ddco-pyro")


class Ended(NamedTuple):
    status: int
    out: str
    err: str


def call(*arguments):
    """The command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["ddco-pyro", *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return Ended(ended.value.code, out.getvalue(), err.getvalue())


def done(*arguments):
    """The command line in this process, which does what it is asked."""
    ended = call(*arguments)
    assert ended.status == 0, ended.err
    return ended


def refused(says, *arguments):
    """The command line in this process, which refuses and says this in its one line."""
    ended = call(*arguments)
    assert (ended.status, ended.err.count("\n"), says in ended.err) == (2, 1, True), ended
    return ended


def with_set(*overrides):
    return [argument for override in overrides for argument in ("--set", override)]
