"""A fit of a run's model to what a person has labelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.events import OnEvent, TrainingBegan, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.proposals import RIDGE, Pictures, weight, windows_of
from ddco_pyro.model.batch import encode
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.training.checkpoint import TrainingData, fitted_of
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.optimizers import optimizer_of
from ddco_pyro.training.processes import one_thread
from ddco_pyro.training.recognition import EM_STEPS, by_em, learn, typical_length

SAID = "said"
"""The labels of the demonstrations of a refit."""

EPOCHS = 40
"""EM steps of a refit of several levels, all stages together."""

STEPS = 8
"""EM steps of a refit, after those in which its options begin."""


def refit(
    trained: Fit,
    level: str,
    count: int,
    demos: Demonstrations,
    labels: Mapping[str, np.ndarray],
    kept: Mapping[str, np.ndarray],
    seen: Pictures = MappingProxyType({}),
    on_event: OnEvent = ignore,
) -> Fit:
    """The model with so many options at a level, fitted to all demonstrations and to a person's labels.

    Option h stands for label h. A level that EM trains, under a meta-policy alone, takes a few steps from the
    options that a recogniser of the labelled steps finds. Other models are fitted as their spec says.

    :param labels: an option of each step, [T], by demonstration; below 1 for none.
    :param kept: the option that each step begins with whatever the recogniser finds, likewise.
    :param seen: read by the recogniser of a single level that EM trains.
    """
    spec, before = refit_spec(trained, level, count), trained.hierarchy
    said = tuple(replace(demo, labels={SAID: labels[demo.name]}) for demo in demos)
    demos = replace(demos, demonstrations=said, masks={})  # all train
    with one_thread():
        if before.depth > 1 or not _by_em(trained):
            return fit(spec, _tuned(spec, demos), on_event=on_event)
        on_event(TrainingBegan(trained.name, EM_STEPS + STEPS))
        names, size = demos.names, replace(before.dimensions, steps=max(demos.lengths))
        batch = encode(demos, before.encoder, before.scaling, fitted=True)
        known = _padded([demo.labels[SAID] for demo in demos])
        known = torch.where(known > 0, known, -1)
        named = Labels(1, tuple(range(1, count + 1)), names, known, known)
        data = TrainingData(spec, size, batch, batch, names, fitted_of(before), named)
        model = data.hierarchy(0)
        typical = typical_length(known.numpy())
        windows, (features,) = windows_of(before, count, typical, [(names, batch)], seen)
        learn(windows, features[known > 0], known[known > 0], RIDGE)
        own = _padded([kept[name] for name in names])
        silent, alive = own > 0, torch.arange(known.shape[1]) < batch.lengths[:, None]
        ratio = weight(float(before.power)) * windows.log_ratio(features)
        evidence = torch.where((silent | (known > 0)).unsqueeze(-1), 0.0, ratio)
        starts = torch.where(silent, own, windows.log_probability(features).argmax(-1) + 1)
        starts = torch.where(alive, torch.where(known > 0, known, starts), -1)
        by_em(data, model, batch, replace(named, train=starts, tune=starts), EM_STEPS, on_event)
        by_em(data, model, batch, replace(named, evidence=(evidence, evidence)), STEPS, on_event)
    return Fit(spec, model.eval(), trained.metrics.model_copy(update={"agreement": None}))


def _tuned(spec: Spec, demos: Demonstrations) -> Demonstrations:
    """The demonstrations, of which those without labels tune where there are any: labelled ones are few."""
    free = [demo.name for demo in demos if (demo.labels[SAID] < 1).all()]
    number = max(1, round(spec.training.tune_fraction * len(demos)))
    drawn = np.random.default_rng(spec.seed).permutation(free)[:number].tolist()
    return replace(demos, masks={"tune": tuple(drawn)} if drawn else {})


def _padded(rows: list[np.ndarray]) -> Tensor:
    each = [torch.as_tensor(row).long() for row in rows]
    return torch.nn.utils.rnn.pad_sequence(each, batch_first=True, padding_value=-1)


def refit_spec(trained: Fit, level: str, count: int) -> Spec:
    """The spec of a quick fit with labels :data:`SAID`: the model alone, a recogniser of the named steps."""
    assert trained.spec.hierarchy is not None
    place = [own.name for own in trained.spec.hierarchy.levels].index(level)
    recogniser = {"weight": weight(float(trained.hierarchy.power)), "ridge": RIDGE}
    changes: dict[str, Any] = {
        "compare_with": [],
        "demonstrations.labels": None,
        "demonstrations.hold_out_by": None,
        "demonstrations.valid_fraction": 0.0,
        "demonstrations.exclude": [],
        "training.starts": trained.spec.training.starts[:1],
        "training.labels": {"level": level, "from": SAID, "recogniser": recogniser},
        f"hierarchy.levels.{place}.count": count,
    }
    if _by_em(trained):
        ridge = trained.metrics.training.raised_ridge or trained.spec.training.optimizer.ridge.policy
        changes["training.tune_fraction"] = 0.0  # the few labelled demonstrations are to be trained with
        changes["training.epochs"] = EPOCHS
        changes["training.optimizer.ridge.policy"] = ridge
        changes["training.optimizer.ridge.cross_validated"] = False
    return with_overrides(trained.spec, changes)


def _by_em(trained: Fit) -> bool:
    return optimizer_of(trained.spec.training.optimizer, trained.hierarchy) == "em"
