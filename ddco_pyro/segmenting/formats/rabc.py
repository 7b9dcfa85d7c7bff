"""Progress of each step for RA-BC, LeRobot's weights of training samples."""

from __future__ import annotations

import numpy as np
import pyarrow
from pyarrow import parquet

from ddco_pyro.data.files import whole_file
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.formats import Writer


class RABC(Writer):
    """A row for each frame: ``index`` in the dataset, ``episode_index``, and ``progress_dense`` (:meth:`progress`).

    LeRobot reads the file with ``head_mode: dense``.
    """

    def write(self, segmented: Segmented) -> str:
        order, start = self.order(segmented), 0
        columns: dict[str, list[np.ndarray]] = {"index": [], "episode_index": [], "progress_dense": []}
        numbered = self.asked.source.format == "lerobot"
        for place, demo in enumerate(segmented.segments):
            episode = int(demo.name.removeprefix("demo_")) if numbered else place
            columns["index"].append(np.arange(start, start + len(demo)))
            columns["episode_index"].append(np.full(len(demo), episode))
            columns["progress_dense"].append(self.progress(self.runs(demo), order).astype(np.float32))
            start += len(demo)
        with whole_file(self.out) as temporary:
            parquet.write_table(
                pyarrow.table({name: np.concatenate(parts) for name, parts in columns.items()}), temporary
            )
        return f"{self.out}: order {', '.join(self.asked.names[option] for option in order)}"
