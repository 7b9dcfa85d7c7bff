"""The run folder: its spec, its lock, and the files that a fit writes into it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.data.files import Damaged, leftovers, only_one, write_text
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.errors import BadInput
from ddco_pyro.metrics import refit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec, SpecError, dump_spec, load_spec
from ddco_pyro.training.checkpoint import copy_of
from ddco_pyro.training.networks import Dimensions, build_hierarchy


@contextmanager
def claimed(folder: Path, spec: Spec, resume: bool = True) -> Iterator[None]:
    """Inside, the folder is the run of this spec (:func:`claim`), and no other process works on it.

    What a killed process has left half written is removed.

    :raises BadInput: the folder is a file, or as :func:`claim`.
    :raises Busy: another process works on the folder.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder}: is a file; choose another --out")
    with only_one(folder):
        claim(folder, spec, resume)
        for part in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            for old in leftovers(part):
                old.unlink()
        yield


def claim(folder: Path, spec: Spec, resume: bool = True) -> None:
    """Make a folder the run of a spec, by writing ``spec.yaml``. An unfinished run of it is continued.

    A spec that differs in its ``report`` alone is the same, and replaces the one in the folder.

    :param resume: whether the folder may hold the finished run.
    :raises BadInput: the folder holds something else, or the finished run although it may not.
    """
    text, path = dump_spec(spec), folder / "spec.yaml"
    if path.exists():
        same = same_model = path.read_bytes() == text.encode()
        with suppress(SpecError):  # user code is not imported by reading its name
            changed = {"report": spec.report}
            same_model = same or load_spec(path, allow_code=True).model_copy(update=changed) == spec
        if not same_model:
            raise BadInput(f"{folder}: holds a run of another spec; choose another --out or remove it")
        if not resume and is_finished(folder) and (folder / "report.html").exists():  # what `fit` writes last
            raise BadInput(
                f"{folder}: holds a run of this spec already; show it with --resume, or choose another --out"
            )
        if same:
            return
    elif folder.exists() and set(folder.iterdir()) - set(leftovers(folder)):
        raise BadInput(f"{folder}: is not empty and not a run; choose another --out")
    write_text(path, text)


def is_finished(folder: Path) -> bool:
    """Whether a run is complete: ``metrics.json`` is written last. A file that was removed is made again."""
    return all((folder / name).exists() for name in ("model.safetensors", "metrics.json"))


def write_model(folder: Path, hierarchy: Hierarchy) -> None:
    """Write ``model.safetensors``."""
    metadata = {
        "shapes": json.dumps({key: list(shape) for key, shape in hierarchy.encoder.shapes.items()}),
        "control_size": str(hierarchy.scaling.size),
        "steps": str(hierarchy.steps),
        "tasks": json.dumps(hierarchy.encoder.tasks),
        "control": json.dumps([part.as_data() for part in hierarchy.scaling.parts]),
    }
    write_tensors(folder / "model.safetensors", copy_of(hierarchy), metadata)


def read_model(folder: Path, spec: Spec) -> Hierarchy:
    """Read ``model.safetensors``, in evaluation mode.

    :raises Damaged: the file is damaged.
    :raises BadInput: the model is of another spec.
    """
    path, remedy = folder / "model.safetensors", refit(folder)
    tensors, metadata = read_tensors(path, remedy)
    wrong = [name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())]
    if wrong:
        raise Damaged(path, f"{wrong[0]} has numbers that are NaN or infinite", remedy)
    try:
        shapes = {key: tuple(shape) for key, shape in json.loads(metadata["shapes"]).items()}
        size, steps = int(metadata["control_size"]), int(metadata["steps"])
        others = sorted(set(range(size)) - set(tensors["scaling.varying"].tolist()))
        constant = dict(zip(others, tensors["scaling.constant"].tolist(), strict=True))
        parts = tuple(ControlPart.of(part) for part in json.loads(metadata["control"]))
        tasks = tuple(json.loads(metadata["tasks"]))
        hierarchy = build_hierarchy(spec, Dimensions(shapes, size, steps, constant, parts=parts, tasks=tasks))
        hierarchy.load_state_dict(tensors)
    except BadInput:
        raise
    except (KeyError, ValueError, RuntimeError) as error:
        raise BadInput(f"{path}: is of another spec than spec.yaml; {remedy}") from error
    return hierarchy.eval()


class Clock:
    """Seconds of this process by phase."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        since = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] = self.seconds.get(phase, 0.0) + time.perf_counter() - since
