"""What a person has said, and what is shown, as the segments that ``segment`` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ddco_pyro.data.sources import Source
from ddco_pyro.data.sources.recording import label_names
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.document import Document
from ddco_pyro.labelling.proposals import Shown
from ddco_pyro.names import choice_names
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments, segments


def said(document: Document, level: str, source: Source, frequency: float | None) -> Segmented:
    """The labels of a level alone, -1 where nothing is said."""
    each, count = [], len(document.names)
    for name in document.lengths:
        labels = document.in_file(name)
        starts = np.diff(labels, prepend=-9) != 0
        starts[[*document.cuts[name]]] = True
        each.append(Segments(name, {level: LevelLabels(labels, starts, np.ones(len(labels)))}, 0.0, False))
    names: dict[str, Sequence[str]] = {level: choice_names(count, document.names)}
    return Segmented(tuple(each), {level: count}, frequency, {}, names, label_names(source.attributes))


def shown(fit: Fit, source: Source, level: str, proposed: Mapping[str, Shown], names: Sequence[str]) -> Segmented:
    """All levels of a model, one of them as it is shown.

    :param names: of that level's options.
    :raises BadInput: the model lacks an option.
    """
    if len(names) + 1 != len(fit.names[level]):
        raise BadInput("an option is new; refit before you write segments")
    model = segments(fit, source)
    each = []
    for demo in model.segments:
        own = proposed[demo.name]
        labels = LevelLabels(own.options, np.diff(own.options, prepend=-1) != 0, own.probability)
        each.append(replace(demo, levels={**demo.levels, level: labels}))
    return replace(model, segments=tuple(each), names={**model.names, level: choice_names(len(names), names)})
