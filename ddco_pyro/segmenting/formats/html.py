"""A page with the time line of every demonstration."""

from __future__ import annotations

from ddco_pyro.drawing.shown import stored_pictures
from ddco_pyro.segmenting import Segmented, recorded
from ddco_pyro.segmenting.agreement import level_agreements
from ddco_pyro.segmenting.formats import Writer
from ddco_pyro.segmenting.page import followed, write_page


class Page(Writer):
    """The page of :mod:`ddco_pyro.segmenting.page`."""

    def write(self, segmented: Segmented) -> str:
        asked = self.asked
        pictures = stored_pictures(asked.source, {demo.name: len(demo) for demo in segmented.segments})
        follows = followed(recorded(segmented, asked.fit, asked.source), pictures, segmented, asked.fit)
        write_page(self.out, segmented, str(asked.run), str(asked.demos), level_agreements(segmented), follows)
        return str(self.out)
