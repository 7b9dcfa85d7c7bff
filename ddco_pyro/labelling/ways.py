"""Ways to cut demonstrations, of which a person means one: other lengths, and other optima of training."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import numpy as np
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.evaluation.inferred import runs
from ddco_pyro.evaluation.options import segments_of
from ddco_pyro.events import OnEvent, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.selection.small import lasting, overrides
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.data import parts

ASKED = 3
"""Demonstrations that the ways are shown on."""

LENGTHS = {"coarse": 2.0, "fine": 0.5}
"""Median segments of other ways, in units of the run's own."""

SEEDS = (1, 2)
"""Further training seeds."""

ALIKE = 0.9
"""The NMI of segments from which on two ways to cut are the same."""


class Ways:
    """The ways to cut that are known, a run's own first.

    :param number: of the level whose segments are meant, 1 for the lowest.
    :ivar fits: each model, by the name of the way.
    """

    def __init__(self, trained: Fit, demos: Demonstrations, number: int) -> None:
        self.trained, self.demos, self.number = trained, demos, number
        self.asked = np.unique(np.linspace(0, len(demos) - 1, ASKED).round().astype(int)).tolist()
        self.fits, self._options, self._shown = dict[str, Fit](), list[np.ndarray](), list[dict[str, Any]]()
        self.add("medium", trained)

    @cached_property
    def calls(self) -> dict[str, Callable[..., Fit]]:
        """The fits that find other ways, for any process."""
        spec, calls = self.trained.spec, dict[str, Callable[..., Fit]]()
        assert spec.hierarchy is not None
        if spec.training.labels is None and self.number == 1 and spec.hierarchy.levels[0].lasts:
            calls = {name: partial(_longer, self.trained, factor) for name, factor in LENGTHS.items()}
        return calls | {f"seed {seed}": partial(_again, self.trained, seed) for seed in SEEDS}

    def add(self, name: str, found: Fit) -> None:
        """Another way; one that is hardly different is left out, unless it has another length."""
        cuts = found.segment(self.demos)[self.number - 1]
        options = np.concatenate([*cuts])
        alike = max((normalized_mutual_info_score(options, other) for other in self._options), default=0.0)
        if name in LENGTHS or alike < ALIKE:
            each = [
                [
                    {"start": start, "stop": stop, "option": int(option)}
                    for option, start, stop in runs(cuts[index], np.diff(cuts[index], prepend=-1) != 0)
                ]
                for index in self.asked
            ]
            names = list(cuts.names[1:])
            colours = [option_colour(option) for option in range(1, len(names) + 1)]
            median = float(np.median([segment.steps for segment in cuts.segments]))
            looks = {"median": median, "demos": each, "names": names, "colours": colours}
            self.fits[name] = found
            self._options.append(options)
            self._shown.append({"id": name, "name": name, **looks})

    def shown(self) -> dict[str, Any]:
        """What a page shows of them."""
        return {"demos": self.asked, "proposals": [*self._shown]}


ALONE = {"compare_with": [], "demonstrations.leave_one_out": False}


def _longer(trained: Fit, factor: float, on_event: OnEvent = ignore) -> Fit:
    """A run's model, fitted again so that segments are about so many times as long."""
    spec, demos = trained.spec, trained.demonstrations
    train = parts(spec, demos)["train"]
    half = float(np.mean([len(demo) for demo in train])) / 2  # a whole demonstration is no skill
    steps = min(factor * segments_of(trained.segment(train)[0]).median, half)
    found = lasting(spec, demos, steps, on_event)
    changes = overrides(spec, found.power, found.constant, found.window) | ALONE
    return fit(with_overrides(spec, changes), demos, None, on_event)


def _again(trained: Fit, seed: int, on_event: OnEvent = ignore) -> Fit:
    """A run's model, fitted with another training seed."""
    changes = ALONE | {"training.seed": seed}
    return fit(with_overrides(trained.spec, changes), trained.demonstrations, None, on_event)
