"""Annotations for other programs: ELAN, Label Studio and Rerun, with the names of all choices."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ddco_pyro.data.arrays import NUMBERS, blocks, is_picture
from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.labels import SOURCE, SOURCES, UNKNOWN
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.segments import Segmented, Segments

SCHEMA = "http://www.mpi.nl/tools/elan/EAFv3.0.xsd"
UNDETERMINED = "und"
"""ELAN's name of no language in particular."""
STEP = 1000.0
"""Milliseconds of a step where the steps per second are not known."""


def write_elan(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``<demonstration>.eaf``; times are milliseconds.

    The highest level comes first. An annotation lasts from the first step of a segment to the first step of the next.
    Steps that a person left open have none. A tier ``<level>_source`` says who says each segment of a level.
    A controlled vocabulary has the names of all choices of a level.
    """
    milliseconds = 1000 / segmented.frequency if segmented.frequency else STEP
    with whole_folder(asked.out) as folder:
        for demo in segmented.segments:
            write_text(folder / f"{demo.name}.eaf", _document(asked, demo, milliseconds))
    unit = "" if segmented.frequency else "; a step is one second, since the demonstrations have no frequency"
    return f"{asked.out}: {len(segmented)} files{unit}"


def _document(asked: Asked, demo: Segments, milliseconds: float) -> str:
    when = datetime.now(UTC).isoformat(timespec="seconds")
    root = ElementTree.Element(
        "ANNOTATION_DOCUMENT",
        {"AUTHOR": "ddco-pyro", "DATE": when, "FORMAT": "3.0", "VERSION": "3.0",
         "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance", "xsi:noNamespaceSchemaLocation": SCHEMA},
    )  # fmt: skip
    ElementTree.SubElement(root, "HEADER", MEDIA_FILE="", TIME_UNITS="milliseconds")
    times = ElementTree.SubElement(root, "TIME_ORDER")
    levels = dict(reversed(demo.levels.items()))
    tiers = {
        name: [
            (asked.names_of(name)[option], start, stop)
            for option, start, stop in level.runs(anew=False)
            if option != UNKNOWN
        ]
        for name, level in levels.items()
    }
    ends = [(start, stop) for _, start, stop in asked.runs(demo)]
    if said := [(word, *each) for each in ends if (word := asked.said_by(demo, *each)) is not None]:
        tiers[asked.level + SOURCE] = said
    edges = {0, len(demo)}.union(*(run[1:] for runs in tiers.values() for run in runs))
    for step in sorted(edges):
        value = str(round(step * milliseconds))
        ElementTree.SubElement(times, "TIME_SLOT", TIME_SLOT_ID=f"ts{step}", TIME_VALUE=value)
    number = 0
    for name, segments in tiers.items():
        tier = ElementTree.SubElement(root, "TIER", TIER_ID=name, LINGUISTIC_TYPE_REF=name)
        for word, start, stop in segments:
            number += 1
            annotation = ElementTree.SubElement(ElementTree.SubElement(tier, "ANNOTATION"), "ALIGNABLE_ANNOTATION")
            annotation.attrib |= {
                "ANNOTATION_ID": f"a{number}", "TIME_SLOT_REF1": f"ts{start}", "TIME_SLOT_REF2": f"ts{stop}"
            }  # fmt: skip
            ElementTree.SubElement(annotation, "ANNOTATION_VALUE").text = word
    for name in tiers:
        kind = {"LINGUISTIC_TYPE_ID": name, "TIME_ALIGNABLE": "true", "CONTROLLED_VOCABULARY_REF": name}
        ElementTree.SubElement(root, "LINGUISTIC_TYPE", kind)
    ElementTree.SubElement(root, "LANGUAGE", LANG_ID=UNDETERMINED)
    for name in tiers:
        vocabulary = ElementTree.SubElement(root, "CONTROLLED_VOCABULARY", CV_ID=name)
        ElementTree.SubElement(vocabulary, "DESCRIPTION", LANG_REF=UNDETERMINED)
        for option, word in enumerate(asked.names_of(name) if name in levels else SOURCES):
            entry = ElementTree.SubElement(vocabulary, "CV_ENTRY_ML", CVE_ID=f"{name}_{option}")
            ElementTree.SubElement(entry, "CVE_VALUE", LANG_REF=UNDETERMINED).text = word
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


# --- Label Studio -----------------------------------------------------------------------------------------------------

DEMO = "demonstration"
"""In the data of a task, which exports keep."""

REGIONS = "timeserieslabels"
"""The kind of regions that are written."""


def write_label_studio(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``tasks.json`` and ``config.xml``.

    A task shows the controls over time, with the subtasks as predicted ``timeserieslabels``. A subtask's ``score`` is
    its mean posterior probability; the score of the prediction is the lowest of them, so that Label Studio can begin
    with the demonstration that is least certain. Times are steps, inclusive. Regions have the name of the level, and
    who says so as ``meta``. Steps that a person left open have no region.
    """
    tasks = [_task(asked, demo) for demo in segmented.segments]
    with whole_folder(asked.out) as folder:
        write_text(folder / "tasks.json", json.dumps(tasks, ensure_ascii=False) + "\n")
        channels = [name for name in tasks[0]["data"]["series"] if name != "step"]
        write_text(folder / "config.xml", _config(asked, asked.order(segmented), channels))
    return f"{asked.out}: {len(tasks)} tasks; make a project with config.xml and import tasks.json"


def _task(asked: Asked, demo: Segments) -> dict[str, Any]:
    actions = asked.source.read(demo.name).actions
    series = {"step": list(range(len(demo)))}
    series |= {f"control_{number}": column.tolist() for number, column in enumerate(actions.T)}
    probability = demo.levels[asked.level].probability
    found = list[dict[str, Any]]()
    for number, (option, start, stop) in enumerate(asked.runs(demo)):
        labels = {"start": start, "end": stop - 1, "instant": False, REGIONS: [asked.names[option]]}
        source = asked.said_by(demo, start, stop)
        meta = {} if source is None else {"meta": {"text": [source]}}
        found.append({
            "id": f"{demo.name}-{number}", "from_name": asked.level, "to_name": "series", "type": REGIONS,
            "score": float(probability[start:stop].mean()), "value": labels, **meta,
        })  # fmt: skip
    score = min((region["score"] for region in found), default=0.0)
    return {
        "data": {"series": series, DEMO: demo.name},
        "predictions": [{"model_version": str(asked.run), "score": score, "result": found}],
    }


def _config(asked: Asked, order: list[int], channels: list[str]) -> str:
    view = ElementTree.Element("View")
    ElementTree.SubElement(view, "Header", value=f"${DEMO}")
    labels = ElementTree.SubElement(view, "TimeSeriesLabels", name=asked.level, toName="series")
    for option in order:
        ElementTree.SubElement(labels, "Label", value=asked.names[option], background=option_colour(option))
    shown = ElementTree.SubElement(
        view, "TimeSeries", name="series", valueType="json", value="$series", timeColumn="step"
    )
    for column in channels:
        ElementTree.SubElement(shown, "Channel", column=column)
    ElementTree.indent(view)
    return ElementTree.tostring(view, "unicode") + "\n"


# --- Rerun ------------------------------------------------------------------------------------------------------------


def write_rerun(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``<demonstration>.rrd``, over the timeline ``step``, and ``time`` where the frequency is known.

    ``segments/<level>`` has a ``StateChange`` at the first step of each segment, a lane of the state timeline. Beside
    it are the posterior probability of the active option, the controls, and the observations.
    """
    with whole_folder(asked.out) as folder:
        for demo in segmented.segments:
            _record(str(folder / f"{demo.name}.rrd"), asked, demo, segmented.frequency)
    first = asked.source.read(segmented.segments[0].name).observations
    keys = [f"obs/{key}" for key, array in first.items() if array.dtype.kind not in NUMBERS]
    without = f", without {', '.join(keys)} (no numbers)" if keys else ""
    return f"{asked.out}: {len(segmented)} recordings{without}; look at them with: rerun {asked.out}/*.rrd"


def _record(path: str, asked: Asked, demo: Segments, frequency: float | None) -> None:
    import rerun
    from rerun import blueprint

    found, steps = asked.source.read(demo.name), np.arange(len(demo))
    stream = rerun.RecordingStream("ddco-pyro", recording_id=demo.name)
    lanes = blueprint.StateTimelineView(origin="segments", name="segments")
    stream.save(path, default_blueprint=blueprint.Blueprint(blueprint.Vertical(lanes, blueprint.TimeSeriesView())))

    def log(entity: str, at: np.ndarray, columns: Any) -> None:
        times = [rerun.TimeColumn("step", sequence=at)]
        if frequency:
            times.append(rerun.TimeColumn("time", duration=at / frequency))
        stream.send_columns(entity, times, columns)

    states = {
        name: (level.options, [*asked.names_of(name), SOURCES[UNKNOWN + 1]]) for name, level in demo.levels.items()
    }
    states |= {name: (own, [*SOURCES]) for name, own in demo.sources.items()}
    for name, (values, words) in states.items():
        starts = np.flatnonzero(np.diff(values, prepend=-9))
        changes = rerun.StateChange.columns(state=[words[value] for value in values[starts]])
        log(f"segments/{_entity(name)}", starts, changes)
    for name, level in demo.levels.items():
        log(f"probability/{_entity(name)}", steps, rerun.Scalars.columns(scalars=level.probability))
    numbers = {key: array for key, array in found.observations.items() if array.dtype.kind in NUMBERS}
    for key, array in {**numbers, "control": found.actions}.items():
        if is_picture(array):
            for step, picture in enumerate(picture for block in blocks(array) for picture in block):
                stream.set_time("step", sequence=step)
                stream.log(_entity(key), rerun.Image(picture).compress(jpeg_quality=90))
        else:
            values = np.asarray(array).reshape(len(demo), -1).astype(float)
            log(_entity(key), steps, rerun.Scalars.columns(scalars=values))
    stream.disconnect()


def _entity(name: str) -> str:
    """A name as part of a path of entities."""
    return re.sub(r"[^\w/-]", "_", name)
