"""An encoder of pictures: features of a built-in, a fitted or a user's network, reduced to principal components."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor

from ddco_pyro.data.files import Damaged, whole_folder
from ddco_pyro.data.memory import refuse_too_much
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.encoding.autoencoder import BUILT_IN, Convolutions, PictureNetwork
from ddco_pyro.encoding.fitted import FittedReader, Reader, from_folder
from ddco_pyro.encoding.pictures import Pictures
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.spec.base import Count, Items, Model, Seed

TOLERANCE = 1e-3
"""Largest difference between two calls on the same picture, as a part of the largest feature."""


class UserEncoder(PictureNetwork):
    """``Class()`` of a user's ``module:Class``, of which the name alone is kept.

    :raises BadInput: the class cannot be imported or made; at a call, it fails or gives no features.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        try:
            own: Any = resolve_name(name)()
        except Exception as error:  # whatever the user's code raises
            raise BadInput(f"encoder {name!r} cannot be imported or made: {_message(error)}") from error
        if not callable(own):
            what = f"what {name.rpartition(':')[2]}() gives"
            raise BadInput(f"encoder {name!r}: {what} cannot be called; it needs __call__(pictures)")
        self._call = own.__call__  # its weights are none of this module's
        module = sys.modules.get(name.partition(":")[0])
        self.code = Path(module.__file__).read_bytes() if module is not None and module.__file__ else b""

    def encode(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture, floats [N, F]."""
        try:
            values, count = np.asarray(self._call(pictures)), len(pictures)
        except Exception as error:
            raise BadInput(f"encoder {self.name!r} fails on pictures {[*pictures.shape]}: {_message(error)}") from error
        if values.dtype.kind != "f":
            raise BadInput(f"encoder {self.name!r} gives {values.dtype}; it has to give floats")
        if values.ndim != 2 or len(values) != count or not values.shape[1]:
            had = f"shape {values.shape} for {count} pictures; it has to be ({count}, features)"
            raise BadInput(f"encoder {self.name!r} gives {had}")
        if not np.isfinite(values.astype(np.float32)).all():
            raise BadInput(f"encoder {self.name!r} gives features that are NaN or infinite in float32")
        return values

    def try_out(self, pictures: np.ndarray) -> None:
        """Compare the features of pictures with those of a second call, and with those of a picture alone.

        :raises BadInput: they differ, or the encoder fails.
        """
        first, again, alone = self.encode(pictures), self.encode(pictures), self.encode(pictures[:1])
        for values, other, when in (
            (first, again, "when it is called again; switch off dropout and noise"),
            (first[:1], alone, "of a picture among others than alone; switch to evaluation mode"),
        ):
            same = values.shape == other.shape and np.abs(values - other).max() <= TOLERANCE * np.abs(first).max()
            if not same:
                raise BadInput(f"encoder {self.name!r} gives other features {when}")


def _message(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


ABOUT, TENSORS = "encoder.json", "encoder.safetensors"
AGAIN = "write it again with ddco-pyro encode"


class About(Model):
    """The facts of an encoder, beside its weights.

    :param encoder: ``random_conv``, ``autoencoder``, ``module:Class``, or the folder of a fit.
    :param reader: the network that was taken out of a fit.
    :param observation: the key of the pictures [H, W, C] it was made for.
    :param features: their number before they are reduced to ``size``.
    :param explained: the share of their variance in the training demonstrations that is kept.
    """

    version: Literal[1] = 1
    encoder: str
    reader: Reader | None = None
    observation: str
    picture: Items[Count]
    features: Count
    size: Count
    seed: Seed
    explained: float = 1.0


def is_users(name: str, allow_code: bool) -> bool:
    """Whether an encoder is a user's class, and neither built in nor the folder of a fit.

    :raises BadInput: there is no such encoder, or it is user code and that is not allowed.
    """
    if name in BUILT_IN or Path(name).is_dir():
        return False
    if ":" not in name:
        known = f"{', '.join(BUILT_IN)}, the folder of a fit, or your own module:Class"
        raise BadInput(f"there is no encoder {name!r}{nearest(name, BUILT_IN)}; take {known}")
    if not allow_code:
        raise BadInput(
            f"encoder {name!r} would import user code; pass --allow-code if you trust it (in Python: allow_code=True)"
        )
    return True


def extractor(name: str, pictures: Pictures, seed: int, allow_code: bool) -> PictureNetwork:
    """What gives the features of these pictures before they are reduced; a user's is tried on the first of them.

    :raises BadInput: it cannot be had, or not for these pictures.
    """
    if is_users(name, allow_code):
        users = UserEncoder(name)
        users.try_out(next(pictures.of(pictures.training[0])))
        return users
    if name in BUILT_IN:
        return Convolutions(name, pictures.shape, seed)
    return from_folder(name, pictures.key, pictures.shape, allow_code)


@dataclass(frozen=True)
class Projection:
    """The projection onto principal components: (x − ``mean`` [F]) · ``components`` [N, F]ᵀ.

    :param explained: the share of the features' variance that is kept.
    """

    mean: np.ndarray
    components: np.ndarray
    explained: float

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """[..., F] to float32 [..., N]."""
        return ((features - self.mean) @ self.components.T).astype(np.float32)


NOISE = 1e-4
"""Share of the first component's variance below which a component is noise: a hundredth of its spread. All components
have the unit of the features; standardised one by one, noise would count as much as what moves."""


def principal_components(blocks: Iterable[np.ndarray], size: int, least: float = 0.0) -> Projection:
    """The ``size`` principal components of rows, from one pass over blocks [M, F] of at least ``size`` rows in all.

    They are exactly those of all rows at once. Memory holds an F × F matrix. The entry of each component that is
    largest in magnitude is positive.

    :param least: components with a smaller share of the first one's variance are left out.
    :raises DemonstrationsError: that matrix takes more memory than is allowed.
    """
    number, total, products, origin = 0, np.zeros(0), np.zeros((0, 0)), np.zeros(0)
    for block in blocks:
        if not number:
            features = block.shape[1]
            remedy = "take an encoder that gives fewer"
            refuse_too_much(4 * 8 * features**2, f"reducing {features} features to {size}", remedy)
            origin = block[0].astype(np.float64)  # near the mean, so that subtracting that loses little
            total, products = np.zeros(features), np.zeros((features, features))
        rows = block - origin
        number += len(rows)
        total += rows.sum(0)
        products += rows.T @ rows
    offset = total / number
    values, vectors = np.linalg.eigh(products - number * np.outer(offset, offset))
    variance = values.clip(0)
    size = min(size, max(1, int((variance >= least * variance[-1]).sum())))
    kept = vectors[:, ::-1][:, :size].T
    largest = np.take_along_axis(kept, np.abs(kept).argmax(1)[:, None], 1)
    explained = float(variance[::-1][:size].sum() / variance.sum()) if variance.any() else 1.0
    return Projection(origin + offset, kept * np.where(largest < 0, -1.0, 1.0), explained)


@dataclass(frozen=True)
class Encoder:
    """A picture to a vector: call it with uint8 [H, W, C], and it gives float32 [size]."""

    about: About
    extractor: PictureNetwork
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
        return self.reduced(self.extractor.encode(picture[None]))[0]

    def reduced(self, features: np.ndarray) -> np.ndarray:
        """The extractor's features [..., F] as float32 [..., size]."""
        return features.astype(np.float32) if self.projection is None else self.projection(features)

    def write(self, folder: Path) -> None:
        """Write the encoder as a folder, whole or not at all; of a user's class the name alone."""
        with whole_folder(folder) as temporary:
            (temporary / ABOUT).write_text(self.about.model_dump_json(indent=1) + "\n", encoding="utf-8")
            write_tensors(temporary / TENSORS, self._tensors(), {})

    @property
    def digest(self) -> str:
        """SHA-256 of everything that decides the features."""
        sha256 = hashlib.sha256(self.about.model_dump_json().encode() + self.extractor.code)
        for name, tensor in sorted(self._tensors().items()):
            sha256.update(name.encode() + tensor.contiguous().numpy().tobytes())
        return sha256.hexdigest()

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {f"network/{key}": value for key, value in self.extractor.state_dict().items()}
        if self.projection is not None:
            tensors["mean"] = torch.from_numpy(self.projection.mean)
            tensors["components"] = torch.from_numpy(self.projection.components)
        return tensors


def about_of(folder: Path) -> About:
    """The facts of the encoder in a folder.

    :raises BadInput: there is none, or it is damaged.
    """
    if not (folder / ABOUT).is_file():
        raise BadInput(f"{folder}: is no encoder, it has no {ABOUT}; name the folder FILE.encoder beside a file")
    try:
        return About.model_validate_json((folder / ABOUT).read_bytes())
    except ValidationError as error:
        raise Damaged(folder / ABOUT, " ".join(str(error).split()), AGAIN) from error


def load(folder: str | Path, allow_code: bool = False) -> Encoder:
    """An encoder that ``ddco-pyro encode`` has written beside its file, ``FILE.encoder``.

    :param allow_code: import the user's encoder that it names.
    :raises BadInput: there is none, it is damaged, or it names user code and that is not allowed.
    """
    folder = Path(folder)
    about = about_of(folder)
    if about.reader is not None:
        found: PictureNetwork = FittedReader(about.reader, about.picture)
    elif about.encoder in BUILT_IN:
        found = Convolutions(about.encoder, about.picture, about.seed)
    else:
        is_users(about.encoder, allow_code)
        found = UserEncoder(about.encoder)
    tensors, _ = read_tensors(folder / TENSORS, AGAIN)
    projection = None
    if "components" in tensors:
        projection = Projection(tensors["mean"].numpy(), tensors["components"].numpy(), about.explained)
    weights = {key.removeprefix("network/"): value for key, value in tensors.items() if key.startswith("network/")}
    try:
        found.load_state_dict(weights)
    except RuntimeError as error:
        raise Damaged(folder / TENSORS, " ".join(str(error).split()), AGAIN) from error
    return Encoder(about, found, projection)
