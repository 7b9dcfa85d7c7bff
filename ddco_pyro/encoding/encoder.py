"""An encoder of pictures with its principal components, in memory and as a folder."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor

from ddco_pyro.data.files import Damaged, whole_folder
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.encoding.fitted import Reader
from ddco_pyro.encoding.kinds import Kind, again
from ddco_pyro.encoding.projection import Projection
from ddco_pyro.errors import BadInput
from ddco_pyro.spec.base import Count, Items, Model, Seed

ABOUT, TENSORS = "encoder.json", "encoder.safetensors"
AGAIN = "write it again with ddco-pyro encode"


class About(Model):
    """What an encoder is, beside its weights."""

    version: Literal[1] = 1
    encoder: str
    """``random_conv``, ``autoencoder``, ``module:Class``, or the folder of a fit."""
    reader: Reader | None = None
    """The network that was taken out of a fit."""
    observation: str
    """The key of the pictures it was made for."""
    picture: Items[Count]
    """[H, W, C]."""
    features: Count
    """Features of a picture before they are reduced."""
    size: Count
    """Features that come out."""
    seed: Seed
    explained: float = 1.0
    """Share of the features' variance in the training demonstrations that is kept."""


@dataclass(frozen=True)
class Encoder:
    """A picture to a vector: call it with uint8 [H, W, C], it gives float32 [size]."""

    about: About
    kind: Kind
    projection: Projection | None

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The features that a policy, fitted to them, reads in place of the picture.

        :raises BadInput: it is not such a picture.
        """
        picture = np.asarray(picture)
        if picture.dtype != np.uint8 or picture.shape != self.about.picture:
            raise BadInput(
                f"{self.about.observation}: is {picture.dtype} {picture.shape}; this encoder reads uint8 "
                f"{self.about.picture}"
            )
        return self.reduced(self.kind(picture[None]))[0]

    def reduced(self, features: np.ndarray) -> np.ndarray:
        """Features as the encoder gives them, [..., F], to float32 [..., size]."""
        return features.astype(np.float32) if self.projection is None else self.projection(features)

    def write(self, folder: Path) -> None:
        """Write it as a folder, whole or not at all; a user's encoder is named there, not kept."""
        with whole_folder(folder) as temporary:
            (temporary / ABOUT).write_text(self.about.model_dump_json(indent=1) + "\n", encoding="utf-8")
            write_tensors(temporary / TENSORS, self._tensors(), {})

    @property
    def digest(self) -> str:
        """SHA-256 of what decides its features."""
        sha256 = hashlib.sha256(self.about.model_dump_json().encode() + self.kind.decides())
        for name, tensor in sorted(self._tensors().items()):
            sha256.update(name.encode() + tensor.contiguous().numpy().tobytes())
        return sha256.hexdigest()

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {f"network/{key}": value for key, value in self.kind.weights().items()}
        if self.projection is not None:
            tensors["mean"] = torch.from_numpy(self.projection.mean)
            tensors["components"] = torch.from_numpy(self.projection.components)
        return tensors


def about_of(folder: Path) -> About:
    """What the encoder in a folder is.

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
    kind = again(about.encoder, about.reader, about.picture, about.seed, allow_code)
    tensors, _ = read_tensors(folder / TENSORS, AGAIN)
    projection = None
    if "components" in tensors:
        projection = Projection(tensors["mean"].numpy(), tensors["components"].numpy(), about.explained)
    weights = {key.removeprefix("network/"): value for key, value in tensors.items() if key.startswith("network/")}
    try:
        kind.restore(weights)
    except RuntimeError as error:
        raise Damaged(folder / TENSORS, " ".join(str(error).split()), AGAIN) from error
    return Encoder(about, kind, projection)
