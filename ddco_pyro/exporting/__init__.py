"""Export a fitted controller as files that run without this library: numpy and ONNX."""

from __future__ import annotations

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

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.exporting import runner
from ddco_pyro.exporting.description import StepProgram, describe, without_arrays
from ddco_pyro.exporting.recording import MOST, record, tolerance
from ddco_pyro.exporting.runner import TOLERANCE
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.emissions import CONTROLS, KINDS
from ddco_pyro.model.seeding import HOST

__all__ = ["TOLERANCE", "Exported", "export", "write_numpy"]

FILES = {"controller.json", "weights.npz", "controller.onnx", "runner.py", "check.npz", "__pycache__"}
"""Everything that an exported folder can hold."""

DEFECT = "with networks of this library that is a defect: report it"


Exported = dict[str, tuple[float, float]]
"""Form to (largest difference of a control, median seconds of a step)."""


def export(fit: Fit, folder: str | Path, onnx: bool = False) -> Exported:
    """Write the controller that a run's ``rollout`` describes, and verify every form of it.

    The folder gets ``controller.json``, ``weights.npz`` and ``runner.py``, which run with numpy alone; with
    ``onnx`` one step of all networks as ``controller.onnx``; and ``check.npz``, episodes to replay.

    Each form is loaded again from the disk and driven by ``runner.py`` through synthetic episodes. Every
    option must equal the original's choice. Every control and network output must lie within
    :func:`~ddco_pyro.exporting.recording.tolerance`. If all forms agree, the folder replaces an earlier
    export; otherwise nothing changes.

    :raises Failed: a form acts differently, or cannot be made.
    :raises BadInput: ``folder`` holds other files, or numpy cannot evaluate networks and ONNX is not asked.

    >>> [*ddco_pyro.export(fit, "controller")]  # it acts like the original
    ['numpy']
    """
    folder = Path(folder)
    _refuse_others(folder, FILES, "--out")
    with whole_folder(folder) as temporary:
        return _write_verified(fit, temporary, onnx)


def _refuse_others(folder: Path, names: set[str], option: str) -> None:
    """Refuse to replace what is no export.

    :param names: of the files that an export writes.
    """
    if folder.is_file():
        raise BadInput(f"{folder}: is a file; choose another {option}")
    if folder.exists() and (others := sorted({path.name for path in folder.iterdir()} - names)):
        raise BadInput(f"{folder}: holds what was not exported, such as {others[0]}; choose another {option}")


def write_numpy(fit: Fit, folder: Path) -> bool:
    """Write ``controller.json``, ``weights.npz`` and ``runner.py`` into a folder, without verification.

    :returns: whether numpy can evaluate every network; otherwise there is no ``weights.npz``.
    """
    hierarchy = fit.hierarchy.place(HOST).eval()
    weights: dict[str, np.ndarray] = {}
    about = describe(hierarchy, fit.spec.rollout, StepProgram(hierarchy).eval()) | {"names": fit.names}
    facts = without_arrays(about, "", weights)
    if weights:
        np.savez(folder / "weights.npz", **weights)  # type: ignore[arg-type]
    (folder / "runner.py").write_text(runner_source(), encoding="utf-8")
    (folder / "controller.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return bool(weights)


def runner_source() -> str:
    """The runner as a file that stands by itself: with the functions of all kinds of control."""
    used = ((*emission.helpers, emission.control) for emission in KINDS.values())
    functions = dict.fromkeys(chain.from_iterable(used))
    names = ", ".join(f'"{kind}": {control.__name__}' for kind, control in CONTROLS.items())
    sources = [*(getsource(function) for function in functions), f"CONTROLS = {{{names}}}\n"]
    library = "from ddco_pyro.model.emissions import CONTROLS\n\n"
    whole = getsource(runner).replace(library, "").replace("import json\n", "import json\nimport math\n")
    return whole.replace("# kinds of control\n", "\n\n".join(sources))


def _write_verified(fit: Fit, folder: Path, onnx: bool = False) -> Exported:
    """Write every file into an empty folder, and replay recorded episodes with each form that can run."""
    forms = [*(["numpy"] if write_numpy(fit, folder) else []), *(["onnx"] if onnx else [])]
    if not forms:
        has = "has networks that numpy cannot evaluate"
        raise BadInput(f"{fit.place}: {has}; export it with --out and --onnx")
    if onnx:
        (folder / "controller.onnx").write_bytes(_onnx(StepProgram(fit.hierarchy.eval()).eval()))
    episodes = record(fit.controller(), fit.hierarchy)
    allowed = tolerance(fit.hierarchy, episodes)
    episodes["tolerance"] = np.array(allowed)
    np.savez_compressed(folder / "check.npz", **episodes)  # type: ignore[arg-type]
    replayed = {}
    for form in forms:
        with _one_line_errors(f"as {form} it cannot be run"):
            controller = runner.Runner(folder, form)
            replayed[form] = runner.replay(controller, runner.read_arrays(folder / "check.npz"))
        difference = replayed[form][0]
        if not difference < allowed:
            coarse = "the weights are so large that float32 is too coarse for them"
            cause = coarse if allowed == MOST else DEFECT
            what = f"as {form} it differs from the run by {difference:.1e}, of {allowed:.1e} that are allowed"
            raise Failed(f"nothing was written: {what}; {cause}")
    return replayed


@contextmanager
def _one_line_errors(what: str) -> Iterator[None]:
    """Turn errors of torch or onnxruntime about a network into one line."""
    try:
        yield
    except ImportError as error:
        install = "install it with: pip install 'ddco-pyro[export]'"
        raise Failed(f"--onnx needs {error.name}; {install}") from error
    except Exception as error:
        text = " ".join(str(error).split())[:300]
        raise Failed(f"nothing was written: {what}: {type(error).__name__}: {text}") from error


def _onnx(program: StepProgram) -> bytes:
    """The contents of ``controller.onnx``."""
    inputs, (given, names) = program.example(), program.onnx_names()
    with _one_line_errors("the networks cannot be exported"), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, not needed here
        graph = torch.export.export(program, inputs)
        made = torch.onnx.export(
            graph, inputs, input_names=given, output_names=names, dynamo=True, verbose=False
        )
        assert made is not None
        content: bytes = made.model_proto.SerializeToString()
    return content


# --- LeRobot ------------------------------------------------------------------------------------------------

OWN = {"config.json", "policy_preprocessor.json", "policy_postprocessor.json"}


def export_policy(fit: Fit, folder: Path) -> Exported:
    """Write the files of an export beside ``config.json`` and LeRobot's processors, which scale nothing.

    An observation ``arm`` is ``observation.arm`` there. LeRobot reads the folder where
    ``lerobot_policy_ddco`` is installed, which imports the folder's ``runner.py``: ``lerobot-eval
    --policy.path=FOLDER``.

    :raises BadInput: numpy cannot evaluate the networks, or the folder holds other files.
    :raises Failed: the controller acts differently.
    """
    _refuse_others(folder, FILES | OWN, "--lerobot")
    with whole_folder(folder) as temporary:
        exported = _write_verified(fit, temporary)
        about = json.loads((temporary / "controller.json").read_text(encoding="utf-8"))
        step = about["step"] and about["step"]["key"]
        inputs = {
            "observation." + key.replace("/", "."): {
                "type": "VISUAL" if spec["image"] else "STATE",
                "shape": [spec["shape"][place] for place in (2, 0, 1)] if spec["image"] else spec["shape"],
            }
            for spec in about["observations"]
            for key in (spec["minus"], spec["key"])
            if key not in (None, step)
        }
        config = {
            "type": "ddco",
            "input_features": inputs,
            "output_features": {"action": {"type": "ACTION", "shape": [len(about["constant"])]}},
            "device": "cpu",
        }
        write_text(temporary / "config.json", json.dumps(config, indent=4) + "\n")
        rename = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
        batch = {"registry_name": "to_batch_processor", "config": {}}
        device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
        steps = {"policy_preprocessor": [rename, batch, device], "policy_postprocessor": [device]}
        for name, processors in steps.items():
            text = json.dumps({"name": name, "steps": processors}, indent=2)
            write_text(temporary / f"{name}.json", text + "\n")
    return exported
