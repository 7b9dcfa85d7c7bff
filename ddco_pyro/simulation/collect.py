"""Collection of demonstrations from a task's supervisor, in parallel, with a cache."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
from collections.abc import Collection
from importlib.metadata import entry_points
from pathlib import Path

from ddco_pyro.data.demonstration import Attribute
from ddco_pyro.data.demonstrations import DemonstrationsError
from ddco_pyro.data.files import only_one
from ddco_pyro.data.hdf5 import opened
from ddco_pyro.data.sources.robomimic import robomimic_file, write_demonstration
from ddco_pyro.errors import BadInput
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.simulation.episodes import run_episodes, summarize
from ddco_pyro.simulation.task import Task, find_task
from ddco_pyro.spec import DemonstrationsSpec
from ddco_pyro.spec.base import TASKS

SIMULATORS = ("mujoco", "dm-control")
"""Packages whose version can change a task's episodes."""

EPISODES_WITH_PICTURES = 8
"""Episodes with pictures in memory at a time. Compression is sequential and slower than drawing."""


def cache_path(task: Task, name: str, spec: DemonstrationsSpec, observed: Collection[str] = ()) -> Path:
    """The cached file of demonstrations of this task, policy, number, seeds and cameras.

    Its name changes with the task's code, encoders and package version, and with the simulators' versions.
    The folder is ``$DDCO_PYRO_CACHE``, or ``ddco-pyro`` in the user's cache folder.
    """
    cameras = [[camera, task.cameras[camera].digest] for camera in task.seen_by_cameras(observed)]
    package = next((point.dist for point in entry_points(group=TASKS, name=name) if point.dist), None)
    own = package and importlib.metadata.version(package.name)
    versions = [*map(importlib.metadata.version, SIMULATORS), own]
    facts = [name, spec.supervisor, spec.count, spec.seed, cameras, versions]
    digest = hashlib.sha256(json.dumps(facts).encode())
    for source in sorted(task.sources):
        digest.update(hashlib.sha256(source.read_bytes()).digest())
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = Path(os.environ.get("DDCO_PYRO_CACHE") or user / "ddco-pyro")
    return folder / "demonstrations" / f"{task.name}-{digest.hexdigest()[:16]}.hdf5"


def collect(
    task_name: str,
    spec: DemonstrationsSpec,
    path: Path | None = None,
    on_event: OnEvent = ignore,
    observed: Collection[str] = (),
) -> Path:
    """Record ``spec.count`` demonstrations into a file, unless the file exists; returns its path.

    The root attribute ``supervisor`` holds the supervisor's own success rate, as JSON. Of several processes
    that want the same file one records it, and the others wait.

    :param path: the file; by default one in the cache.
    :param observed: the spec's observations; the task's cameras among them are recorded.
    :raises DemonstrationsError: the task has no such scripted policy.
    :raises BadInput: the file exists and holds other demonstrations.
    """
    task = find_task(task_name)
    if spec.supervisor not in task.policies:
        known = ", ".join(sorted(task.policies))
        why = f"has no policy {spec.supervisor!r} to record (it has: {known})"
        raise DemonstrationsError(f"task {task.name!r} {why}")
    if path is not None and path.exists():
        _refuse_others(path, task, spec)
    path = path or cache_path(task, task_name, spec, observed)
    lock = path.with_name(f".{path.name}.lock")
    if not path.exists():
        with only_one(lock, wait=True):
            try:
                if not path.exists():
                    _record(task, task_name, spec, path, on_event, observed)
            finally:
                lock.rmdir()
    return path


def _record(
    task: Task, name: str, spec: DemonstrationsSpec, path: Path, on_event: OnEvent, observed: Collection[str]
) -> None:
    at_once = EPISODES_WITH_PICTURES if task.seen_by_cameras(observed) else spec.count
    seeds = range(spec.seed, spec.seed + spec.count)
    attributes: dict[str, Attribute] = {"task": task.name, "policy": spec.supervisor}
    outcomes = []
    with robomimic_file(path, attributes, {}) as data:
        for first in range(0, len(seeds), at_once):
            some = seeds[first : first + at_once]
            for episode in run_episodes(name, spec.supervisor, some, observed=observed):
                write_demonstration(data, episode.record)
                outcomes.append(episode.outcome)
                on_event(Counted("collecting demonstrations", spec.count, done=len(data)))
        attributes["supervisor"] = json.dumps(
            {key: one.model_dump() for key, one in summarize(task, outcomes).items()}
        )


def _refuse_others(path: Path, task: Task, spec: DemonstrationsSpec) -> None:
    """Check that a file holds these demonstrations."""
    names = {f"demo_{seed}" for seed in range(spec.seed, spec.seed + spec.count)}
    with opened(path) as file:
        about = (file.attrs.get("task"), file.attrs.get("policy"))
        if about != (task.name, spec.supervisor) or {*file.get("data", ())} != names:
            raise BadInput(
                f"{path}: is there already and does not hold these demonstrations; choose another --out or "
                "remove it"
            )
