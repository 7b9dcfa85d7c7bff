"""Tasks of Label Studio: predictions, with the configuration of the labelling page."""

from __future__ import annotations

import json
from typing import Any
from xml.etree import ElementTree

from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.formats import Writer

DEMO = "demonstration"
"""In the data of a task, which exports keep."""

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
            "data": {"series": series, DEMO: demo.name},
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
