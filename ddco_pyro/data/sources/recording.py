"""Recordings: one episode each, with arrays that are read in blocks and not yet checked."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike
from pydantic import TypeAdapter, ValidationError

from ddco_pyro.data.hdf5 import DAMAGE, Attribute, DemonstrationsError, opened
from ddco_pyro.data.memory import refuse_too_much
from ddco_pyro.data.pictures import (
    PICTURE_DIMENSIONS,
    Observed,
    Pictures,
    block_steps,
    blocks,
    channels_last,
    turned,
)

LABEL_NAMES = "label_names"
"""Attribute of a file of demonstrations: JSON, the names of labels 0, 1, ... for each name of labels."""

NUMBERS = "fiub"
"""Kinds of numpy types that are real numbers."""

UNKNOWN = -1
"""The label of a step without ground truth."""

BOUNDARY = "_boundary"
"""End of the name of labels that are 1 where a segment begins, beside the labels of a level."""


@dataclass(frozen=True)
class Column:
    """An array [T, ...] of a recording, read in blocks of consecutive steps.

    :param blocks: starts a new pass over the array at each call; the blocks have T steps in all.
    :param video: whether reading decodes a video.
    :param kept: the array as lazy pictures in an HDF5 file; None for other arrays.
    :param named: the name of the array in its source; empty where that is its place in a :class:`Recording`.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    blocks: Callable[[], Iterator[np.ndarray]]
    video: bool = False
    kept: Pictures | None = None
    named: str = ""

    @property
    def image(self) -> bool:
        """Whether a step is a picture, uint8 [H, W, C]."""
        return is_image(self.shape, self.dtype)

    def observed(self) -> Observed:
        """The array, lazy if possible."""
        return self.array() if self.kept is None else self.kept

    def array(self) -> np.ndarray:
        """The array, in memory.

        :raises DemonstrationsError: it cannot be read, or takes more memory than is allowed.
        """
        refuse_too_much(self.dtype.itemsize * math.prod(self.shape), self.named or "an array", "divide the episode")
        whole, at = np.zeros(self.shape, self.dtype), 0
        for block in self.blocks():
            whole[at : at + len(block)] = block
            at += len(block)
        return whole


@dataclass(frozen=True)
class Recording:
    """One episode of T steps, under the names of the HDF5 layout.

    :param observations: key to [T, ...].
    :param actions: [T, A]; integers [T] become [T, 1].
    :param labels: name to [T]; [T, 1] becomes [T].
    :param attributes: facts about the episode.
    """

    name: str
    observations: Mapping[str, Column]
    actions: Column
    labels: Mapping[str, Column] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        whole = self.actions.dtype.kind in "iu"
        object.__setattr__(self, "actions", as_vectors(self.actions) if whole else self.actions)
        object.__setattr__(self, "labels", {name: _flat(column) for name, column in self.labels.items()})

    @classmethod
    def of(
        cls,
        name: str,
        observations: Mapping[str, Any],
        actions: Any,
        labels: Mapping[str, Any] = MappingProxyType({}),
        attributes: Mapping[str, Attribute] = MappingProxyType({}),
    ) -> Recording:
        """A recording of arrays in memory, of lazy pictures, or of columns.

        :raises DemonstrationsError: one is no array.
        """

        def column(place: str, values: Any) -> Column:
            try:
                return of_array(values)
            except (ValueError, TypeError, RuntimeError) as error:
                raise DemonstrationsError(f"{name}: {place} is no array: {' '.join(str(error).split())}") from None

        seen, known = (
            {key: column(f"{folder}/{key}", values) for key, values in arrays.items()}
            for folder, arrays in (("obs", observations), ("labels", labels))
        )
        return cls(name, seen, column("actions", actions), known, attributes)

    def loaded(self) -> Recording:
        """The recording with its arrays in memory; pictures in files stay lazy."""

        def held(columns: Mapping[str, Column]) -> dict[str, Column]:
            return {key: of_array(column.observed()) for key, column in columns.items()}

        actions, observations = of_array(self.actions.observed()), held(self.observations)
        return replace(self, observations=observations, actions=actions, labels=held(self.labels))

    @property
    def numbers(self) -> dict[str, Column]:
        """The observations that hold real numbers."""
        return {key: column for key, column in self.observations.items() if column.dtype.kind in NUMBERS}

    def columns(self) -> Iterator[tuple[str, Column]]:
        """Every array with its place: ``actions``, ``obs/<key>``, ``labels/<name>``."""
        yield "actions", self.actions
        yield from ((f"obs/{key}", column) for key, column in self.observations.items())
        yield from ((f"labels/{key}", column) for key, column in self.labels.items())


def label_names(attributes: Mapping[str, Attribute]) -> dict[str, list[str]]:
    """The names of labels 0, 1, ... in the attributes of a file (:data:`LABEL_NAMES`), by name of labels.

    :raises DemonstrationsError: the attribute is something else.
    """
    try:
        return TypeAdapter(dict[str, list[str]]).validate_json(str(attributes.get(LABEL_NAMES, "{}")))
    except ValidationError:
        raise DemonstrationsError(
            f'attribute {LABEL_NAMES!r}: is no JSON such as {{"phase": ["reach", "grasp"]}}; correct or remove it'
        ) from None


def is_image(shape: tuple[int, ...], dtype: np.dtype) -> bool:
    """Whether a step of an array [T, ...] is a picture, uint8 [H, W, C]."""
    return dtype == np.uint8 and len(shape) == 1 + PICTURE_DIMENSIONS


def of_array(values: ArrayLike | Pictures | Column) -> Column:
    """A column of an array in memory or of lazy pictures; pictures have their channels last."""
    if isinstance(values, Column):
        return values
    if isinstance(values, Pictures):
        return Column(values.shape, values.dtype, lambda: blocks(values), kept=values)
    array = turned(np.asarray(values))
    return Column(array.shape, array.dtype, lambda: iter([array]))


def joined(parts: Mapping[str, np.ndarray], where: str) -> np.ndarray:
    """Arrays [T, ...] by name as one array [T, D], in this order.

    :param where: the demonstration, for messages.
    :raises DemonstrationsError: there is no array, one holds no numbers, or has another number of steps than the first.
    """
    first, steps = next(((name, len(array)) for name, array in parts.items()), ("", 0))
    if not parts:
        raise DemonstrationsError(f"{where}: has no actions")
    for name, array in parts.items():
        if array.dtype.kind not in "fiub":
            raise DemonstrationsError(
                f"{where}: {name} holds {array.dtype}, not numbers; name the control with --action"
            )
        if len(array) != steps:
            raise DemonstrationsError(f"{where}: {name} has {len(array)} steps, but {first} has {steps}")
    return np.concatenate([array.reshape(steps, math.prod(array.shape[1:])) for array in parts.values()], axis=1)


def as_vectors(column: Column) -> Column:
    """An array [T] as [T, 1]; any other unchanged."""
    if len(column.shape) != 1:
        return column
    return replace(column, shape=(*column.shape, 1), blocks=lambda: (block[:, None] for block in column.blocks()))


def _flat(labels: Column) -> Column:
    if labels.shape[1:] != (1,):
        return labels
    return replace(labels, shape=labels.shape[:1], blocks=lambda: (block[:, 0] for block in labels.blocks()))


def of_dataset(dataset: h5py.Dataset, where: str, part: slice = slice(None)) -> Column:
    """A column of consecutive steps of a dataset; pictures have their channels last.

    Each pass opens the file unless it is open: a folder can have more files than may be open. Reading the column raises
    :class:`DemonstrationsError` if the file is damaged.
    """
    start, stop, _ = part.indices(len(dataset))
    at_once = block_steps(dataset.shape[1:], dataset.dtype)
    shape = channels_last((max(stop - start, 0), *dataset.shape[1:]), dataset.dtype)
    path, place = os.path.abspath(dataset.file.filename), dataset.name  # absolute for readers in another folder
    lazy = is_image(shape, dataset.dtype) and shape[0] == len(dataset)
    kept = Pictures(path, place, where, dataset.shape) if lazy else None

    def read() -> Iterator[np.ndarray]:
        with nullcontext(dataset.file) if dataset else opened(path) as file:
            for at in range(start, stop, at_once):
                try:
                    block = np.asarray(file[place][at : min(at + at_once, stop)])
                except DAMAGE as error:
                    raise DemonstrationsError(f"{where} cannot be read ({error}); the file may be damaged") from error
                yield turned(block)

    return Column(shape, dataset.dtype, read, kept=kept)


def damaged(path: Path, where: str, error: BaseException) -> DemonstrationsError:
    """A library's error about an unreadable file, as one line; a :class:`DemonstrationsError` is unchanged.

    :param where: the part of the file; may be empty.
    """
    if isinstance(error, DemonstrationsError):
        return error
    text = " ".join(str(error).split()) or type(error).__name__
    return DemonstrationsError(f"{path}: {where + ': ' if where else ''}cannot be read, or is damaged: {text}")
