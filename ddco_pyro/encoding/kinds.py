"""The kinds of encoder: how each is made, learns, is kept, and is there again."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from torch import Tensor

from ddco_pyro.encoding.fitted import FittedReader, Reader, from_folder
from ddco_pyro.encoding.networks import Convolutions
from ddco_pyro.encoding.pictures import Pictures
from ddco_pyro.encoding.training import train
from ddco_pyro.encoding.user import imported, try_out
from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.events import OnEvent


class Kind(ABC):
    """An encoder of pictures: call it with uint8 [N, H, W, C], it gives features [N, F]."""

    ours: ClassVar[bool] = True
    """It is of this project's networks, which give the same bits on one thread."""

    reader: Reader | None = None
    """The network that was taken out of a fit."""

    @classmethod
    @abstractmethod
    def made(cls, name: str, pictures: Pictures, seed: int, allow_code: bool) -> Kind:
        """The encoder of this name for these pictures.

        :raises BadInput: it cannot be had, or not for them.
        """

    @abstractmethod
    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture by itself."""

    def learn(self, pictures: Pictures, seed: int, updates: int, checkpoint: Path, on_event: OnEvent) -> None:
        """Learn from the training pictures, from where ``checkpoint`` stands; an encoder that is finished does not."""
        return

    def decides(self) -> bytes:
        """What decides its features, beside its name, the seed and the pictures."""
        return b""

    def weights(self) -> Mapping[str, Tensor]:
        """What is to be kept of it."""
        return {}

    def restore(self, weights: Mapping[str, Tensor]) -> None:
        """Take over what was kept.

        :raises RuntimeError: that is another encoder's.
        """
        return

    def size(self, features: int, most: int) -> int:
        """To how many its features are reduced where nobody says it.

        :param most: that are wanted.
        """
        return min(features, most)


class OfANetwork(Kind):
    """An encoder whose weights are kept beside the file."""

    def __init__(self, network: Convolutions | FittedReader) -> None:
        self.network = network

    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        """See :class:`Kind`."""
        return self.network.encode(pictures)

    def weights(self) -> Mapping[str, Tensor]:
        """See :meth:`Kind.weights`."""
        return self.network.state_dict()

    def restore(self, weights: Mapping[str, Tensor]) -> None:
        """See :meth:`Kind.restore`."""
        self.network.load_state_dict(weights)


class Drawn(OfANetwork):
    """Convolutions with random weights, which stay as they were drawn."""

    network: Convolutions

    @classmethod
    def made(cls, name: str, pictures: Pictures, seed: int, allow_code: bool) -> Kind:
        """See :meth:`Kind.made`."""
        return cls(Convolutions(name, pictures.shape, seed))


class Learnt(Drawn):
    """Convolutions that learn to see what an autoencoder needs."""

    def learn(self, pictures: Pictures, seed: int, updates: int, checkpoint: Path, on_event: OnEvent) -> None:
        """See :meth:`Kind.learn`."""
        train(self.network, pictures, seed, updates, checkpoint, on_event)


class Taken(OfANetwork):
    """The network of a fit that reads these pictures and nothing else.

    :param code: what decides its features: the weights of the fit, as its folder may hold another one the next time.
    """

    def __init__(self, network: FittedReader, code: bytes = b"") -> None:
        super().__init__(network)
        self.reader, self._code = network.about, code

    @classmethod
    def made(cls, name: str, pictures: Pictures, seed: int, allow_code: bool) -> Kind:
        """See :meth:`Kind.made`."""
        network = from_folder(name, pictures.key, pictures.shape, allow_code)
        return cls(network, (Path(name) / "model.safetensors").read_bytes())

    def decides(self) -> bytes:
        """See :meth:`Kind.decides`."""
        return self._code

    def size(self, features: int, most: int) -> int:
        """All of them: they are few, and the fit has learnt to need each."""
        return features


class Own(Kind):
    """A user's ``module:Class``, which is named beside the file, not kept."""

    ours = False

    def __init__(self, name: str) -> None:
        self._name, self._features = name, imported(name)

    @classmethod
    def made(cls, name: str, pictures: Pictures, seed: int, allow_code: bool) -> Kind:
        """See :meth:`Kind.made`; it is tried on the first training pictures."""
        encoder = cls(name)
        try_out(name, encoder, next(pictures.of(pictures.training[0])))
        return encoder

    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        """See :class:`Kind`."""
        return self._features(pictures)

    def decides(self) -> bytes:
        """The source of its module."""
        module = sys.modules.get(self._name.partition(":")[0])
        return Path(module.__file__).read_bytes() if module is not None and module.__file__ else b""


NAMED: Mapping[str, type[Drawn]] = {"random_conv": Drawn, "autoencoder": Learnt}
"""The encoders that are built in."""


def kind_of(name: str, allow_code: bool) -> type[Kind]:
    """Of which kind an encoder of this name is: one that is built in, the folder of a fit, or a user's.

    :raises BadInput: there is none, or it is user code and that is not allowed.
    """
    if name in NAMED:
        return NAMED[name]
    if Path(name).is_dir():
        return Taken
    if ":" not in name:
        known = f"{', '.join(NAMED)}, the folder of a fit, or your own module:Class"
        raise BadInput(f"there is no encoder {name!r}{nearest(name, NAMED)}; take {known}")
    return own(name, allow_code)


def own(name: str, allow_code: bool) -> type[Own]:
    """A user's encoder.

    :raises BadInput: that is not allowed.
    """
    if not allow_code:
        raise BadInput(
            f"encoder {name!r} would import user code; pass --allow-code if you trust it (in Python: allow_code=True)"
        )
    return Own


def again(name: str, reader: Reader | None, picture: Sequence[int], seed: int, allow_code: bool) -> Kind:
    """The encoder that a folder tells of, before its weights are restored.

    :param reader: of one that was taken out of a fit.
    :param picture: [H, W, C].
    :raises BadInput: as :func:`kind_of`.
    """
    if reader is not None:
        return Taken(FittedReader(reader, picture))
    if name in NAMED:
        return NAMED[name](Convolutions(name, picture, seed))
    return own(name, allow_code)(name)
