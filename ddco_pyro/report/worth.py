"""The worth of options in the report, in two parts: several policies, and options that last."""

from __future__ import annotations

from ddco_pyro.drawing import words
from ddco_pyro.drawing.page import Section, Table, footnote
from ddco_pyro.metrics import Metrics
from ddco_pyro.names import method

EXPLAINED = (
    "A mixture has the options’ policies and the gate that chooses among them, and chooses anew at every step. The "
    "mixture’s lead over one flat policy is the worth of several policies and of their parameters. The options’ lead "
    "over the mixture is the worth of options that last. This fit: ± one standard error over held-out demonstrations, "
    "p by McNemar’s exact test. Training seeds: mean with its 95 % interval."
)


def section(metrics: Metrics) -> Section | None:
    """The parts in held-out log-likelihood and in success, a row each; None where the run has no mixture."""
    found, seeds, rollouts = metrics.worth, metrics.seeds, metrics.rollouts
    if not found:
        return None
    ours, flat = method(metrics.model), method(found.flat or "flat")
    parts = {
        "experts": f"Several policies: mixture − {flat}",
        "memory": f"Options that last: {ours} − mixture",
        "total": f"Together: {ours} − {flat}",
    }
    columns = {"Nats per step, this fit": {part: words.with_error(getattr(found, part)) for part in parts}}
    if seeds:
        each = {part: words.mean_and_interval(values) for part, values in seeds.worth.items()}
        columns[f"Nats per step, {len(seeds.training_seeds)} training seeds"] = each
    if rollouts and rollouts.worth:
        column = f"Successes of {rollouts.episodes} episodes, this fit"
        columns[column] = {part: words.of_episodes(getattr(rollouts.worth, part)) for part in parts}
    if rollouts and rollouts.seeds:
        each = {part: words.mean_and_interval(values, 100, 0) for part, values in rollouts.seeds.worth.items()}
        columns[f"Points of success, {len(rollouts.seeds.training_seeds)} training seeds"] = each
    rows = [
        [name, *(values.get(part, "–") for values in columns.values())]
        for part, name in parts.items()
        if getattr(found, part)
    ]
    return Section("worth", "What options are worth", [Table(["Part", *columns], rows), footnote(EXPLAINED)])
