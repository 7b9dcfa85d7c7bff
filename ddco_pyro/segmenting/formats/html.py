"""A page with the timeline of every demonstration."""

from __future__ import annotations

from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.agreement import level_agreements
from ddco_pyro.segmenting.formats import Writer
from ddco_pyro.segmenting.page import write_page


class Page(Writer):
    """The page of :mod:`ddco_pyro.segmenting.page`."""

    def write(self, segmented: Segmented) -> str:
        write_page(self.out, segmented, str(self.asked.run), str(self.asked.demos), level_agreements(segmented))
        return str(self.out)
