"""Random hierarchies over three features and two control dimensions, and batches for them."""

import torch
from planted import LINEAR, small_spec

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.model.networks import Inputs

SHAPES = {"state": (3,)}


def make_hierarchy(
    counts=(3,),
    emits=("options",),
    network="mlp",
    seed=0,
    memoryless=(),
    ends=LINEAR,
    lowest=None,
    parts=None,
    steps=4,
    **control,
):
    """A random hierarchy over 3 features and 2 control dimensions; ``counts`` lowest level first.

    :param network: of all policies; ``lowest`` are those that act, ``ends`` terminations, if they are others.
    :param memoryless: numbers of the levels, 1 the lowest, whose options end after every step.
    """
    reads = network if isinstance(network, dict) else {"network": network}
    caller, whole = reads | {"emits": list(emits)}, {"control": {"std": 0.7, **control}}
    levels = [
        {
            "name": f"level-{d}",
            "count": k,
            "policy": caller if d > 1 else lowest or reads,
            "termination": "always" if d in memoryless else ends,
        }
        for d, k in enumerate(counts, 1)
    ]
    if counts:
        whole["hierarchy"] = {"levels": levels, "meta_policy": caller}
    spec = small_spec(counts, lowest or reads, **whole)
    torch.manual_seed(seed)
    return Hierarchy(spec, Dimensions(SHAPES, 2, steps, parts=parts))


def varied(hierarchy):
    """The same without weights that are 0, as if it had been trained."""
    torch.manual_seed(5)
    with torch.no_grad():
        for parameter in hierarchy.parameters():
            parameter[parameter == 0] = 0.1 * torch.randn(int((parameter == 0).sum()))
    return hierarchy


def make_batch(trajectories=2, steps=4, seed=1, features=3):
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(trajectories, steps, features, generator=generator)
    actions = torch.randn(trajectories, steps, 2, generator=generator)
    lengths = torch.tensor([steps, *[steps - 1] * (trajectories - 1)])
    return Batch(Inputs({"state": vector}, {}, torch.arange(steps)), actions, lengths)
