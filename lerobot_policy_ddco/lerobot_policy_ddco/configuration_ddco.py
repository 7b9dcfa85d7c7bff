"""The configuration of an exported controller."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig


@PreTrainedConfig.register_subclass("ddco")
@dataclass
class DDCOConfig(PreTrainedConfig):
    """A controller of ``ddco-pyro export``, which the other files of its folder describe."""

    @property
    def observation_delta_indices(self) -> None:
        """One observation at a time."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """One control at a time."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None

    def get_optimizer_preset(self) -> None:
        """Refuse to train.

        :raises RuntimeError: always.
        """
        raise RuntimeError("a ddco policy is fitted with: ddco-pyro fit SPEC")

    def get_scheduler_preset(self) -> None:
        """No schedule: LeRobot does not train this policy."""
        return None

    def validate_features(self) -> None:
        """Nothing to check: the controller checks each observation."""
