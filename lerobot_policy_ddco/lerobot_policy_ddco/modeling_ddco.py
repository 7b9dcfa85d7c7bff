"""The policy: an exported controller for each environment of a batch."""

from __future__ import annotations

import copy
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_policy_ddco.configuration_ddco import DDCOConfig


class DDCOPolicy(PreTrainedPolicy):
    """Acts with options. ``active`` names the active option of each level, for each environment.

    :param folder: what ``ddco-pyro export RUN --lerobot FOLDER`` wrote; its ``runner.py`` is imported.
    """

    config_class = DDCOConfig
    name = "ddco"

    def __init__(self, config: DDCOConfig, folder: Path, **ignored: Any) -> None:
        super().__init__(config)
        self._exported = _imported(folder / "runner.py").Runner(folder)
        self.about = self._exported.about
        self.episodes = 0
        self.reset()

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None, **ignored: Any
    ) -> Self:
        """The policy of a folder on this machine.

        :raises ValueError: there is no exported controller. Nothing is downloaded, since its code is
            executed.
        """
        folder = Path(pretrained_name_or_path)
        if not (folder / "runner.py").is_file():
            remedy = "export one with: ddco-pyro export RUN --lerobot FOLDER"
            raise ValueError(f"{folder}: has no runner.py; {remedy}")
        return cls(config or PreTrainedConfig.from_pretrained(folder), folder).eval()

    def reset(self) -> None:
        """Begin an episode in every environment."""
        self._controllers: list[Any] = []

    @property
    def active(self) -> list[dict[str, str]]:
        """The name of the active option of each level, for each environment."""
        return [controller.active for controller in self._controllers]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **ignored: Any) -> Tensor:
        """The controls of all environments [B, A], in the control's own units.

        :raises ValueError: an observation is missing, or has another shape than in training.
        """
        own = [spec for spec in self.about["observations"] if not self._built_in(spec)]
        specs = [spec | {"key": key} for spec in own for key in (spec["minus"], spec["key"]) if key]
        names = {spec["key"]: "observation." + spec["key"].replace("/", ".") for spec in specs}
        if missing := [name for name in names.values() if name not in batch]:
            raise ValueError(f"the batch has no {missing[0]!r} (it has: {', '.join(sorted(batch))})")
        rows = {key: batch[name].cpu().numpy() for key, name in names.items()}
        count = len(next(iter(rows.values()))) if rows else 1
        if not self._controllers:
            self._controllers = [copy.copy(self._exported) for _ in range(count)]
            for row, controller in enumerate(self._controllers):
                controller.reset(self.episodes + row)
            self.episodes += count
        controls = []
        for row, controller in enumerate(self._controllers):
            seen = {spec["key"]: _own(rows[spec["key"]][row], spec) for spec in specs}
            controls.append(controller.act(seen))
        return torch.as_tensor(np.stack(controls), dtype=torch.float32)

    def _built_in(self, spec: dict[str, Any]) -> bool:
        return bool(self.about["step"]) and spec["key"] == self.about["step"]["key"]

    def predict_action_chunk(self, batch: dict[str, Tensor], **ignored: Any) -> Tensor:
        """A chunk of one control, [B, 1, A]."""
        return self.select_action(batch)[:, None]

    def get_optim_params(self) -> dict[str, Any]:
        """Nothing to train."""
        return {}

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any] | None]:
        """Refuse to train.

        :raises RuntimeError: always.
        """
        raise RuntimeError("a ddco policy is fitted with: ddco-pyro fit SPEC")


def _imported(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("ddco_runner", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _own(value: np.ndarray, spec: dict[str, Any]) -> np.ndarray:
    """An observation as the controller saw it: pictures uint8 [H, W, C], vectors in their shape."""
    if spec["image"]:
        if value.dtype != np.uint8:
            value = np.round(255 * value).astype(np.uint8)
        return value if value.shape == tuple(spec["shape"]) else np.moveaxis(value, 0, -1)
    return value.reshape(spec["shape"])
