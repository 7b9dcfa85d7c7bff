"""The policy: an exported controller for each environment of a batch."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_policy_ddco.configuration_ddco import DDCOConfig
from lerobot_policy_ddco.runner import NumpyNetworks, Runner


class _Controller(Runner):
    def __init__(self, weights: dict[str, np.ndarray], about: dict[str, Any], seed: int) -> None:
        self.about, self._networks = about, NumpyNetworks(weights, about)
        self.reset(seed)


class DDCOPolicy(PreTrainedPolicy):
    """Acts with options. ``active`` names the active option of each level, for each environment."""

    config_class = DDCOConfig
    name = "ddco"

    def __init__(self, config: DDCOConfig, **ignored: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.about = json.loads(config.controller)
        for name, (shape, kind) in json.loads(config.weights).items():
            self.register_buffer(name, torch.zeros(shape, dtype=getattr(torch, kind)))
        self.episodes = 0
        self.reset()

    def reset(self) -> None:
        """Begin an episode in every environment."""
        self._controllers: list[_Controller] = []

    @property
    def active(self) -> list[dict[str, str]]:
        """The name of the active option of each level, for each environment."""
        return [controller.active for controller in self._controllers]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **ignored: Any) -> Tensor:
        """The controls of all environments [B, A], in the control's own units.

        :raises ValueError: an observation is missing, or has another shape than in training.
        """
        specs = self.about["observations"]
        names = {
            spec["key"]: "observation." + spec["key"].replace("/", ".") for spec in specs if not self._built_in(spec)
        }
        if missing := [name for name in names.values() if name not in batch]:
            raise ValueError(f"the batch has no {missing[0]!r} (it has: {', '.join(sorted(batch))})")
        rows = {key: batch[name].cpu().numpy() for key, name in names.items()}
        count = len(next(iter(rows.values()))) if rows else 1
        if not self._controllers:
            weights = {name.replace("/", "."): array.cpu().numpy() for name, array in self.named_buffers()}
            self._controllers = [_Controller(weights, self.about, self.episodes + row) for row in range(count)]
            self.episodes += count
        controls = []
        for row, controller in enumerate(self._controllers):
            seen = {spec["key"]: _own(rows[spec["key"]][row], spec) for spec in specs if spec["key"] in rows}
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


def _own(value: np.ndarray, spec: dict[str, Any]) -> np.ndarray:
    """An observation as the controller saw it: pictures uint8 [H, W, C], vectors in their shape."""
    if spec["image"]:
        if value.dtype != np.uint8:
            value = np.round(255 * value).astype(np.uint8)
        return value if value.shape == tuple(spec["shape"]) else np.moveaxis(value, 0, -1)
    return value.reshape(spec["shape"])
