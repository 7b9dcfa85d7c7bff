"""A controller as the folder of a LeRobot policy, for the package ``lerobot_policy_ddco``."""

from __future__ import annotations

import json
from pathlib import Path

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.exporting import FILES, Exported, refuse_others, write_verified
from ddco_pyro.fitting.fitted import Fit

OWN = {"config.json", "policy_preprocessor.json", "policy_postprocessor.json"}


def export_policy(fit: Fit, folder: Path) -> Exported:
    """Write the files of an export beside ``config.json`` and LeRobot's processors, which scale nothing.

    An observation ``arm`` is ``observation.arm`` there. LeRobot reads the folder where ``lerobot_policy_ddco`` is
    installed, which imports the folder's ``runner.py``: ``lerobot-eval --policy.path=FOLDER``.

    :raises BadInput: numpy cannot evaluate the networks, or the folder holds other files.
    :raises ExportError: the controller acts differently.
    """
    refuse_others(folder, FILES | OWN, "--lerobot")
    with whole_folder(folder) as temporary:
        exported = write_verified(fit, temporary)
        about = json.loads((temporary / "controller.json").read_text(encoding="utf-8"))
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
        }
        write_text(temporary / "config.json", json.dumps(config, indent=4) + "\n")
        rename = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
        batch = {"registry_name": "to_batch_processor", "config": {}}
        device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
        steps = {"policy_preprocessor": [rename, batch, device], "policy_postprocessor": [device]}
        for name, processors in steps.items():
            write_text(temporary / f"{name}.json", json.dumps({"name": name, "steps": processors}, indent=2) + "\n")
    return exported
