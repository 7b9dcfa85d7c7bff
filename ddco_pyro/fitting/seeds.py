"""Repetitions of a fit with other training seeds, and how much the results vary with the seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from ddco_pyro.data.files import only_one
from ddco_pyro.errors import BadInput
from ddco_pyro.events import OnEvent, SeedFitted, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Metrics, Seeds
from ddco_pyro.spec import Spec, with_overrides


def check_seeds(spec: Spec, seeds: int) -> None:
    """Refuse a number of training seeds that a fit cannot be repeated with.

    :raises BadInput: no demonstrations are held out, or the last seed is too large.
    """
    if not spec.demonstrations.validates:
        raise BadInput("--seeds compares on held-out demonstrations; raise demonstrations.valid_fraction")
    with_overrides(spec, {"training.seed": training_seeds(spec, seeds)[-1]})


def training_seeds(spec: Spec, seeds: int) -> list[int]:
    """The training seeds of a fit and its repetitions: the spec's own, and the numbers after it."""
    first = spec.seed if spec.training.seed is None else spec.training.seed
    return list(range(first, first + seeds))


def repeat(first: Fit, seeds: int, on_event: OnEvent = ignore, jobs: int = 1) -> Fit:
    """Repeat a fit and its baselines with other training seeds, ``seeds`` in all.

    Each repetition is a run in ``seeds/SEED`` of the run folder; a finished one is not done again.

    :param jobs: processes that fit side by side; -1 is one for each core. The result is the same for any number.
    :returns: the fit, with the results of all repetitions in ``metrics.seeds`` and ``metrics.json``.
    :raises Failed: a process died.
    """
    folder, numbers = first.run_folder, training_seeds(first.spec, seeds)
    each = {numbers[0]: first.metrics}
    with only_one(folder):
        calls = {seed: partial(_again, first.spec, seed, folder / "seeds" / str(seed)) for seed in numbers[1:]}
        with run_all(calls, Workers(jobs), "repeated the fit") as repeated:
            for seed, metrics in repeated:
                each[seed] = metrics
                on_event(SeedFitted(len(calls)))
        first.metrics.seeds = over_seeds(numbers, [each[seed] for seed in numbers])
        first.metrics.write(folder)
    return first


def _again(spec: Spec, seed: int, folder: Path) -> Metrics:
    return fit(with_overrides(spec, {"training.seed": seed}), None, folder).metrics


def roll_out_repetitions(first: Fit, on_event: OnEvent = ignore, jobs: int = -1) -> None:
    """Roll out the repetitions of a fit from the initial states of its own rollouts.

    Adds ``rollouts.seeds`` to the fit's metrics: success rates by method, and the parts of the worth. A fit without
    repetitions stays as it is.
    """
    rollouts, seeds = first.metrics.rollouts, first.metrics.seeds
    if seeds is None or rollouts is None:
        return
    each = [rollouts]
    for again in first.repetitions:
        alone = replace(again, spec=with_overrides(again.spec, {"rollout.policies": []}))  # scripts have no seeds
        each.append(roll_out(alone, rollouts.episodes, 0, on_event, jobs, resume=True))
    rates = {name: [one.success_rates[name].rate for one in each] for name in each[-1].success_rates}
    pairs = [dict(one.worth or ()) for one in each]
    worth = {
        part: [(own[part].only_ours - own[part].only_theirs) / rollouts.episodes for own in pairs]
        for part in PARTS
        if pairs[0].get(part)
    }
    found = Seeds.model_validate({"training_seeds": seeds.training_seeds, "success": rates, "worth": worth})
    first.metrics.rollouts = rollouts.model_copy(update={"seeds": found})
    first.metrics.write(first.run_folder)


PARTS = ("memory", "experts", "total")
"""The parts of a :class:`~ddco_pyro.metrics.Worth`."""


def over_seeds(seeds: Sequence[int], each: Sequence[Metrics]) -> Seeds:
    """The results of fits with these training seeds, from the metrics of each."""
    held_out = {each[0].model: [metrics.log_likelihood_per_step.valid for metrics in each]}
    for name in each[0].comparison:
        held_out[name] = [metrics.comparison[name].log_likelihood_per_step.valid for metrics in each]
    pairs = [dict(metrics.worth or ()) for metrics in each]
    parts = [part for part in PARTS if pairs[0].get(part)]
    return Seeds.model_validate(
        {
            "training_seeds": list(seeds),
            "held_out": held_out,
            "worth": {part: [own[part].nats_per_step for own in pairs] for part in parts},
            "standard_error": {part: [own[part].standard_error for own in pairs] for part in parts},
        }
    )
