"""Annotations of ELAN: a file for each demonstration with a tier for each level."""

from __future__ import annotations

from datetime import UTC, datetime
from xml.etree import ElementTree

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.formats import Writer

SCHEMA = "http://www.mpi.nl/tools/elan/EAFv3.0.xsd"
UNDETERMINED = "und"
"""ELAN's name of no language in particular."""
STEP = 1000.0
"""Milliseconds of a step where the steps per second are not known."""


class ELAN(Writer):
    """A folder with ``<demonstration>.eaf``; times are milliseconds.

    The highest level comes first. An annotation lasts from the first step of a segment to the first step of the next.
    A controlled vocabulary has the names of all choices of a level.
    """

    def write(self, segmented: Segmented) -> str:
        milliseconds = 1000 / segmented.frequency if segmented.frequency else STEP
        with whole_folder(self.out) as folder:
            for demo in segmented.segments:
                write_text(folder / f"{demo.name}.eaf", self._document(demo, milliseconds))
        unit = "" if segmented.frequency else "; a step is one second, since the demonstrations have no frequency"
        return f"{self.out}: {len(segmented)} files{unit}"

    def _document(self, demo: Segments, milliseconds: float) -> str:
        when = datetime.now(UTC).isoformat(timespec="seconds")
        root = ElementTree.Element(
            "ANNOTATION_DOCUMENT",
            {"AUTHOR": "ddco-pyro", "DATE": when, "FORMAT": "3.0", "VERSION": "3.0",
             "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance", "xsi:noNamespaceSchemaLocation": SCHEMA},
        )  # fmt: skip
        ElementTree.SubElement(root, "HEADER", MEDIA_FILE="", TIME_UNITS="milliseconds")
        times = ElementTree.SubElement(root, "TIME_ORDER")
        levels = dict(reversed(demo.levels.items()))
        edges = {0, len(demo)}.union(*(run[1:] for level in levels.values() for run in level.runs(anew=False)))
        for step in sorted(edges):
            value = str(round(step * milliseconds))
            ElementTree.SubElement(times, "TIME_SLOT", TIME_SLOT_ID=f"ts{step}", TIME_VALUE=value)
        number = 0
        for name, level in levels.items():
            tier = ElementTree.SubElement(root, "TIER", TIER_ID=name, LINGUISTIC_TYPE_REF=name)
            for option, start, stop in level.runs(anew=False):
                number += 1
                annotation = ElementTree.SubElement(ElementTree.SubElement(tier, "ANNOTATION"), "ALIGNABLE_ANNOTATION")
                annotation.attrib |= {
                    "ANNOTATION_ID": f"a{number}", "TIME_SLOT_REF1": f"ts{start}", "TIME_SLOT_REF2": f"ts{stop}"
                }  # fmt: skip
                text = ElementTree.SubElement(annotation, "ANNOTATION_VALUE")
                text.text = self._names(name)[option]
        for name in levels:
            kind = {"LINGUISTIC_TYPE_ID": name, "TIME_ALIGNABLE": "true", "CONTROLLED_VOCABULARY_REF": name}
            ElementTree.SubElement(root, "LINGUISTIC_TYPE", kind)
        ElementTree.SubElement(root, "LANGUAGE", LANG_ID=UNDETERMINED)
        for name in levels:
            vocabulary = ElementTree.SubElement(root, "CONTROLLED_VOCABULARY", CV_ID=name)
            ElementTree.SubElement(vocabulary, "DESCRIPTION", LANG_REF=UNDETERMINED)
            for option, word in enumerate(self._names(name)):
                entry = ElementTree.SubElement(vocabulary, "CV_ENTRY_ML", CVE_ID=f"{name}_{option}")
                ElementTree.SubElement(entry, "CVE_VALUE", LANG_REF=UNDETERMINED).text = word
        ElementTree.indent(root)
        return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"

    def _names(self, level: str) -> list[str]:
        names = self.asked.fit.names[level]
        return [name_in_level(option, level, names) for option in range(len(names))]
