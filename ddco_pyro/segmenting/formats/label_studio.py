"""Tasks of Label Studio: predictions are written with the configuration of the labelling page, annotations read."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.formats import Writer
from ddco_pyro.segmenting.formats.reading import Annotations, Span, parsed

DEMO, CHOICES = "demonstration", "choices"
"""In the data of a task, which exports keep: its demonstration, and the names of a level's choices, control first."""

REGIONS = "timeserieslabels"
"""The kind of regions that are written."""


class LabelStudio(Writer):
    """A folder with ``tasks.json`` and ``config.xml``.

    A task shows the controls over time, with the subtasks as predicted ``timeserieslabels``. A subtask's ``score`` is
    its mean posterior probability; the score of the prediction is the lowest of them, so that Label Studio can begin
    with the demonstration that is least certain. Times are steps, inclusive. Regions have the name of the level.
    """

    def write(self, segmented: Segmented) -> str:
        tasks = [self._task(demo) for demo in segmented.segments]
        with whole_folder(self.out) as folder:
            write_text(folder / "tasks.json", json.dumps(tasks, ensure_ascii=False) + "\n")
            write_text(folder / "config.xml", self._config(self.order(segmented), list(tasks[0]["data"]["series"])))
        return f"{self.out}: {len(tasks)} tasks; make a project with config.xml and import tasks.json"

    def _task(self, demo: Segments) -> dict[str, Any]:
        actions = self.asked.source.recording(demo.name).actions.array()
        series = {"step": list(range(len(demo)))}
        series |= {f"control_{number}": column.tolist() for number, column in enumerate(actions.T)}
        probability = demo.levels[self.asked.level].probability
        scores, found = list[float](), list[dict[str, Any]]()
        for number, (option, start, stop) in enumerate(self.runs(demo)):
            labels = {"start": start, "end": stop - 1, "instant": False, REGIONS: [self.asked.names[option]]}
            scores.append(float(probability[start:stop].mean()))
            found.append({
                "id": f"{demo.name}-{number}", "from_name": self.asked.level, "to_name": "series", "type": REGIONS,
                "score": scores[-1], "value": labels,
            })  # fmt: skip
        return {
            "data": {"series": series, DEMO: demo.name, CHOICES: {self.asked.level: self.asked.names}},
            "predictions": [{"model_version": str(self.asked.run), "score": min(scores), "result": found}],
        }

    def _config(self, order: list[int], series: list[str]) -> str:
        view = ElementTree.Element("View")
        ElementTree.SubElement(view, "Header", value=f"${DEMO}")
        labels = ElementTree.SubElement(view, "TimeSeriesLabels", name=self.asked.level, toName="series")
        for option in order:
            ElementTree.SubElement(labels, "Label", value=self.asked.names[option], background=option_colour(option))
        shown = ElementTree.SubElement(
            view, "TimeSeries", name="series", valueType="json", value="$series", timeColumn="step"
        )
        for column in series[1:]:
            ElementTree.SubElement(shown, "Channel", column=column)
        ElementTree.indent(view)
        return ElementTree.tostring(view, "unicode") + "\n"


def read(path: Path, demos: Collection[str], rate: float) -> Annotations:
    """The regions of an export as labels by the name of their tag.

    A task is of the demonstration that its data names, or that a file in its data is called after. Regions of time
    series are in steps where all their times are whole numbers, else in seconds; both ends are inclusive. Frames of
    videos count from 1. A task's predictions count only in files that were not exported.

    :raises BadInput: a task has annotations of several people, or is of no demonstration.
    """
    found = Annotations()
    for place, task in enumerate(parsed(path), start=1):
        where = f"task {task.get('id', place)}"
        if "data" not in task:
            raise BadInput(f"{where} has no data: export as JSON, not as JSON-MIN")
        given = [one for one in task.get("annotations", task.get("predictions", ())) if not one.get("was_cancelled")]
        if len(given) > 1:
            raise BadInput(f"{where} has {len(given)} annotations; leave one, such as by an export for each person")
        demo = _demonstration(task, demos)
        if demo is None:
            raise BadInput(f"{where} is of no demonstration; say its name as {DEMO!r} in the task's data")
        found.names |= task["data"].get(CHOICES, {})
        regions = sorted(_regions(given[0]["result"], rate) if given else (), key=lambda one: (one[0], *one[2:]))
        for number, (labels, name, start, stop) in enumerate(regions, start=1):
            after = regions[number] if number < len(regions) else None
            if after and after[0] == labels and start < after[2] == stop - 1:
                stop -= 1  # neighbours share a sample where an edge was drawn once for both
            found.spans.append(Span(demo, labels, name, start, stop))
    return found


def _demonstration(task: dict[str, Any], demos: Collection[str]) -> str | None:
    """The demonstration of a task; its own name where it says one, known or not."""
    if DEMO in task["data"]:
        return str(task["data"][DEMO])
    said = [text for text in (*task["data"].values(), task.get("file_upload")) if isinstance(text, str)]
    stems = [PurePath(unquote(urlsplit(text).path)).stem for text in said]
    return next((stem for whole in stems for stem in (whole, whole.partition("-")[2]) if stem in demos), None)


def _regions(result: list[dict[str, Any]], rate: float) -> Iterator[tuple[str, str, float, float]]:
    """Each region as (name of its tag, label, first step, step after the last)."""
    series = [own["value"] for own in result if REGIONS in own["value"] and "start" in own["value"]]
    steps = all(float(own[end]).is_integer() for own in series for end in ("start", "end"))
    for own in result:
        value, tag = own["value"], own["from_name"]
        for kind in (REGIONS, "timelinelabels", "labels"):
            if kind not in value:
                continue
            if len(value[kind]) > 1:
                raise BadInput(f"a region of {tag} has {len(value[kind])} labels; a step has one")
            name = value[kind][0] if value[kind] else ""
            if "ranges" in value:
                yield from ((tag, name, part["start"] - 1, part["end"]) for part in value["ranges"])
            elif kind == REGIONS:
                start, end = (float(value[side]) * (1 if steps else rate) for side in ("start", "end"))
                yield tag, name, round(start), round(end) + 1
            elif "start" in value:
                yield tag, name, value["start"] * rate, value["end"] * rate
