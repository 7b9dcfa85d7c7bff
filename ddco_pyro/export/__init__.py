"""A fitted controller as files that run without this library: numpy weights, ``torch.export``, ONNX."""

from __future__ import annotations

import inspect
import io
import json
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.files import whole_folder
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.export import runner, runner_networks
from ddco_pyro.export.program import StepProgram
from ddco_pyro.export.recording import MOST, record, tolerance
from ddco_pyro.export.runner import TOLERANCE
from ddco_pyro.export.weights import weights_and_networks
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.links import TERMINATION_BOUND
from ddco_pyro.model.seeding import HOST
from ddco_pyro.spec import STEP, RolloutSpec

__all__ = ["TOLERANCE", "Exported", "export", "write_numpy"]

FILES = {"controller.json", "weights.npz", "controller.pt2", "controller.onnx", "runner.py", "check.npz", "__pycache__"}
"""What there can be in an exported folder."""


DEFECT = "with networks of this library that is a defect: report it"


class ExportError(Failed):
    """An exported form does not act as the original does, or cannot be made."""


Exported = dict[str, tuple[float, float]]
"""Form to (largest difference of a control, median seconds of a step)."""


def export(fit: Fit, folder: Path, onnx: bool = False) -> Exported:
    """Write the controller of a run, as its spec's ``rollout`` says, and see that every form acts as it does.

    ``controller.json`` and ``weights.npz`` are run by ``runner.py`` with numpy alone; ``controller.pt2`` is a
    ``torch.export`` program of one step of all networks; ``controller.onnx`` the same for onnxruntime; ``check.npz``
    has episodes to replay. Each of the three is loaded again from the disk and driven by ``runner.py`` through made-up
    episodes: every option has to be the one that the original chose, and every control, and whatever else the networks
    say, within what :func:`~ddco_pyro.export.recording.tolerance` allows.

    ``folder`` is there, or replaces what was exported there before, once all of them agree; else nothing is changed.

    :raises ExportError: a form acts otherwise, or cannot be made.
    :raises BadInput: ``folder`` holds something else.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder}: is a file; choose another --out")
    others = sorted(path.name for path in folder.iterdir() if path.name not in FILES) if folder.exists() else []
    if others:
        raise BadInput(f"{folder}: holds what was not exported, such as {others[0]}; choose another --out")
    with whole_folder(folder) as temporary:
        forms = _write(fit, temporary, onnx)
        return _compare(temporary, forms)


def write_numpy(fit: Fit, folder: Path) -> bool:
    """Write ``controller.json``, ``weights.npz`` and ``runner.py`` into a folder, without comparing how they act.

    :returns: whether numpy can evaluate every network; else there is no ``weights.npz``.
    """
    hierarchy = fit.hierarchy.place(HOST).eval()
    program = StepProgram(hierarchy).eval()
    weights, about = weights_and_networks(hierarchy)
    about |= _about(hierarchy, fit.spec.rollout) | {"outputs": program.names, "state": _state(program)}
    if about["numpy"]:
        np.savez(folder / "weights.npz", **weights)  # type: ignore[arg-type]
    (folder / "runner.py").write_text(_runner_alone(), encoding="utf-8")
    (folder / "controller.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return bool(about["numpy"])


def _runner_alone() -> str:
    """The runner as one file without this library: the module of its networks stands where it is imported."""
    whole, networks = inspect.getsource(runner), inspect.getsource(runner_networks)
    before, line, after = whole.partition(f"from {runner_networks.__name__} import FORMS, Outputs\n")
    assert line  # or the file would need this library
    return before + networks.partition("import numpy as np\n\n")[2] + after


def _write(fit: Fit, folder: Path, onnx: bool) -> list[str]:
    """Write every file; the forms that can be run."""
    forms = ["numpy"] if write_numpy(fit, folder) else []
    for name, content in _programs(StepProgram(fit.hierarchy.eval()).eval(), onnx).items():
        (folder / name).write_bytes(content)
    episodes = record(fit.controller(), fit.hierarchy)
    episodes["tolerance"] = np.array(tolerance(fit.hierarchy, episodes))
    np.savez_compressed(folder / "check.npz", **episodes)  # type: ignore[arg-type]
    return [*forms, "torch", *(["onnx"] if onnx else [])]


def _compare(folder: Path, forms: list[str]) -> Exported:
    """How each form in the folder, loaded from there, acts in the episodes that were recorded."""
    with np.load(folder / "check.npz") as file:
        episodes = {name: file[name] for name in file.files}
    allowed = float(episodes["tolerance"])
    replayed = {}
    for form in forms:
        with _reported(f"as {form} it cannot be run"):
            replayed[form] = runner.replay(runner.Runner(folder, form), episodes)
        difference = replayed[form][0]
        if not difference < allowed:
            cause = "the weights are so large that float32 is too coarse for them" if allowed == MOST else DEFECT
            what = f"as {form} it differs from the run by {difference:.1e}, of {allowed:.1e} that are allowed"
            raise ExportError(f"nothing was written: {what}; {cause}")
    return replayed


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """What torch or onnxruntime makes of a model, a user's network in it or not, in one line."""
    try:
        yield
    except ImportError as error:
        raise ExportError(f"--onnx needs {error.name}; install it with: pip install 'ddco-pyro[export]'") from error
    except Exception as error:
        text = " ".join(str(error).split())[:300]
        raise ExportError(f"nothing was written: {what}: {type(error).__name__}: {text}") from error


def _about(hierarchy: Hierarchy, control: RolloutSpec) -> dict[str, Any]:
    """What the runner has to know beside the weights."""
    encoder = hierarchy.encoder
    vectors = {spec.key: spec for spec in encoder.specs}
    scaling = hierarchy.scaling
    scale, shift = scaling.scale.numpy(), scaling.shift.numpy()
    return {
        "observations": [
            {
                "key": key,
                "shape": list(shape),
                "image": key in encoder.images,
                "differences": key in vectors and vectors[key].differences,
                **(encoder.transforms[key].as_data() if key in encoder.images else {}),
            }
            for key, shape in ((key, encoder.shapes.get(key, (1,))) for key in [*vectors, *encoder.images])
        ],
        "step": {"key": STEP, "longest": float(encoder.longest)} if STEP in vectors else None,
        "features": dict(zip(encoder.keys, encoder.sizes, strict=True)),
        "levels": [level.count for level in hierarchy.option_levels()],
        "varying": scaling.varying.tolist(),
        "scale": scale.tolist(),
        "shift": shift.tolist(),
        "control": control.control,
        "options": control.options,
        "constant": [float(value) for value in scaling.emitted(torch.zeros(len(scaling.varying)))],
        "parts": [_part(hierarchy, number) for number in range(len(scaling.parts))],
        "termination_bound": TERMINATION_BOUND,
    }


def _state(program: StepProgram) -> list[dict[str, Any]]:
    """The state before the first step."""
    tensors = [tensor.numpy() for tensor in program.initial_state()]
    return [{"kind": str(part.dtype), "shape": list(part.shape), "values": part.ravel().tolist()} for part in tensors]


def _part(hierarchy: Hierarchy, number: int) -> dict[str, Any]:
    """What the runner has to know of a part of the control.

    ``std`` is the σ of each level's callers, lowest first; callers that emit no control have none. A σ that depends on
    the state is floor + softplus(y + start). ``per_state`` has, for each such dimension, its place in the part, the
    place of y among the numbers of a caller, floor and start.
    """
    scaling = hierarchy.scaling
    part, places = scaling.parts[number], list(scaling.groups[number])
    before, callers = scaling.parts[:number], hierarchy.callers()
    first = sum(len(other.dims) for other in before if other.continuous)
    own = slice(first, first + len(places))
    each = zip(callers, (*(level.count for level in hierarchy.option_levels()), 1), strict=True)
    std = [
        [] if one.std is None else one.std(torch.zeros(k, len(one.std.of_state)))[..., own].tolist() for one, k in each
    ]
    given = next(caller.std for caller in callers if caller.std is not None)  # all have the same kinds of σ
    per_state = [
        [at - first, scaling.numbers + number, float(given.floor[at]), float(given.start[at])]
        for number, at in enumerate(given.of_state)
        if first <= at < first + len(places)
    ]
    decides = [len(scaling.varying) + sum(bool(other.exact) for other in before)] if part.exact else []
    ends = ([None if math.isinf(end) else end for end in values] for values in (part.low, part.high))
    return {
        "kind": part.kind,
        "dims": list(part.dims),
        "places": places + decides,
        "size": part.size,
        "values": list(part.values),
        "ends": list(ends),
        "shift": scaling.shift[places].tolist(),
        "scale": scaling.scale[places].tolist(),
        "std": std if part.continuous else [],
        "per_state": per_state if part.continuous else [],
    }


def _programs(program: StepProgram, onnx: bool) -> dict[str, bytes]:
    """The contents of ``controller.pt2`` and, if asked for, of ``controller.onnx``, by name."""
    inputs, content = program.example(), io.BytesIO()
    with _reported("the networks cannot be exported"), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nothing here needs
        exported = torch.export.export(program, inputs)
        torch.export.save(exported, content)
        files = {"controller.pt2": content.getvalue()}
        if onnx:
            files["controller.onnx"] = _onnx(exported, inputs, *program.onnx_names())
    return files


def _onnx(
    program: torch.export.ExportedProgram, inputs: tuple[torch.Tensor, ...], given: list[str], names: list[str]
) -> bytes:
    made = torch.onnx.export(program, inputs, input_names=given, output_names=names, dynamo=True, verbose=False)
    assert made is not None
    content: bytes = made.model_proto.SerializeToString()
    return content
