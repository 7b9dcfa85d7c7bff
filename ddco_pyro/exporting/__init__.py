"""Export a fitted controller as files that run without this library: numpy, ``torch.export`` and ONNX."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import getsource
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from ddco_pyro.data.files import whole_folder
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.exporting import runner
from ddco_pyro.exporting.description import StepProgram, describe
from ddco_pyro.exporting.recording import MOST, record, tolerance
from ddco_pyro.exporting.runner import TOLERANCE
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.emissions import CONTROLS, KINDS
from ddco_pyro.model.seeding import HOST

__all__ = ["TOLERANCE", "Exported", "export", "write_numpy"]

FILES = {"controller.json", "weights.npz", "controller.pt2", "controller.onnx", "runner.py", "check.npz", "__pycache__"}
"""Everything that an exported folder can hold."""

DEFECT = "with networks of this library that is a defect: report it"


class ExportError(Failed):
    """An exported form acts differently from the original, or cannot be made."""


Exported = dict[str, tuple[float, float]]
"""Form to (largest difference of a control, median seconds of a step)."""


def export(fit: Fit, folder: str | Path, onnx: bool = False) -> Exported:
    """Write the controller that a run's ``rollout`` describes, and verify every form of it.

    The folder gets ``controller.json``, ``weights.npz`` and ``runner.py``, which run with numpy alone;
    ``controller.pt2``, a ``torch.export`` program of one step of all networks; with ``onnx`` the same step as
    ``controller.onnx``; and ``check.npz``, episodes to replay.

    Each form is loaded again from the disk and driven by ``runner.py`` through synthetic episodes. Every option must
    equal the original's choice. Every control and network output must lie within
    :func:`~ddco_pyro.exporting.recording.tolerance`. If all forms agree, the folder replaces an earlier export;
    otherwise nothing changes.

    :raises ExportError: a form acts differently, or cannot be made.
    :raises BadInput: ``folder`` holds other files.

    >>> sorted(ddco_pyro.export(fit, "controller"))  # both forms act like the original
    ['numpy', 'torch']
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder}: is a file; choose another --out")
    refuse_others(folder, FILES, "--out")
    with whole_folder(folder) as temporary:
        forms = _write(fit, temporary, onnx)
        return _compare(temporary, forms)


def refuse_others(folder: Path, names: set[str], option: str) -> None:
    """Refuse to replace a folder.

    :param names: of the files that an export writes.
    :raises BadInput: the folder holds other files.
    """
    if folder.exists() and (others := sorted({path.name for path in folder.iterdir()} - names)):
        raise BadInput(f"{folder}: holds what was not exported, such as {others[0]}; choose another {option}")


def write_numpy(fit: Fit, folder: Path) -> bool:
    """Write ``controller.json``, ``weights.npz`` and ``runner.py`` into a folder, without verification.

    :returns: whether numpy can evaluate every network; otherwise there is no ``weights.npz``.
    """
    hierarchy = fit.hierarchy.place(HOST).eval()
    about, weights = describe(hierarchy, fit.spec.rollout, StepProgram(hierarchy).eval())
    about["names"] = fit.names
    if about["numpy"]:
        np.savez(folder / "weights.npz", **weights)  # type: ignore[arg-type]
    (folder / "runner.py").write_text(runner_source(), encoding="utf-8")
    (folder / "controller.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return bool(about["numpy"])


def runner_source() -> str:
    """The runner as a file that stands by itself: with the functions of all kinds of control."""
    functions = dict.fromkeys(chain.from_iterable((*emission.helpers, emission.control) for emission in KINDS.values()))
    names = ", ".join(f'"{kind}": {control.__name__}' for kind, control in CONTROLS.items())
    sources = [*(getsource(function) for function in functions), f"CONTROLS = {{{names}}}\n"]
    library = "from ddco_pyro.model.emissions import CONTROLS\n\n"
    whole = getsource(runner).replace(library, "").replace("import json\n", "import json\nimport math\n")
    return whole.replace("# kinds of control\n", "\n\n".join(sources))


def _write(fit: Fit, folder: Path, onnx: bool) -> list[str]:
    """Write every file; returns the forms that can run."""
    forms = ["numpy"] if write_numpy(fit, folder) else []
    for name, content in _programs(StepProgram(fit.hierarchy.eval()).eval(), onnx).items():
        (folder / name).write_bytes(content)
    episodes = record(fit.controller(), fit.hierarchy)
    episodes["tolerance"] = np.array(tolerance(fit.hierarchy, episodes))
    np.savez_compressed(folder / "check.npz", **episodes)  # type: ignore[arg-type]
    return [*forms, "torch", *(["onnx"] if onnx else [])]


def _compare(folder: Path, forms: list[str]) -> Exported:
    """Replay the recorded episodes with each form in the folder."""
    episodes = runner.read_arrays(folder / "check.npz")
    allowed = float(episodes["tolerance"])
    replayed = {}
    for form in forms:
        with _one_line_errors(f"as {form} it cannot be run"):
            replayed[form] = runner.replay(runner.Runner(folder, form), episodes)
        difference = replayed[form][0]
        if not difference < allowed:
            cause = "the weights are so large that float32 is too coarse for them" if allowed == MOST else DEFECT
            what = f"as {form} it differs from the run by {difference:.1e}, of {allowed:.1e} that are allowed"
            raise ExportError(f"nothing was written: {what}; {cause}")
    return replayed


@contextmanager
def _one_line_errors(what: str) -> Iterator[None]:
    """Turn errors of torch or onnxruntime about a network into one line."""
    try:
        yield
    except ImportError as error:
        raise ExportError(f"--onnx needs {error.name}; install it with: pip install 'ddco-pyro[export]'") from error
    except Exception as error:
        text = " ".join(str(error).split())[:300]
        raise ExportError(f"nothing was written: {what}: {type(error).__name__}: {text}") from error


def _programs(program: StepProgram, onnx: bool) -> dict[str, bytes]:
    """The contents of ``controller.pt2`` and, on request, of ``controller.onnx``, by name."""
    inputs, content = program.example(), io.BytesIO()
    with _one_line_errors("the networks cannot be exported"), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nothing here needs
        exported = torch.export.export(program, inputs)
        torch.export.save(exported, content)
        files = {"controller.pt2": content.getvalue()}
        if onnx:
            given, names = program.onnx_names()
            made = torch.onnx.export(
                exported, inputs, input_names=given, output_names=names, dynamo=True, verbose=False
            )
            assert made is not None
            files["controller.onnx"] = made.model_proto.SerializeToString()
    return files
