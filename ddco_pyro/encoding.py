"""Features of pictures: a frozen backbone and principal components, in a file and while a policy acts."""

from __future__ import annotations

import hashlib
import importlib
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError
from sklearn.decomposition import PCA
from torch.nn.functional import interpolate

from ddco_pyro.data.arrays import Observed, blocks, is_picture
from ddco_pyro.data.demonstration import Demonstration, check
from ddco_pyro.data.demonstrations import problems_of_masks
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import opened
from ddco_pyro.data.sources import Source, open_source, refuse_foreign
from ddco_pyro.data.sources.robomimic import robomimic_file, write_demonstration
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.spec.base import Count, Items, Model
from ddco_pyro.training.processes import one_thread

__all__ = ["Encoder", "encode", "load"]

TIMM = "timm"

AT_ONCE = 32
"""Most pictures of a call of the backbone."""

SIZE = 64
"""Most principal components unless their number is given."""

NOISE = 1e-4
"""Share of the first component's variance below which a component is noise: a hundredth of its spread. All
components have the unit of the features; standardised one by one, noise would count as much as what moves."""

TOLERANCE = 1e-3
"""Largest difference between two calls on the same picture, as a part of the largest feature."""

ENCODERS = "encoders"
"""Group of a file: the encoder of each observation that was encoded."""


# --- backbones ----------------------------------------------------------------------------------------------


class Backbone:
    """A frozen network: uint8 pictures [N, H, W, C] to features [N, F].

    :param name: ``timm:NAME`` for a pretrained model of timm, or a user's ``module:function``.
    :raises BadInput: it cannot be had, or is user code and that is not allowed; at a call, it fails or gives
        no features.
    """

    def __init__(self, name: str, allow_code: bool = False) -> None:
        self.name = name
        module, _, rest = name.partition(":")
        if not rest:
            raise BadInput(
                f"there is no encoder {name!r}; take timm:NAME, such as timm:resnet18.a1_in1k, or your own "
                "module:function"
            )
        if module != TIMM and not allow_code:
            raise BadInput(
                f"encoder {name!r} would import user code; pass --allow-code if you trust it (in Python: "
                "allow_code=True)"
            )
        try:
            self._call: Any = _pretrained(rest) if module == TIMM else resolve_name(name)
        except Exception as error:  # whatever the network's code raises
            install = "pip install 'ddco-pyro[timm]' (torchvision has to fit torch)"
            remedy = f"; check the name, the connection, and: {install}" if module == TIMM else ""
            raise BadInput(f"encoder {name!r} cannot be loaded: {_message(error)}{remedy}") from error

    @property
    def code(self) -> bytes:
        """The source of the module; empty where that is not one file."""
        module = sys.modules.get(self.name.partition(":")[0])
        return Path(module.__file__).read_bytes() if module is not None and module.__file__ else b""

    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture, float32 [N, F]."""
        try:
            values = np.asarray(self._call(pictures))
        except Exception as error:
            why = f"fails on pictures {[*pictures.shape]}: {_message(error)}"
            raise BadInput(f"encoder {self.name!r} {why}") from error
        count = len(pictures)
        if values.dtype.kind != "f" or values.ndim != 2 or len(values) != count or not values.shape[1]:
            had = f"{values.dtype} {[*values.shape]} for {count} pictures"
            raise BadInput(f"encoder {self.name!r} gives {had}; it has to be floats [{count}, features]")
        values = values.astype(np.float32)
        if not np.isfinite(values).all():
            raise BadInput(f"encoder {self.name!r} gives features that are NaN or infinite in float32")
        return values

    def features(self, pictures: Observed) -> np.ndarray:
        """Features [T, F] of pictures [T, H, W, C], of which few are in memory at a time."""
        return np.concatenate([self(batch) for batch in _batches(pictures)])

    def try_out(self, pictures: np.ndarray) -> int:
        """The number of features, after comparing those of a second call, and of a picture alone.

        :raises BadInput: they differ, or the backbone fails.
        """
        first, again, alone = self(pictures), self(pictures), self(pictures[:1])
        for values, other, when in (
            (first, again, "when it is called again; switch off dropout and noise"),
            (first[:1], alone, "of a picture among others than alone; switch to evaluation mode"),
        ):
            if values.shape != other.shape or np.abs(values - other).max() > TOLERANCE * np.abs(first).max():
                raise BadInput(f"encoder {self.name!r} gives other features {when}")
        return first.shape[1]


def _pretrained(name: str) -> Callable[[np.ndarray], np.ndarray]:
    """timm's model of this name, without its classifier. Its weights are downloaded at the first use.

    Whole pictures are scaled to the size and the colours that the model was trained with.
    """
    timm = importlib.import_module(TIMM)
    network = timm.create_model(name, pretrained=True, num_classes=0).eval()
    trained_with = timm.data.resolve_model_data_config(network)
    mean, std = (torch.tensor(trained_with[key])[:, None, None] for key in ("mean", "std"))

    @torch.no_grad()
    def features(pictures: np.ndarray) -> np.ndarray:
        colours = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255
        scaled = interpolate(colours, trained_with["input_size"][1:], mode="bilinear", antialias=True)
        return network((scaled - mean) / std).numpy()  # type: ignore[no-any-return]

    return features


def _message(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


# --- principal components -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Projection:
    """The projection onto principal components: (x − ``mean`` [F]) · ``components`` [N, F]ᵀ.

    :param explained: the share of the features' variance that is kept.
    """

    mean: np.ndarray
    components: np.ndarray
    explained: float

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """[T, F] to float32 [T, N]."""
        return ((features - self.mean) @ self.components.T).astype(np.float32)


def principal_components(blocks: Sequence[np.ndarray], size: int, least: float = 0.0) -> Projection:
    """The ``size`` principal components of the rows of blocks [M, F], at least ``size`` in all.

    :param least: components with a smaller share of the first one's variance are left out.
    """
    with one_thread():  # same bits
        fitted = PCA(svd_solver="covariance_eigh").fit(np.concatenate(blocks).astype(np.float64))
    variance = fitted.explained_variance_
    size = min(size, max(1, int((variance >= least * variance[0]).sum())))
    explained = float(variance[:size].sum() / variance.sum()) if variance.any() else 1.0
    return Projection(fitted.mean_, fitted.components_[:size], explained)


# --- encoders -----------------------------------------------------------------------------------------------


class About(Model):
    """The facts of an encoder.

    :param encoder: ``timm:NAME`` or ``module:function``.
    :param observation: the key of the pictures [H, W, C] it was made for.
    :param features: their number before they are reduced to ``size``.
    :param explained: the share of their variance in the training demonstrations that is kept.
    """

    encoder: str
    observation: str
    picture: Items[Count]
    features: Count
    size: Count
    explained: float = 1.0


@dataclass(frozen=True)
class Encoder:
    """A picture to a vector: call it with uint8 [H, W, C], and it gives float32 [size]."""

    about: About
    backbone: Backbone
    projection: Projection | None

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The features that a policy, fitted to them, reads in place of the picture.

        :raises BadInput: the picture has another type or shape.
        """
        picture = np.asarray(picture)
        if picture.dtype != np.uint8 or picture.shape != self.about.picture:
            raise BadInput(
                f"{self.about.observation}: is {picture.dtype} {picture.shape}; this encoder reads uint8 "
                f"{self.about.picture}"
            )
        return self.reduced(self.backbone(picture[None]))[0]

    def reduced(self, features: np.ndarray) -> np.ndarray:
        """The backbone's features [T, F] as float32 [T, size]."""
        return features if self.projection is None else self.projection(features)

    @property
    def digest(self) -> str:
        """SHA-256 of what decides the features: facts, the code of a user's module, and the projection."""
        sha256 = hashlib.sha256(self.about.model_dump_json().encode() + self.backbone.code)
        if self.projection is not None:
            sha256.update(self.projection.mean.tobytes() + self.projection.components.tobytes())
        return sha256.hexdigest()


def load(path: str | Path, key: str | None = None, allow_code: bool = False) -> Encoder:
    """An encoder in a file that ``ddco-pyro encode`` has written.

    :param key: the observation that it gives; needed where the file has several.
    :param allow_code: import the user's function that it names.
    :raises BadInput: there is none, it is damaged, or it names user code and that is not allowed.
    """
    with opened(path) as file:
        known = list(file.get(ENCODERS, ()))
        if key not in known and (key is not None or len(known) != 1):
            there = ", ".join(known) or "none"
            wanted = key or "one observation alone"
            raise DemonstrationsError(f"there is no encoder of {wanted}; there is: {there}")
        group = file[ENCODERS][key or known[0]]
        try:
            about = About.model_validate_json(group.attrs["about"])
        except ValidationError as error:
            damage = f"{group.name} is damaged ({_message(error)})"
            raise DemonstrationsError(f"{damage}; encode the file again") from error
        projection = None
        if "components" in group:
            projection = Projection(group["mean"][()], group["components"][()], about.explained)
    return Encoder(about, Backbone(about.encoder, allow_code), projection)


# --- files --------------------------------------------------------------------------------------------------


def encode(
    path: str | Path,
    out: str | Path,
    observation: str,
    encoder: str,
    size: int | None = None,
    name: str | None = None,
    on_event: OnEvent = ignore,
    allow_code: bool = False,
) -> Encoder:
    """Write the demonstrations of ``path`` to ``out``, features in place of pictures; return the encoder.

    ``out`` holds the encoder, too. Principal components are those of the training demonstrations:
    ``mask/train``, else all that are not in ``mask/valid``.

    :param observation: the key of the pictures, uint8 [T, H, W, C].
    :param encoder: ``timm:NAME`` or ``module:function``.
    :param size: number of principal components. By default at most :data:`SIZE`, without those that are noise
        (:data:`NOISE`); fewer features are not projected.
    :param name: the new observation's key; ``<observation>_features`` by default.
    :raises DemonstrationsError: they cannot be used, or the observation is missing or no picture.
    :raises BadInput: ``out`` exists; the encoder cannot be used, or gives fewer features than ``size``.
    """
    path, out, key = Path(path), Path(out), name or f"{observation}_features"
    if out.exists():
        raise BadInput(f"{out}: is there already; remove it, or choose another --out")
    refuse_foreign(path)
    with open_source(path, "robomimic") as source:
        demos = {own: source.read(own) for own in source.names}
        training = _checked(source, demos, observation)
        if key in demos[source.names[0]].observations:
            raise DemonstrationsError(f"obs/{key} is there already; choose another name with --as")
        pictures = {own: demo.observations[observation] for own, demo in demos.items()}
        backbone = Backbone(encoder, allow_code)
        number = backbone.try_out(next(_batches(pictures[training[0]])))
        steps = sum(pictures[own].shape[0] for own in training)
        if size is not None and size > min(number, steps):
            there = f"encoder {encoder!r} gives {number} features of {steps} training pictures"
            raise BadInput(f"--size {size}: {there}; take at most {min(number, steps)}")
        features = dict[str, np.ndarray]()
        for own, array in pictures.items():
            features[own] = backbone.features(array)
            on_event(Counted("encoding", len(pictures), done=len(features)))
        projection = None
        if size is not None or number > min(SIZE, steps):
            rows = [features[own] for own in training]
            projection = principal_components(rows, size or min(SIZE, steps), NOISE if size is None else 0.0)
        about = About(
            encoder=encoder,
            observation=observation,
            picture=pictures[training[0]].shape[1:],
            features=number,
            size=number if projection is None else len(projection.components),
            explained=1.0 if projection is None else projection.explained,
        )
        made = Encoder(about, backbone, projection)
        with robomimic_file(out, source.attributes, source.masks) as data, opened(path) as before:
            for own, demo in demos.items():
                seen = {other: array for other, array in demo.observations.items() if other != observation}
                seen[key] = made.reduced(features[own])
                write_demonstration(data, Demonstration.stored(**{**vars(demo), "observations": seen}))
            if ENCODERS in before:
                before.copy(ENCODERS, data.file)
            group = data.file.create_group(f"{ENCODERS}/{key}")
            group.attrs["about"] = about.model_dump_json()
            if projection is not None:
                group["mean"], group["components"] = projection.mean, projection.components
    return made


def _checked(source: Source, demos: Mapping[str, Demonstration], key: str) -> tuple[str, ...]:
    """The names of the training demonstrations, of which every one is checked."""
    first = demos[source.names[0]]
    if key not in first.observations:
        known = [name for name, array in first.observations.items() if is_picture(array)]
        there = ", ".join(known) or "none"
        lacks = f"there is no observation {key!r}{nearest(key, known)}"
        raise DemonstrationsError(f"{lacks}; pictures are: {there}")
    for name, demo in demos.items():
        check(demo, first)
        array = demo.observations[key]
        if not is_picture(array) or not math.prod(array.shape[1:]):
            had = f"{array.dtype} {[*array.shape]}"
            raise DemonstrationsError(
                f"{name}: obs/{key} is {had}; pictures are uint8 [steps, height, width, channels]"
            )
    for problem in problems_of_masks(source.masks, source.names):
        raise DemonstrationsError(problem)
    held_out = set(source.masks.get("valid", ()))
    training = source.masks.get("train", tuple(name for name in source.names if name not in held_out))
    if not training:
        raise DemonstrationsError("no demonstration is left to train with; change the masks")
    return training


def _batches(pictures: Observed) -> Iterator[np.ndarray]:
    """Pictures in order, [M, H, W, C] with M at most :data:`AT_ONCE`."""
    for block in blocks(pictures):
        yield from (block[start : start + AT_ONCE] for start in range(0, len(block), AT_ONCE))
