"""The command line as tests call it."""

from __future__ import annotations

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


def with_set(*overrides):
    return [argument for override in overrides for argument in ("--set", override)]
