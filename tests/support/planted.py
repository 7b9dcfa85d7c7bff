"""Planted hierarchies: a truth with known options, demonstrations of it, and how well training finds it."""

import numpy as np
import torch
from random_demonstrations import numbered
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.events import ignore
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.model.ahmm import Acting, choose
from ddco_pyro.model.batch import encode
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.tables import complete
from ddco_pyro.spec import parse_spec, with_overrides
from ddco_pyro.training.networks import Dimensions, build_hierarchy
from ddco_pyro.training.restarts import Trainer

LINEAR = {"network": "linear"}
SIGMA = 0.05
CONTROL = {"std": SIGMA}
"""Of a truth, whose scaled units are the control's own."""
TRAINING = {"epochs": 900, "starts": ["vq_controls"] * 3, "patience": 25}


def small_spec(counts=(2,), policy=LINEAR, name="level", **sections):
    """Levels whose policies are of one kind, terminations and meta-policy linear; no counts: a flat policy.

    :param name: of the level; of several levels each has its number behind it.
    """
    several = [f"{name}-{d}" for d in range(1, 1 + len(counts))]
    names = [name] if len(counts) == 1 and name != "level" else several
    levels = [{"name": own, "count": k, "policy": policy} for own, k in zip(names, counts, strict=True)]
    flat = {"baseline": {"kind": "flat", "policy": policy}}
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["state"],
            **({"hierarchy": {"levels": levels, "meta_policy": LINEAR}} if counts else flat),
            **sections,
        }
    )


def make_spec(counts=(2,), seed=0, control=None, **training):
    training = {"optimizer": {"lr": 0.03}, "epochs": 20, **training}
    return small_spec(counts, control=control or {"std": 0.1}, training=training, seed=seed)


def in_units_of(spec, demos, sigma=SIGMA):
    """A spec with the truth's σ in the units to which the controls of these demonstrations are scaled."""
    spreads = np.concatenate([demo.actions for demo in demos]).std(0)
    parts = []
    for d, own in enumerate(spreads):
        parts.append({"name": f"x{d}", "dims": [d], "kind": "gaussian", "std": sigma / own})
    return with_overrides(spec, {"control.parts": parts})


def make_trainer(spec, demos, path, on_event=ignore, jobs=1):
    train, tune = demos.split(0.2, 0)
    return Trainer(spec, Dimensions.of(demos), train, tune, path, on_event, jobs)


def plant(truth, number, steps, seed):
    """Demonstrations and true choices from running the Pyro model in a plane that controls move through."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    state = torch.rand(number, 2, generator=generator) * 2 - 1
    states, actions, choices, previous = [], [], [], None
    for t in range(steps):
        with torch.no_grad():
            outputs = truth(Inputs({"state": state[:, None]}, {}, torch.tensor([t])))
            chain = complete(outputs.tables(), torch.ones(number, dtype=torch.long))
            previous = choose(t, chain.steps()[0], previous)
            steps = (emission and emission.steps()[0] for emission in outputs.emissions)
            acting = Acting(tuple(steps), previous)
            action = acting.draw(torch.randn(number, *acting.event_shape, generator=generator))
        states.append(state)
        action = truth.scaling.emitted(action)
        actions.append(action)
        choices.append(torch.stack(previous, -1))
        state = (state + action[:, :2].float()).clamp(-1, 1)
    arrays = [torch.stack(part, 1).double().numpy() for part in (states, actions)]
    rows = zip(*arrays, strict=True)
    return numbered(({"state": state}, action) for state, action in rows), torch.stack(choices, 1)


def preferences(callers, options):
    """Logits [callers, 1, options]: each caller selects one of two neighbours, hardly ever another option."""
    first = torch.arange(callers)[:, None] * options // callers
    offset = (torch.arange(options) - first) % options
    return torch.where(offset < 2, 4.0, -4.0).unsqueeze(1)


def make_truth(spec, ending=-1.7):
    """Options that each head for a corner of their own; callers that each select some options below."""
    truth = build_hierarchy(spec, Dimensions({"state": (2,)}, 2, 1))
    truth.encoder.requires_grad_(False)
    corners = torch.tensor([[0.8, 0.8], [-0.8, 0.8], [-0.8, -0.8], [0.8, -0.8]])
    with torch.no_grad():
        for number, level in enumerate(truth.levels):
            if number == 0:
                level.policy.network.layers[0].weight[:] = -0.35 * torch.eye(2)
                level.policy.network.layers[0].bias[:] = 0.35 * corners[: level.count, None]
            else:
                level.policy.network.layers[0].weight.zero_()
                below = truth.levels[number - 1].count
                level.policy.network.layers[0].bias[:] = preferences(level.count, below)
            level.termination.layers[0].weight.zero_()
            level.termination.layers[0].bias[:] = ending
        truth.meta_policy.network.layers[0].weight.zero_()
        truth.meta_policy.network.layers[0].bias.zero_()
    return truth.eval()


def tabulated(model, demos):
    """What a model says of demonstrations, and the batch that they are for it."""
    with torch.no_grad():
        batch = encode(demos, model.encoder, model.scaling)
        return model.tabulate(batch), batch


def per_step(model, batch):
    """The log-likelihood."""
    with torch.no_grad():
        return float(log_likelihood(model.tabulate(batch), batch.lengths).sum()) / batch.steps


def recovered(found, truth, held_out, choices):
    """Held-out log-likelihood per step of both, and the NMI of their segments with each level's truth."""
    values = {}
    for name, model in (("found", found), ("truth", truth)):
        tables, batch = tabulated(model, held_out)
        values[name] = per_step(model, batch)
        values[f"{name} nmi"] = [
            float(normalized_mutual_info_score(choices[..., level].flatten(), one.flatten()))
            for level, one in enumerate(segment(tables, batch.lengths))
        ]
    return values
