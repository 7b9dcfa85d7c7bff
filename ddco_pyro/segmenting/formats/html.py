"""A page with the time line of every demonstration."""

from __future__ import annotations

from itertools import chain, islice

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.shown import paths_of, stored_pictures
from ddco_pyro.segmenting import Segmented, recorded
from ddco_pyro.segmenting.formats import Writer
from ddco_pyro.segmenting.page import followed, write_page

FIRST = 10
"""Demonstrations among which an observation that moves like a position is sought."""


class Page(Writer):
    """The page of :mod:`ddco_pyro.segmenting.page`."""

    def write(self, segmented: Segmented) -> str:
        asked = self.asked
        pictures = stored_pictures(asked.source, {demo.name: len(demo) for demo in segmented.segments})
        demos = recorded(segmented, asked.fit, asked.source)
        first = list(islice(demos, FIRST))
        paths = paths_of(asked.fit.spec.report.trajectory, Demonstrations(tuple(first)))
        follows = followed(chain(first, demos), pictures, segmented, paths)
        write_page(self.out, segmented, str(asked.run), str(asked.demos), follows)
        return str(self.out)
