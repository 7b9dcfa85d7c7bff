"""What happens to observations before, and to controls after the policy: neither is scaled."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
    policy_action_to_transition,
    transition_to_policy_action,
)

from lerobot_policy_ddco.configuration_ddco import DDCOConfig


def make_ddco_pre_post_processors(
    config: DDCOConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """The controller scales by itself, so statistics of a dataset are not used."""
    before = [RenameObservationsProcessorStep(rename_map={}), AddBatchDimensionProcessorStep()]
    ready = [*before, DeviceProcessorStep(device=config.device)]
    return (
        PolicyProcessorPipeline(ready, name="policy_preprocessor"),
        PolicyProcessorPipeline(
            [DeviceProcessorStep(device="cpu")],
            name="policy_postprocessor",
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )
