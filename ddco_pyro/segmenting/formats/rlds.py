"""Steps as RLDS names them, with a text for each step, in numpy archives that need no TensorFlow."""

from __future__ import annotations

import numpy as np

from ddco_pyro.data.files import whole_folder
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.formats import Writer


class RLDS(Writer):
    """A folder with ``<demonstration>.npz``, which ``numpy.load`` opens without pickle.

    Keys are fields of RLDS' steps, with ``observation/<key>`` [T, ...] for nested ones: ``action`` [T, A],
    ``is_first``, ``is_last``, ``is_terminal``, ``discount``, ``reward`` (1 at the last step, as for demonstrations that
    succeed), and ``subtask`` [T], a text. A TFDS builder yields them step by step.
    """

    def write(self, segmented: Segmented) -> str:
        with whole_folder(self.out) as folder:
            for demo in segmented.segments:
                recording = self.asked.source.recording(demo.name)
                last = np.arange(len(demo)) == len(demo) - 1
                options = demo.levels[self.asked.level].options
                steps = {
                    **{f"observation/{key}": column.array() for key, column in recording.numbers.items()},
                    "action": recording.actions.array(),
                    "is_first": np.arange(len(demo)) == 0,
                    "is_last": last,
                    "is_terminal": last,
                    "discount": np.ones(len(demo), np.float32),
                    "reward": last.astype(np.float32),
                    "subtask": np.array(self.asked.names)[options],
                }
                np.savez_compressed(folder / f"{demo.name}.npz", **steps)
        return f"{self.out}: {len(segmented)} episodes{self.asked.without}"
