"""Annotations for other programs: ELAN, Label Studio and Rerun, with the names of all choices."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from typing import Any

import jinja2
import numpy as np

from ddco_pyro.data.arrays import NUMBERS, blocks, is_picture
from ddco_pyro.data.files import whole_folder, write_text
from ddco_pyro.data.labels import SOURCE, SOURCES, UNKNOWN
from ddco_pyro.names import option_colour
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.segments import Segmented, Segments

STEP = 1000.0
"""Milliseconds of a step where the steps per second are not known."""


def write_elan(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``<demonstration>.eaf``; times are milliseconds.

    The highest level comes first. An annotation lasts from the first step of a segment to the first step of
    the next. Steps that a person left open have none. A tier ``<level>_source`` says who says each segment of
    a level. A controlled vocabulary has the names of all choices of a level.
    """
    milliseconds = 1000 / segmented.frequency if segmented.frequency else STEP
    when = datetime.now(UTC).isoformat(timespec="seconds")
    names = {level: asked.names_of(level) for level in segmented.counts} | {asked.level + SOURCE: SOURCES}
    with whole_folder(asked.out) as folder:
        for demo in segmented.segments:
            tiers = _tiers(asked, demo)
            steps = {0, len(demo)}.union(*(run[1:] for tier in tiers.values() for run in tier))
            times = {step: round(step * milliseconds) for step in sorted(steps)}
            text = _xml("elan.eaf", when=when, times=times, tiers=tiers, vocabularies=names)
            write_text(folder / f"{demo.name}.eaf", text)
    unit = "" if segmented.frequency else "; a step is one second, since the demonstrations have no frequency"
    return f"{asked.out}: {len(segmented)} files{unit}"


def _xml(template: str, **values: Any) -> str:
    """The text of a template of this folder, filled."""
    loader = jinja2.PackageLoader("ddco_pyro.segmenting.formats", ".")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(f"{template}.j2").render(values) + "\n"


def _tiers(asked: Asked, demo: Segments) -> dict[str, list[tuple[str, int, int]]]:
    """The segments of each level, the highest first, and who says each segment where a person labelled."""
    tiers = {
        name: [(names[run[0]], run[1], run[2]) for run in level.runs(anew=False) if run[0] != UNKNOWN]
        for name, level in reversed(demo.levels.items())
        for names in [asked.names_of(name)]
    }
    if asked.level + SOURCE in demo.sources:
        runs = asked.runs(demo)
        said = [(str(asked.said_by(demo, start, stop)), start, stop) for _, start, stop in runs]
        tiers[asked.level + SOURCE] = said
    return tiers


# --- Label Studio -------------------------------------------------------------------------------------------

DEMO = "demonstration"
"""In the data of a task, which exports keep."""

REGIONS = "timeserieslabels"
"""The kind of regions that are written."""


def write_label_studio(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``tasks.json`` and ``config.xml``.

    A task shows the controls over time, with the subtasks as predicted ``timeserieslabels``. A subtask's
    ``score`` is its mean posterior probability; the score of the prediction is the lowest of them, so that
    Label Studio can begin with the demonstration that is least certain. Times are steps, inclusive. Regions
    have the name of the level, and who says so as ``meta``. Steps that a person left open have no region.
    """
    tasks = [_task(asked, demo) for demo in segmented.segments]
    with whole_folder(asked.out) as folder:
        write_text(folder / "tasks.json", json.dumps(tasks, ensure_ascii=False) + "\n")
        channels = [name for name in tasks[0]["data"]["series"] if name != "step"]
        labels = {asked.names[option]: option_colour(option) for option in asked.order(segmented)}
        config = _xml("label_studio.xml", demo=DEMO, level=asked.level, labels=labels, channels=channels)
        write_text(folder / "config.xml", config)
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
        "predictions": [{"model_version": asked.fit.place, "score": score, "result": found}],
    }


# --- Rerun --------------------------------------------------------------------------------------------------


def write_rerun(asked: Asked, segmented: Segmented) -> str:
    """A folder with ``<demonstration>.rrd``, over the timeline ``step``, and ``time`` if the rate is known.

    ``segments/<level>`` has a ``StateChange`` at the first step of each segment, a lane of the state
    timeline. Beside it are the active option's posterior probability, the controls and the observations.
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
    views = blueprint.Vertical(lanes, blueprint.TimeSeriesView())
    stream.save(path, default_blueprint=blueprint.Blueprint(views))

    def log(entity: str, at: np.ndarray, columns: Any) -> None:
        times = [rerun.TimeColumn("step", sequence=at)]
        if frequency:
            times.append(rerun.TimeColumn("time", duration=at / frequency))
        stream.send_columns(entity, times, columns)

    levels = demo.levels.items()
    states = {name: (level.options, [*asked.names_of(name), SOURCES[UNKNOWN + 1]]) for name, level in levels}
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
