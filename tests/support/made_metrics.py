"""Metrics of a fit that was never made."""

from typing import Any

from ddco_pyro.metrics import Metrics

TRAINING = {
    "budget": {"epochs": 5, "gradient_steps": 10},
    "spent": {"epochs": 5, "gradient_steps": 10},
    "stages": [{"stage": "joint", "epochs": 5, "cap": 5, "rising": 0.0, "over": 5, "converged": True}],
    "converged": True,
    "restarts": {
        "best": 0,
        "spent": {"epochs": 5, "gradient_steps": 10},
        "each": [{"epochs": 5, "stopped": None, "start": "vq", "objective": 1.0}],
    },
    "objective": 1.0,
    "device": "cpu",
    "by_em": False,
    "by_lbfgs": False,
}


def compared(mean: float, error: float | None, **values: float) -> dict[str, Any]:
    """A baseline, the model's difference to it, and its log-likelihoods."""
    return {
        "log_likelihood_per_step": {"train": 0.0, "valid": 0.0} | values,
        "difference": {"nats_per_step": mean, "standard_error": error},
        "parameters": 1,
        "training": TRAINING,
    }


def made_metrics(held_out: int = 1, **fields: Any) -> Metrics:
    """Metrics with these fields and so many held-out demonstrations."""
    each = {"by_dimension": [1.0], "options": 0.0}
    names = [fields.get("model", "ddco"), *fields.get("comparison", {})]
    row = {"part": "valid", "steps": 1, "log_likelihood_per_step": dict.fromkeys(names, 1.0)}
    fixed = {
        "model": "ddco",
        "log_likelihood_per_step": {"train": 2.0, "valid": 1.0},
        "log_likelihood_by_dimension": {"train": each, "valid": each},
        "valid": [{"name": f"demo_{n}", "steps": 1, "log_likelihood": 1.0} for n in range(held_out)],
        "demonstrations_by_likelihood": [{"name": f"demo_{n}", **row} for n in range(held_out)],
        "comparison": {},
        "engine_check": {"value": 0.0, "gradient": 0.0},
        "demonstrations": {"train": 1, "tune": 1, "valid": held_out},
        "measure": {},
        "control_dimensions": [],
        "parameters": 7,
        "training": TRAINING,
        "seconds": {},
        "versions": {},
    }
    return Metrics.model_validate(fixed | fields)


def scored(
    train: dict[str, float], valid: dict[str, list[float]], marginal: float, controls: int, **more: Any
) -> Metrics:
    """Metrics of models with these log-likelihoods of held-out demonstrations of one step, the run's first.

    :param marginal: of the density without observations on held-out demonstrations, nats per step.
    """
    ours, *others = valid
    mean = {name: sum(values) / len(values) for name, values in valid.items()}
    each = range(len(valid[ours]))
    rows = [
        {
            "name": f"demo_{n}",
            "part": "valid",
            "steps": 1,
            "log_likelihood_per_step": {k: v[n] for k, v in valid.items()},
        }
        for n in each
    ]
    return made_metrics(
        len(each),
        model=ours,
        log_likelihood_per_step={"train": train[ours], "valid": mean[ours]},
        demonstrations_by_likelihood=rows,
        comparison={k: compared(mean[ours] - mean[k], 0.05, train=train[k], valid=mean[k]) for k in others},
        marginal={"train": marginal, "valid": marginal, "controls": controls},
        **more,
    )
