"""Demonstrations collected from a task's supervisor, in parallel, kept by content and reused."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from ddco_pyro.data.demonstrations import DemonstrationsError
from ddco_pyro.data.resumable import Parts, parts_of
from ddco_pyro.events import DemonstrationsDone, OnEvent, ignore
from ddco_pyro.simulation.episodes import run_episodes, summarize
from ddco_pyro.simulation.task import Task, find_task
from ddco_pyro.spec import DemonstrationsSpec


def cache_folder() -> Path:
    """``$DDCO_PYRO_CACHE``, else ``ddco-pyro`` in the user's cache folder."""
    own = os.environ.get("DDCO_PYRO_CACHE")
    general = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(own) if own else Path(general) / "ddco-pyro"


def cache_path(task: Task, name: str, spec: DemonstrationsSpec) -> Path:
    """Where demonstrations of this task, policy, number and seeds are kept: the name changes with the task's code."""
    return cache_folder() / "demonstrations" / f"{task.name}-{_identity(task, name, spec)[:16]}.hdf5"


def _identity(task: Task, name: str, spec: DemonstrationsSpec) -> str:
    """A digest of all that decides what is recorded."""
    digest = hashlib.sha256(json.dumps([name, spec.supervisor, spec.count, spec.seed]).encode())
    for source in sorted(task.sources):
        digest.update(hashlib.sha256(source.read_bytes()).digest())
    return digest.hexdigest()


def collect(task_name: str, spec: DemonstrationsSpec, path: Path | None = None, on_event: OnEvent = ignore) -> Path:
    """Record ``spec.count`` demonstrations, unless the file is there already; the path of the file.

    Each is kept as soon as it is recorded: after an interruption the next call goes on with those that are missing.

    The root of the file says how often the supervisor succeeded itself (``supervisor``, as JSON).

    :raises DemonstrationsError: the task has no such scripted policy.
    """
    task = find_task(task_name)
    if spec.supervisor not in task.policies:
        known = ", ".join(sorted(task.policies))
        raise DemonstrationsError(f"task {task.name!r} has no policy {spec.supervisor!r} to record (it has: {known})")
    path = path or cache_path(task, task_name, spec)
    if path.exists():
        return path
    with parts_of(path, _identity(task, task_name, spec), wait=True, at_most=1) as parts:
        if parts is None:
            return path
        seeds = range(spec.seed + len(parts.done), spec.seed + spec.count)
        for episode in run_episodes(task_name, spec.supervisor, seeds):
            parts.add(episode.record.recording())
            on_event(DemonstrationsDone(len(parts.done), spec.count))
        attributes = {"task": task.name, "policy": spec.supervisor, "supervisor": json.dumps(_summary(task, parts))}
        parts.finish(attributes, {})
    return path


def _summary(task: Task, parts: Parts) -> dict[str, Any]:
    """How often the supervisor succeeded itself."""
    facts = parts.attributes()
    return summarize(
        task,
        [{name: float(value) for name, value in demo.items() if name not in ("seed", "num_samples")} for demo in facts],
    )
