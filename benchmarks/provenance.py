"""Which code made a measurement: its command, its commit and one hash of the library's code."""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CODE = ("benchmarks", "ddco_pyro", "tasks")
"""Folders whose Python a measurement depends on."""

Record = dict[str, Any]


def record(command: str, root: Path = ROOT) -> Record:
    """The code that is about to measure. Call it before the work starts."""
    paths = sorted(path for folder in CODE for path in (root / folder).rglob("*.py"))
    digests = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    contents = {path.relative_to(root).as_posix(): digest for path, digest in digests.items()}
    code = hashlib.sha256(json.dumps(contents).encode()).hexdigest()
    commit = _git(root, "rev-parse", "--short", "HEAD")
    dirty = None if commit is None else bool(_git(root, "status", "--porcelain", "--", *CODE))
    return {"command": command, "commit": commit, "dirty": dirty, "code": code}


def text(results: Any, made_by: Record) -> str:
    """The JSON of a measurement."""
    return json.dumps({"provenance": [made_by], "results": results}, indent=1) + "\n"


def is_kept(content: Mapping[str, Any], made_by: Record) -> bool:
    """Whether this code made a measurement that was written by :func:`text`."""
    return [one["code"] for one in content["provenance"]] == [made_by["code"]]


def sentence(one: Record) -> str:
    """The line of a page that says what made it."""
    commit = f"commit {one['commit']}" if one["commit"] else "an unknown commit"
    return f"Made by `{one['command']}` at {commit}{' with uncommitted changes' if one['dirty'] else ''}."


def _git(root: Path, *arguments: str) -> str | None:
    if not (root / ".git").exists():
        return None
    ended = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
    return ended.stdout.strip() if ended.returncode == 0 else None
