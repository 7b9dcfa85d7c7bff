"""Runs that were never fitted, of every kind of network, for exports."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import torch
from hierarchies import varied

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import parse_spec

SHAPES = {"state": (3,), "goal": (2, 2), "camera": (9, 12, 3)}


def make(
    network="mlp",
    counts=(3,),
    emits=("options",),
    camera=False,
    steps=7,
    endings=None,
    built_in=(),
    trunk=None,
    meta_policy=None,
    vectors=True,
    bins=0,
    turns=False,
    std=MappingProxyType({"learn": True}),
    **rollout,
):
    """A run that was never fitted: random weights, observations with a mean and a spread.

    :param camera: whether there are pictures, or how they are cut.
    """
    policy = network if isinstance(network, dict) else {"network": network}
    levels = [
        {"name": f"level-{d}", "count": k, "policy": policy | ({"emits": list(emits)} if d else {})}
        for d, k in enumerate(counts)
    ]
    turned = [{"angles": [1]}, {"quaternions": [0]}] if turns else [{}, {}]
    state, goal = ({"key": key} | own for key, own in zip(("state", "goal"), turned, strict=True))
    own = {"differences": True, "bins": bins}
    seen = [state | own, goal, *built_in] if vectors else []
    pictures = [{"key": "camera", **(camera if isinstance(camera, dict) else {})}] if camera else []
    endings = endings or {"network": network if network in ("conv", "per_timestep") else "linear"}
    model = {
        "hierarchy": {
            "trunk": trunk,
            "levels": [level | {"termination": endings} for level in levels],
            "meta_policy": (meta_policy or policy) | {"emits": list(emits)},
        }
    }
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": [*seen, *pictures],
            "control": {"std": dict(std)},
            "rollout": rollout,
            **(model if counts else {"baseline": {"kind": "flat", "policy": policy}}),
        }
    )
    torch.manual_seed(1)
    hierarchy = Hierarchy(spec, SHAPES, 2, steps)
    hierarchy.encoder.mean.uniform_(-3, 3)
    hierarchy.encoder.std.uniform_(0.5, 2)
    hierarchy.encoder.mean[3:6] = 0  # of the differences: it goes to and fro
    if bins:
        own = slice(6, 6 * (1 + bins))
        hierarchy.encoder.low[own].uniform_(-3, 1)
        hierarchy.encoder.high[own] = hierarchy.encoder.low[own] + 2
    hierarchy.scaling.scale.copy_(torch.tensor([10.0, 0.3]))
    hierarchy.scaling.shift.copy_(torch.tensor([-4.0, 1.0]))
    return Fit(spec, varied(hierarchy).eval())


def observe(random):
    """A random observation."""
    seen = {key: random.normal(size=shape) for key, shape in SHAPES.items()}
    return seen | {"camera": random.integers(0, 256, SHAPES["camera"], dtype=np.uint8)}


CONVOLUTIONS = {
    "network": "conv",
    "inputs": ["camera", "state"],
    "layers": [{"filters": 3, "kernel": 4, "stride": 2, "padding": 1}, {"filters": 2, "kernel": 3}],
    "activation": "elu",
    "pool": "spatial_softmax",
}
LEAKY = {
    "network": "conv",
    "layers": [{"filters": 2, "kernel": 5, "stride": 2, "padding": 2}],
    "pool": "flatten",
    "activation": "leaky_relu",
    "standardize": True,
}
RECURRENT = {"network": "lstm", "over": {"hidden": [6]}, "hidden": [5, 4]}
BRANCHES = {
    "network": "branches",
    "of": {
        "camera": {"network": "lstm", "over": LEAKY, "hidden": [4, 3], "horizon": 3},
        "pair": {"network": "mlp", "inputs": ["goal", "state"], "hidden": [6], "activation": "tanh"},
        "state": {"network": "lstm", "hidden": 3},
        "step": {"network": "linear"},
    },
    "hidden": [7],
}
SMALL = {"camera": {"resize": [7, 6]}, "built_in": ("step",)}
BOTH = ("options", "control")
FITS = {
    "linear": make("linear", options="most_likely"),
    "mlp": make("mlp", control="sample", options="sample"),
    "constant": make("constant", (2, 3), BOTH, camera=True, vectors=False, endings={"network": "constant"}),
    "per_timestep": make("per_timestep", steps=30),
    "bins": make("mlp", bins=4),
    "angles and quaternions": make("mlp", turns=True),
    "conv": make("conv", camera={"crop": [1, 2, 7, 9], "resize": [6, 8]}, options="sample"),
    "hybrid": make("mlp", (2, 3), BOTH, control="sample"),
    "σ of the state": make("mlp", (2, 3), BOTH, std={"learn": True, "per_state": True}, control="sample"),
    "three levels": make("mlp", (2, 3, 2), BOTH),
    "mixture": make("mlp", (3,), BOTH, endings="always", control="sample", options="sample"),
    "memoryless below": make("mlp", (2, 3), endings="always", options="marginal"),
    "flat": make("mlp", (), built_in=("step",)),
    "lstm": make(RECURRENT, (2, 2), BOTH, endings=RECURRENT, control="sample"),
    "lstm over pictures": make(
        {"network": "lstm", "over": CONVOLUTIONS}, camera=True, endings=CONVOLUTIONS, steps=30, options="sample"
    ),
    "trunk": make("mlp", (2, 3), BOTH, trunk=BRANCHES, options="sample", **SMALL),
    "branches": make(BRANCHES, (2, 3), BOTH, endings={"network": "linear", "inputs": ["state"]}, **SMALL),
    "pictures alone": make(LEAKY, camera=True, endings=LEAKY, vectors=False, options="sample"),
    "several convolutions": make(
        CONVOLUTIONS, camera=True, endings={"network": "linear", "inputs": ["step", "goal"]}, built_in=("step",)
    ),
}
