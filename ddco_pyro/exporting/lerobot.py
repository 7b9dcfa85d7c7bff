"""A controller as the folder of a LeRobot policy, for the package ``lerobot_policy_ddco``."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.errors import BadInput
from ddco_pyro.exporting import refuse_others, write_numpy
from ddco_pyro.exporting.runner import read_arrays
from ddco_pyro.fitting.fitted import Fit

FILES = {"config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"}


def export_policy(fit: Fit, folder: Path) -> None:
    """Write ``config.json``, ``model.safetensors`` and LeRobot's processors, which scale nothing.

    An observation ``arm`` is ``observation.arm`` there. LeRobot reads the folder where ``lerobot_policy_ddco`` is
    installed: ``lerobot-eval --policy.path=FOLDER``.

    :raises BadInput: numpy cannot evaluate the networks, or the folder holds other files.
    """
    refuse_others(folder, FILES, "--lerobot")
    with tempfile.TemporaryDirectory() as made:
        if not write_numpy(fit, Path(made)):
            raise BadInput(f"{fit.place}: has networks that numpy cannot evaluate; export with --out, for torch")
        about = json.loads((Path(made) / "controller.json").read_text(encoding="utf-8"))
        arrays = read_arrays(Path(made) / "weights.npz")
    weights = {name.replace(".", "/"): np.ascontiguousarray(array) for name, array in arrays.items()}
    step = about["step"] and about["step"]["key"]
    inputs = {
        "observation." + spec["key"].replace("/", "."): {
            "type": "VISUAL" if spec["image"] else "STATE",
            "shape": [spec["shape"][place] for place in (2, 0, 1)] if spec["image"] else spec["shape"],
        }
        for spec in about["observations"]
        if spec["key"] != step
    }
    config = {
        "type": "ddco",
        "input_features": inputs,
        "output_features": {"action": {"type": "ACTION", "shape": [len(about["constant"])]}},
        "device": "cpu",
        "controller": json.dumps(about),
        "weights": json.dumps({name: [list(array.shape), str(array.dtype)] for name, array in weights.items()}),
    }
    rename = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
    batch = {"registry_name": "to_batch_processor", "config": {}}
    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    steps = {"policy_preprocessor": [rename, batch, device], "policy_postprocessor": [device]}
    with whole_folder(folder) as temporary:
        save_file(weights, temporary / "model.safetensors")
        write_text(temporary / "config.json", json.dumps(config, indent=4) + "\n")
        for name, processors in steps.items():
            write_text(temporary / f"{name}.json", json.dumps({"name": name, "steps": processors}, indent=2) + "\n")
