"""The page's section on what the hierarchy is worth: several experts and options that last, apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ddco_pyro.drawing import words
from ddco_pyro.drawing.page import Section, Table, note

EXPLAINED = (
    "A mixture has the hierarchy’s experts and the gate that chooses among them, and chooses anew at every step. "
    "Its lead over one flat policy is the worth of several experts and of their parameters. The hierarchy’s lead "
    "over it is the worth of options that last. This fit: ± one standard error over held-out demonstrations, p by "
    "McNemar’s exact test. Training seeds: mean with its 95 % interval."
)


def section(metrics: Mapping[str, Any]) -> Section | None:
    """The parts in held-out log-likelihood and in success, a row each; None where the run has no mixture."""
    if "worth" not in metrics:
        return None
    ours, rollouts = words.method(metrics["model"]), metrics.get("rollouts", {})
    flat = words.method(metrics["worth"].get("flat", "flat"))
    parts = {
        "experts": f"Several experts: mixture − {flat}",
        "memory": f"Options that last: {ours} − mixture",
        "total": f"Together: {ours} − {flat}",
    }
    columns = {"Nats per step, this fit": {part: words.with_error(metrics["worth"].get(part)) for part in parts}}
    if "seeds" in metrics:
        count = len(metrics["seeds"]["training_seeds"])
        columns[f"Nats per step, {count} training seeds"] = _over_seeds(metrics["seeds"]["worth"], 1, 2)
    if "worth" in rollouts:
        column = f"Successes of {rollouts['episodes']} episodes, this fit"
        columns[column] = {part: words.of_episodes(rollouts["worth"].get(part)) for part in parts}
    if "seeds" in rollouts:
        count = len(rollouts["seeds"]["training_seeds"])
        columns[f"Points of success, {count} training seeds"] = _over_seeds(rollouts["seeds"]["worth"], 100, 0)
    rows = [
        [name, *(values.get(part, "–") for values in columns.values())]
        for part, name in parts.items()
        if part in metrics["worth"]
    ]
    return Section("worth", "What the hierarchy is worth", [Table(["Part", *columns], rows), note(EXPLAINED)])


def _over_seeds(worth: Mapping[str, list[float]], scale: float, digits: int) -> dict[str, str]:
    shown = {}
    for part, values in worth.items():
        mean, low_high = words.signed(scale * float(np.mean(values)), digits), [*words.mean_interval(values)]
        shown[part] = f"{mean} [{words.interval(low_high, scale, digits)}]"
    return shown
