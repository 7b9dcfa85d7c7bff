"""The convolutions of a fit as an encoder, which has learnt from controls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from pydantic import field_validator

from ddco_pyro.data.pictures import Transform
from ddco_pyro.encoding.autoencoder import PictureNetwork
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.model.networks import InputShape, Network, build_trunk
from ddco_pyro.model.networks.conv import Conv
from ddco_pyro.model.networks.lstm import Lstm
from ddco_pyro.model.networks.perceptrons import Branches
from ddco_pyro.spec import NetworkSpec
from ddco_pyro.spec.base import Count, Items, Model
from ddco_pyro.spec.networks import BranchesSpec, LstmSpec

Part = tuple[NetworkSpec, Network, Sequence[str]]
"""A network of a fit: its spec, the network, and the names of the observations that it reads."""


class Reader(Model):
    """A network that reads one observation's pictures, beside its weights."""

    network: NetworkSpec
    """Convolutions. A user's class is refused, because what is written beside a file has to be safe to read."""
    crop: Items[int] | None = None
    resize: Items[Count] | None = None

    @field_validator("network")
    @classmethod
    def _convolutions(cls, network: NetworkSpec) -> NetworkSpec:
        if network.network != "conv" or len(network.inputs) != 1:
            raise ValueError("has to be convolutions over one observation")
        return network


class FittedReader(PictureNetwork):
    """Pictures, as they are stored, to the last hidden layer of a fit's network.

    :param about: the network, and how pictures are cropped and scaled for it.
    :param picture: [H, W, C].
    """

    def __init__(self, about: Reader, picture: Sequence[int]) -> None:
        super().__init__()
        self.about = about
        self.transform = Transform(about.crop, about.resize)
        (self.key,) = about.network.inputs
        self.network = build_trunk(about.network, InputShape({}, {self.key: self.transform.shape(picture)}), 1)
        self.eval()

    def encode(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture by itself, float32 [N, F]."""
        return super().encode(self.transform(pictures))


def from_folder(folder: str, key: str, picture: Sequence[int], allow_code: bool = False) -> FittedReader:
    """:func:`from_fit` of the fit in a run folder.

    :raises BadInput: there is no finished fit, or as :func:`from_fit`.
    """
    reader = from_fit(load(Path(folder), allow_code), key, picture)
    reader.code = (Path(folder) / "model.safetensors").read_bytes()  # the folder may change later
    return reader


def from_fit(fit: Fit, key: str, picture: Sequence[int]) -> FittedReader:
    """The convolutions in a fit that read the pictures under ``key`` and nothing else.

    They are the network of a flat policy or of the lowest options, a branch of it, or the network under its LSTM. The
    options have to share them.

    :param picture: [H, W, C] of the pictures that are to be encoded.
    :raises BadInput: the fit observed other pictures, or stacks of several, or has no such network.
    """
    encoder, shape = fit.hierarchy.encoder, tuple(picture)
    found, transform = next(_readers(_lowest(fit), key), None), encoder.transforms.get(key)
    problem = ""
    if transform is None:
        there = ", ".join(encoder.transforms) or "none"
        problem = f"this fit observes no pictures {key!r}; the pictures it observes: {there}"
    elif encoder.shapes[key] != shape:
        problem = f"this fit observed {key} of {encoder.shapes[key]}, and these are {shape}"
    elif transform.frames > 1:
        problem = f"this fit sees {transform.frames} pictures at once; take one with frames: 1"
    elif found is None:
        problem = f"its lowest policy has no convolutions that read {key} alone; make them a branch"
    elif found[1].copies != 1:
        problem = f"each option has a network of its own for {key}; take a flat policy, or one with shared: true"
    if problem or transform is None or found is None:
        raise BadInput(f"{fit.place}: {problem}")
    network = found[0].model_copy(update={"inputs": (key,), "shared": False})
    about = Reader(network=network, crop=transform.crop, resize=transform.resize)
    reader, weights = FittedReader(about, picture), found[1].state_dict()
    reader.network.load_state_dict({name: weights[name] for name in reader.network.state_dict()})
    return reader


def _lowest(fit: Fit) -> Part:
    """The network of a flat policy; else the hierarchy's trunk, the lowest level's trunk, or that level's policy."""
    networks, encoder = fit.hierarchy.networks(), fit.hierarchy.encoder
    whole, flat = fit.spec.hierarchy, fit.spec.baseline
    places: dict[str, NetworkSpec | None] = {"meta_policy": flat.policy if flat else None}
    if whole is not None and flat is None:
        lowest = whole.levels[0]
        places = {"trunk": whole.trunk, "levels.0.trunk": lowest.trunk, "levels.0.policy": lowest.policy}
    place, spec = next((place, spec) for place, spec in places.items() if spec is not None)
    return spec, networks[place], spec.inputs or [*encoder.keys, *encoder.images]


def _readers(part: Part, key: str) -> Iterator[Part]:
    """The convolutions within a network that read these pictures and nothing else."""
    spec, network, reads = part
    if isinstance(network, Conv) and [*reads] == [key]:
        yield spec, network, reads
    within: list[Part] = []
    if isinstance(network, Branches) and isinstance(spec, BranchesSpec):
        named = zip(spec.of.items(), network.branches(), strict=True)
        within = [(branch, own, branch.inputs or (name,)) for (name, branch), own in named]
    elif isinstance(network, Lstm) and isinstance(spec, LstmSpec) and spec.over is not None:
        within = [(spec.over, network.over, spec.over.inputs or reads)]
    for inner in within:
        yield from _readers(inner, key)
