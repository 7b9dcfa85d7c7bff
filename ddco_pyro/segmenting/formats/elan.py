"""Annotations of ELAN: a file for each demonstration with a tier for each level, written and read."""

from __future__ import annotations

from collections.abc import Collection
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.errors import BadInput
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.formats import Writer
from ddco_pyro.segmenting.formats.reading import Annotations, Span

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


ENTRIES = ("CV_ENTRY", "CV_ENTRY_ML/CVE_VALUE[1]")
"""Words of a controlled vocabulary, in files before 2.8 and since."""


def read(path: Path, demos: Collection[str], rate: float) -> Annotations:
    """The tiers of a file as labels of the demonstration after which it is named.

    Names are numbered as in a tier's controlled vocabulary. A time that ELAN leaves open lies evenly between its
    neighbours in the tier. Annotations that refer to others last as long as those.

    :raises BadInput: annotations divide another one without times.
    """
    root = ElementTree.parse(path).getroot()
    slots = root.findall("TIME_ORDER/TIME_SLOT")
    place = {slot.attrib["TIME_SLOT_ID"]: number for number, slot in enumerate(slots)}
    times = np.array([float(slot.get("TIME_VALUE", "nan")) for slot in slots])
    origin = next((float(one.get("TIME_ORIGIN", 0)) for one in root.iter("MEDIA_DESCRIPTOR")), 0.0)
    words = {
        one.attrib["CV_ID"]: [(word.text or "").strip() for entries in ENTRIES for word in one.iterfind(entries)]
        for one in root.iter("CONTROLLED_VOCABULARY")
    }
    types = {
        one.attrib["LINGUISTIC_TYPE_ID"]: one.get("CONTROLLED_VOCABULARY_REF", "")
        for one in root.iter("LINGUISTIC_TYPE")
    }
    found, spans = Annotations(), dict[str, tuple[float, float]]()
    for tier in root.iter("TIER"):
        ends = {
            one.attrib["ANNOTATION_ID"]: [place[one.attrib[f"TIME_SLOT_REF{side}"]] for side in (1, 2)]
            for one in tier.iter("ALIGNABLE_ANNOTATION")
        }
        within = np.unique([*ends.values()])
        known = within[~np.isnan(times[within])] if ends else within
        for name, at in ends.items():
            start, stop = (np.interp(at, known, times[known]) + origin) * rate / STEP
            spans[name] = float(start), float(stop)
    refer = {one.attrib["ANNOTATION_ID"]: one.attrib["ANNOTATION_REF"] for one in root.iter("REF_ANNOTATION")}
    for tier in root.iter("TIER"):
        labels = tier.attrib["TIER_ID"]
        found.names[labels] = words.get(types.get(tier.get("LINGUISTIC_TYPE_REF", ""), ""), [])
        for one in tier.iterfind("ANNOTATION/*"):
            if one.get("PREVIOUS_ANNOTATION"):
                raise BadInput(f"tier {labels!r} divides annotations of another one without times; remove it")
            chain = [one.attrib["ANNOTATION_ID"]]
            while chain[-1] not in spans:
                chain.append(refer.pop(chain[-1]))
            spans |= dict.fromkeys(chain, spans[chain[-1]])
            text = (one.findtext("ANNOTATION_VALUE") or "").strip()
            found.spans.append(Span(path.stem, labels, text, *spans[chain[0]]))
    return found
