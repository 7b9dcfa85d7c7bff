"""A file of demonstrations with features in place of pictures; an interrupted encoding can be resumed.

While ``out.hdf5`` is made, its parts (:class:`~ddco_pyro.data.sources.robomimic.Parts`) hold the features of every
demonstration before they are reduced. Each picture goes through the encoder once. The principal components are
computed from those features, and the file is written at the end.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError, opened
from ddco_pyro.data.pictures import MOVED, shifted
from ddco_pyro.data.sources import Column, Recording, refuse_foreign
from ddco_pyro.data.sources.robomimic import (
    Parts,
    Robomimic,
    discard,
    open_robomimic,
    parts_of,
    robomimic_file,
    write_recording,
)
from ddco_pyro.encoding.autoencoder import UPDATES, Convolutions, train
from ddco_pyro.encoding.encoder import (
    NOISE,
    About,
    Encoder,
    about_of,
    extractor,
    is_users,
    principal_components,
)
from ddco_pyro.encoding.fitted import FittedReader
from ddco_pyro.encoding.pictures import Pictures, batches
from ddco_pyro.errors import BadInput
from ddco_pyro.events import DemonstrationsDone, OnEvent, ignore
from ddco_pyro.training.devices import one_thread

MADE = "encoded"
"""Attribute of a file: the digest of everything that decides its contents."""

SIZE = 64
"""Default number of principal components."""

ROWS = 1024
"""Rows of features that are projected at once."""

Blocks = Callable[[str, str], Iterator[np.ndarray]]
"""The blocks of a demonstration under a key of :attr:`Encoding.keys`."""


@dataclass(frozen=True)
class Encoding:
    """Which pictures become a vector, and how.

    :param observation: the key of the pictures, uint8 [T, H, W, C].
    :param encoder: ``random_conv``, ``autoencoder``, a user's ``module:Class``, or the folder of a fit.
    :param size: number of principal components. By default at most :data:`SIZE`, without those that are noise
        (:data:`~ddco_pyro.encoding.encoder.NOISE`); fewer features, and those of a fit, are not projected.
    :param name: the new observation's key; ``<observation>_features`` by default.
    :param updates: gradient steps of the autoencoder.
    :param moved: number of further versions of each demonstration, whose pictures are all shifted alike. They become
        ``<name>_moved`` [T, moved, size], which a spec can name in ``augment.versions``.
    :param shift: most pixels of a shift along either axis; the edge is repeated.
    :raises BadInput: only one of ``moved`` and ``shift`` is given, or one is negative.
    """

    observation: str
    encoder: str = "random_conv"
    size: int | None = None
    seed: int = 0
    name: str | None = None
    updates: int = UPDATES
    moved: int = 0
    shift: int = 0

    def __post_init__(self) -> None:
        if min(self.moved, self.shift) < 0 or (self.moved > 0) != (self.shift > 0):
            raise BadInput(
                f"--moved {self.moved} --shift {self.shift}: pictures are moved so many times, by so many pixels at "
                "most; give both, 1 at least, or neither"
            )

    @property
    def key(self) -> str:
        """The new observation's key."""
        return self.name or f"{self.observation}_features"

    @property
    def keys(self) -> dict[str, tuple[int, ...]]:
        """The shapes between steps and features, by the new observations' keys."""
        return {self.key: ()} | ({f"{self.key}{MOVED}": (self.moved,)} if self.moved else {})


@dataclass(frozen=True)
class Encoded:
    """A written file, the folder of its encoder, the encoder's facts, and the number of demonstrations."""

    path: Path
    folder: Path
    about: About
    demonstrations: int


def encoder_folder(out: Path) -> Path:
    """The folder of the encoder that belongs to a file of features."""
    return out.with_name(f"{out.name}.encoder")


def encode(
    path: str | Path, out: str | Path, encoding: Encoding, on_event: OnEvent = ignore, allow_code: bool = False
) -> Encoded:
    """Write the demonstrations of ``path`` with features in place of the pictures to ``out``, and ``out.encoder``.

    Principal components and autoencoder are fitted to the training demonstrations: ``mask/train``, else all that are
    not in ``mask/valid``. Memory holds one block of pictures, and a buffer of pictures while an autoencoder is trained.

    :raises DemonstrationsError: the demonstrations cannot be used, or the observation is missing or no picture.
    :raises BadInput: ``out`` is there already and is something else; the encoder cannot be used, or gives fewer
        features than ``size``.
    """
    path, out = Path(path), Path(out)
    users = is_users(encoding.encoder, allow_code)
    if out.exists() and not out.is_file():
        raise BadInput(f"{out}: is there already and is no file; choose another --out")
    refuse_foreign(path)
    with open_robomimic(path) as source, nullcontext() if users else one_thread():  # same bits
        return _Job(source, path, out, encoding, on_event, allow_code).run()


class _Job:
    """The encoding of one file; the encoder is written to ``beside``. Its ``identity`` decides the file's contents."""

    def __init__(
        self, source: Robomimic, path: Path, out: Path, encoding: Encoding, on_event: OnEvent, allow_code: bool
    ) -> None:
        self.source, self.out, self.encoding, self.on_event = source, out, encoding, on_event
        self.beside = encoder_folder(out)
        self.pictures = Pictures(source, encoding.observation)
        for key in encoding.keys.keys() & source.recording(source.names[0]).observations.keys():
            raise DemonstrationsError(f"obs/{key} is there already; choose another name with --as")
        if encoding.shift >= min(self.pictures.shape[:2]):
            height, width, _ = self.pictures.shape
            raise BadInput(f"--shift {encoding.shift}: would move pictures of {height} × {width} pixels out of sight")
        self.extractor = extractor(encoding.encoder, self.pictures, encoding.seed, allow_code)
        self.about = self._about()
        stat, code = path.stat(), hashlib.sha256(self.extractor.code).hexdigest()
        file = {"file": [str(path.resolve()), stat.st_size, stat.st_mtime_ns], "code": code}
        self.identity = json.dumps(file | asdict(encoding))
        self.digest = hashlib.sha256(self.identity.encode()).hexdigest()

    def _about(self) -> About:
        """The facts of the encoder, before it is known how many components are noise.

        :raises BadInput: there are fewer features, or training pictures, than the size that is asked for.
        """
        own, pictures, source = self.encoding, self.pictures, self.extractor
        number = source.encode(next(pictures.of(pictures.training[0]))).shape[1]
        reader = source.about if isinstance(source, FittedReader) else None
        size = own.size or (number if reader else min(number, SIZE, pictures.number))
        if size > number:
            raise BadInput(f"--size {size}: encoder {own.encoder!r} gives {number} features; take at most as many")
        if size > pictures.number:
            raise BadInput(f"--size {size}: there are {pictures.number} training pictures; take at most as many")
        return About(
            encoder=own.encoder, reader=reader, observation=own.observation, picture=pictures.shape,
            features=number, size=size, seed=own.seed,
        )  # fmt: skip

    def run(self) -> Encoded:
        """Encode every demonstration, reduce the features, and write both results, unless they are there."""
        if self.out.exists():
            discard(self.out)
        else:
            with parts_of(self.out, self.identity, at_most=1) as parts:
                if parts is not None:
                    self._make(parts)
        with opened(self.out) as file:
            if file.attrs.get(MADE) != self.digest:
                raise BadInput(f"{self.out}: is there already and is not this encoding; choose another --out")
        return Encoded(self.out, self.beside, about_of(self.beside), len(self.source.names))

    def _make(self, parts: Parts) -> None:
        """Encode what is not encoded yet, and write the encoder and the file."""
        if self.beside.exists() and not parts.done:
            raise BadInput(f"{self.beside}: is there already; remove it, or choose another --out")
        if isinstance(self.extractor, Convolutions) and self.encoding.encoder == "autoencoder":
            train(self.extractor, self.pictures, self.encoding.seed, self.encoding.updates, self.on_event)
        for name in self.source.names[len(parts.done) :]:
            whole = self.source.recording(name)
            parts.add(Recording(name, self._columns(whole, self.about.features, self._features), whole.actions))
            self.on_event(DemonstrationsDone(len(parts.done), len(self.source.names)))

        def stored(name: str, key: str) -> Iterator[np.ndarray]:
            with parts.column(name, f"obs/{key}") as column:
                yield from batches(column, max(1, ROWS // math.prod(column.shape[1:-1])))

        encoder = self._reducing(stored)
        encoder.write(self.beside)
        attributes = {**self.source.attributes, MADE: self.digest}
        with one_thread(), robomimic_file(self.out, attributes, self.source.masks) as data:
            for name in self.source.names:
                whole = self.source.recording(name)
                others = {key: column for key, column in whole.observations.items() if key != self.pictures.key}
                reduced = self._columns(whole, encoder.about.size, lambda *at: map(encoder.reduced, stored(*at)))
                write_recording(data, replace(whole, observations=others | reduced))

    def _columns(self, whole: Recording, features: int, of: Blocks) -> dict[str, Column]:
        """Features [T, F] of a demonstration, and [T, moved, F] of shifted pictures, by key."""
        return {
            key: Column((whole.actions.shape[0], *moved, features), np.dtype(np.float32), partial(of, whole.name, key))
            for key, moved in self.encoding.keys.items()
        }

    def _features(self, name: str, key: str) -> Iterator[np.ndarray]:
        """Features of a demonstration's pictures, blocks [M, F], or of pictures shifted at random, [M, moved, F]."""
        most, moved = self.encoding.shift, self.encoding.keys[key]
        random = np.random.default_rng((self.encoding.seed, self.source.names.index(name)))
        moves = random.integers(-most, most + 1, (*moved, 2)).tolist() if moved else []
        for block in self.pictures.of(name):
            each = [shifted(block, *by) for by in moves] or [block]
            values = [self.extractor.encode(one).astype(np.float32) for one in each]
            if numbers := {own.shape[1] for own in values} - {self.about.features}:
                raise BadInput(
                    f"encoder {self.about.encoder!r} gives {numbers.pop()} features in {name}, and "
                    f"{self.about.features} in {self.pictures.training[0]}; it has to give as many of every picture"
                )
            yield np.stack(values, axis=1) if moves else values[0]

    def _reducing(self, stored: Blocks) -> Encoder:
        """The encoder, with the projection of the training demonstrations' features where one is wanted."""
        size, about = self.encoding.size, self.about
        if size is None and about.size == about.features:
            return Encoder(about, self.extractor, None)
        with one_thread():
            rows = (block for name in self.pictures.training for block in stored(name, self.encoding.key))
            projection = principal_components(rows, about.size, NOISE if size is None else 0.0)
        facts = {"explained": projection.explained, "size": len(projection.components)}
        return Encoder(about.model_copy(update=facts), self.extractor, projection)
