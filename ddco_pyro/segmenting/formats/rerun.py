"""Recordings for the Rerun viewer, one for each demonstration."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from ddco_pyro.data.files import whole_folder
from ddco_pyro.errors import BadInput
from ddco_pyro.names import name_in_level
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.formats import Writer


class Rerun(Writer):
    """A folder with ``<demonstration>.rrd``, over the timeline ``step``, and ``time`` where the frequency is known.

    ``segments/<level>`` has a ``StateChange`` at the first step of each segment, a lane of the state timeline. Beside
    it are the posterior probability of the active option, the controls, and the observations.
    """

    def check(self) -> None:
        try:
            import rerun
        except ImportError:
            rerun = None
        if not hasattr(rerun, "StateChange"):
            raise BadInput(f"{self.option} needs rerun-sdk 0.41; install it with: pip install 'ddco-pyro[rerun]'")

    def write(self, segmented: Segmented) -> str:
        with whole_folder(self.out) as folder:
            for demo in segmented.segments:
                self._write(str(folder / f"{demo.name}.rrd"), demo, segmented.frequency)
        first = self.asked.source.recording(segmented.segments[0].name)
        keys = [f"obs/{key}" for key in first.observations if key not in first.numbers]
        without = f", without {', '.join(keys)} (no numbers)" if keys else ""
        return f"{self.out}: {len(segmented)} recordings{without}; look at them with: rerun {self.out}/*.rrd"

    def _write(self, path: str, demo: Segments, frequency: float | None) -> None:
        import rerun
        from rerun import blueprint

        recording, steps = self.asked.source.recording(demo.name), np.arange(len(demo))
        stream = rerun.RecordingStream("ddco-pyro", recording_id=demo.name)
        lanes = blueprint.StateTimelineView(origin="segments", name="segments")
        stream.save(path, default_blueprint=blueprint.Blueprint(blueprint.Vertical(lanes, blueprint.TimeSeriesView())))

        def log(entity: str, at: np.ndarray, columns: Any) -> None:
            times = [rerun.TimeColumn("step", sequence=at)]
            if frequency:
                times.append(rerun.TimeColumn("time", duration=at / frequency))
            stream.send_columns(entity, times, columns)

        for name, level in demo.levels.items():
            runs = level.runs(anew=False)
            states = [name_in_level(option, name, self.asked.fit.names[name]) for option, _, _ in runs]
            starts = np.array([start for _, start, _ in runs])
            log(f"segments/{_entity(name)}", starts, rerun.StateChange.columns(state=states))
            log(f"probability/{_entity(name)}", steps, rerun.Scalars.columns(scalars=level.probability))
        for key, column in {**recording.numbers, "control": recording.actions}.items():
            if column.image:
                pictures = [
                    rerun.Image(picture).compress(jpeg_quality=90) for block in column.blocks() for picture in block
                ]
                for step, picture in enumerate(pictures):
                    stream.set_time("step", sequence=step)
                    stream.log(_entity(key), picture)
            else:
                values = column.array().reshape(len(demo), -1).astype(float)
                log(_entity(key), steps, rerun.Scalars.columns(scalars=values))
        stream.disconnect()


def _entity(name: str) -> str:
    """A name as part of a path of entities."""
    return re.sub(r"[^\w/-]", "_", name)
