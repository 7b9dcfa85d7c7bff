"""A fitted controller as files that run without this library: numpy weights, ``torch.export``, ONNX."""

from __future__ import annotations

import io
import json
import logging
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddco_pyro.controller import Controller
from ddco_pyro.encoding import ObservationEncoder
from ddco_pyro.errors import Failed
from ddco_pyro.export import runner
from ddco_pyro.export.program import StepProgram, example, input_names
from ddco_pyro.export.weights import weights_and_networks
from ddco_pyro.files import whole_file, write_text
from ddco_pyro.hierarchy import Hierarchy
from ddco_pyro.outputs import TERMINATION_BOUND
from ddco_pyro.run import Fit
from ddco_pyro.spec import RolloutSpec

__all__ = ["TOLERANCE", "Exported", "export"]

TOLERANCE = 1e-6
"""Largest difference between a control of the original and one of an exported form, in the control's own units, or in
its spread where that is above 1."""

EPISODES, STEPS = 3, 20
"""Made-up episodes on which every form has to act as the original does."""


class ExportError(Failed):
    """An exported form does not act as the original does, or cannot be made."""


Exported = dict[str, tuple[float, float]]
"""Form to (largest difference of a control, median seconds of a step)."""


def export(fit: Fit, folder: Path, onnx: bool = False) -> Exported:
    """Write the controller of a run, as its spec's ``rollout`` says, and see that every form acts as it does.

    ``controller.json`` and ``weights.npz`` are run by ``runner.py`` with numpy alone; ``controller.pt2`` is a
    ``torch.export`` program of one step of all networks; ``controller.onnx`` the same for onnxruntime; ``check.npz``
    has episodes to replay. ``controller.json`` is written last.

    :raises ExportError: a form differs by more than :data:`TOLERANCE`, or cannot be made.
    """
    hierarchy, control = fit.hierarchy.eval(), fit.spec.rollout
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "controller.json").unlink(missing_ok=True)
    weights, about = weights_and_networks(hierarchy)
    about |= _about(hierarchy, control)
    if about["numpy"]:
        _write_arrays(folder / "weights.npz", weights)
    _write_programs(hierarchy, folder, onnx)
    with whole_file(folder / "runner.py") as temporary:
        shutil.copyfile(runner.__file__, temporary)
    episodes = record(Controller.from_spec(hierarchy, control), hierarchy.encoder)
    _write_arrays(folder / "check.npz", episodes)
    write_text(folder / "controller.json", json.dumps(about, indent=1) + "\n")
    return _compare(folder, episodes, [*(["numpy"] if about["numpy"] else []), *(["onnx"] if onnx else [])])


def _compare(folder: Path, episodes: dict[str, np.ndarray], forms: list[str]) -> Exported:
    found = {}
    for form in forms:
        found[form] = runner.replay(runner.Runner(folder, form), episodes)
        if not found[form][0] < TOLERANCE:
            (folder / "controller.json").unlink()
            difference = found[form][0]
            raise ExportError(f"{folder}: as {form} a control differs by {difference:.1e}: this is a defect; report it")
    return found


def _about(hierarchy: Hierarchy, control: RolloutSpec) -> dict[str, Any]:
    """What the runner has to know beside the weights."""
    encoder = hierarchy.encoder
    vectors = {one.key: one for one in encoder.specs}
    scaling = hierarchy.scaling
    scale = scaling.scale.numpy()
    return {
        "observations": [
            {
                "key": key,
                "shape": list(shape),
                "image": key in encoder.images,
                "differences": key in vectors and vectors[key].differences,
            }
            for key, shape in [*((key, encoder.shapes[key]) for key in vectors), *encoder.images.items()]
        ],
        "levels": [level.count for level in hierarchy.option_levels()],
        "varying": scaling.varying.tolist(),
        "scale": scale.tolist(),
        "control": control.control,
        "options": control.options,
        "std": [(one.std().detach().numpy().astype(float) * scale).tolist() for one in hierarchy.callers()],
        "termination_bound": TERMINATION_BOUND,
    }


def _write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    with whole_file(path) as temporary:
        temporary.write_bytes(content.getvalue())


def _write_programs(hierarchy: Hierarchy, folder: Path, onnx: bool) -> None:
    program, inputs = StepProgram(hierarchy).eval(), example(hierarchy.encoder)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
            logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nothing here needs
            _write_both(program, inputs, hierarchy.encoder, folder, onnx)
    except ImportError as error:
        raise ExportError(f"--onnx needs {error.name}; install it with: pip install 'ddco-pyro[export]'") from error
    except Exception as error:  # whatever torch makes of a network of one's own
        text = " ".join(str(error).split())[:300]
        raise ExportError(f"{folder}: the networks cannot be exported: {type(error).__name__}: {text}") from error


def _write_both(
    program: StepProgram, inputs: tuple[torch.Tensor, ...], encoder: ObservationEncoder, folder: Path, onnx: bool
) -> None:
    exported = torch.export.export(program, inputs)
    content = io.BytesIO()
    torch.export.save(exported, content)
    with whole_file(folder / "controller.pt2") as temporary:
        temporary.write_bytes(content.getvalue())
    if onnx:
        found = torch.onnx.export(
            exported, inputs, input_names=input_names(encoder), output_names=program.names, dynamo=True, verbose=False
        )
        assert found is not None
        with whole_file(folder / "controller.onnx") as temporary:
            temporary.write_bytes(found.model_proto.SerializeToString())


def record(controller: Controller, encoder: ObservationEncoder) -> dict[str, np.ndarray]:
    """Made-up episodes: observations about as large as those that were fitted to, what was done, and by whom.

    ``observation_<episode>_<key>`` [T, ...], ``controls_<episode>`` [T, A], ``choices_<episode>`` [T, D], ``seeds``.
    """
    random = np.random.default_rng(0)
    found: dict[str, np.ndarray] = {"seeds": np.arange(EPISODES)}
    for episode in range(EPISODES):
        seen = _episode(encoder, random)
        controller.reset(episode)
        acted = [
            (controller.act({key: one[step] for key, one in seen.items()}), controller.choices) for step in range(STEPS)
        ]
        found |= {f"observation_{episode}_{key}": one for key, one in seen.items()}
        found[f"controls_{episode}"] = np.stack([control for control, _ in acted])
        found[f"choices_{episode}"] = np.array([choices for _, choices in acted], dtype=int).reshape(STEPS, -1)
    return found


def _episode(encoder: ObservationEncoder, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Observations with the mean and spread that were fitted to, and with steps as long where those matter."""
    found: dict[str, np.ndarray] = {}
    at = 0
    for spec, size in zip(encoder.specs, encoder.sizes, strict=True):
        shape = encoder.shapes[spec.key]
        mean, std = (one[at : at + size].numpy() for one in (encoder.mean, encoder.std))
        length = int(np.prod(shape))
        if spec.differences:
            start = mean[:length] + std[:length] * random.normal(size=length)
            steps = mean[length:] + std[length:] * random.normal(size=(STEPS, length))
            values = start + np.cumsum(steps, axis=0)
        else:
            values = mean + std * random.normal(size=(STEPS, length))
        found[spec.key] = values.reshape(STEPS, *shape)
        at += size
    return found | {
        key: random.integers(0, 256, (STEPS, *shape), dtype=np.uint8) for key, shape in encoder.images.items()
    }
