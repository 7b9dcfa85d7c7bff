"""Features of the pictures of demonstrations, computed once, which the recogniser of a labels page reads."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddco_pyro.data.arrays import Observed, is_picture
from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.files import whole_file
from ddco_pyro.data.sources import open_source
from ddco_pyro.data.tasks import Where
from ddco_pyro.encoding import NOISE, Backbone, principal_components
from ddco_pyro.errors import BadInput
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.labelling.document import digest

SIZE = 32
"""Most principal components that the recogniser reads."""

LEARNED = 20_000
"""Most steps that principal components are learned from; one of a demonstration at least."""

TRIED = 4
"""Pictures of each camera that the backbone is tried with."""


@dataclass(frozen=True)
class Features:
    """What a frozen backbone says of each step's pictures, those of all cameras together.

    :param path: the demonstrations.
    :param folder: has a file for each demonstration: its features [T, F] less their mean over it.
    """

    path: Path
    backbone: str
    allow_code: bool
    where: Where
    folder: Path

    @classmethod
    def of(cls, path: Path, out: Path, backbone: str, allow_code: bool, where: Where) -> Features:
        """The features of a file beside its labels, in a folder of its demonstrations, pictures, backbone.

        :param out: the labels.
        :param backbone: as :class:`~ddco_pyro.encoding.Backbone` takes it.
        :raises BadInput: there are no pictures, or the backbone cannot be had or fails on the first ones.
        """
        network = Backbone(backbone, allow_code)
        with open_source(path, where=where) as source:
            demos = [source.read(name) for name in source.names]
            few = [pictures[:TRIED] for pictures in _cameras(demos[0])]
        if not few:
            wanted = "uint8 [steps, height, width, channels]"
            raise BadInput(f"--features: {path} has no pictures, {wanted}; leave it out")
        known = f"{digest(demos, backbone)} {[pictures.shape for pictures in few]}"
        key = hashlib.sha256(known.encode() + network.code)
        for pictures in few:
            network.try_out(pictures)
            key.update(pictures.tobytes())
        folder = out.with_name(f"{path.stem}.features") / key.hexdigest()[:16]
        return cls(path, backbone, allow_code, where, folder)

    def computed(self, on_event: OnEvent = ignore) -> dict[str, np.ndarray]:
        """Principal components of what changes within demonstrations, float32 [T, N] of each.

        Light and ground are of no skill, so features are taken less their mean over the demonstration. All
        components have one unit, in which their mean variance is 1: standardised one by one, noise would
        count as much as what moves. A demonstration whose file is there is not computed again.
        """
        os.nice(19)  # edits and refits come first
        network, each = Backbone(self.backbone, self.allow_code), dict[str, np.ndarray]()
        with open_source(self.path, where=self.where) as source:
            for place, name in enumerate(source.names):
                file = self.folder / f"{place}.npy"
                try:
                    each[name] = np.load(file, mmap_mode="r")
                except (OSError, ValueError, EOFError):  # it is missing or damaged
                    cameras = _cameras(source.read(name))
                    rows = np.concatenate([network.features(own) for own in cameras], axis=1)
                    with whole_file(file) as temporary, temporary.open("wb") as opened:
                        np.save(opened, rows - rows.mean(0))
                    each[name] = np.load(file, mmap_mode="r")
                on_event(Counted("encoding", len(source.names), done=len(each)))
        stride = math.ceil(sum(map(len, each.values())) / LEARNED)
        some = np.concatenate([rows[::stride] for rows in each.values()])
        project = principal_components([some], SIZE, NOISE)
        unit = project(some).std() or 1.0
        return {name: project(rows) / unit for name, rows in each.items()}


def _cameras(demo: Demonstration) -> Iterable[Observed]:
    return [array for array in demo.observations.values() if is_picture(array)]
