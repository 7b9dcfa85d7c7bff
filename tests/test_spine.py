"""The way from ``ddco_pyro.fit`` to the compiled kernel: how deep it is, in how many files, and how often it builds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from random_demonstrations import demonstrations

import ddco_pyro
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import parse_spec

LIBRARY = str(Path(ddco_pyro.__file__).parent)

MOST_FRAMES, MOST_FILES, MOST_BUILDS = 20, 12, 4


def make_spec(*baselines):
    return parse_spec(
        yaml.safe_load(
            f"""
            demonstrations: {{path: unused.hdf5, valid_fraction: 0.2}}
            observations: [pose]
            hierarchy:
              levels: [{{count: 2, policy: {{network: mlp, hidden: [8]}}, termination: {{network: linear}}}}]
              meta_policy: {{network: linear}}
            training: {{epochs: 1, layerwise: false, initialize: random}}
            compare_with: [{", ".join(baselines)}]
            """
        )
    )


class Walk:
    """Profiles calls: ``deepest`` is the longest stack of this library's frames in which inference has been called."""

    def __init__(self):
        self.stack, self.deepest = [], []

    def __call__(self, frame, event, _):
        if event == "call":
            own = frame.f_code.co_filename.startswith(LIBRARY)
            self.stack.append((frame.f_code.co_filename.removeprefix(f"{LIBRARY}/"), frame.f_code.co_qualname, own))
            if own and self.stack[-1][0].startswith("inference/") and self.in_a_step and self.own > len(self.deepest):
                self.deepest = [(file, name) for file, name, ours in self.stack if ours]
        elif event == "return" and self.stack:
            self.stack.pop()

    @property
    def own(self):
        return sum(ours for *_, ours in self.stack)

    @property
    def in_a_step(self):
        return any(file == "training/loop.py" for file, *_ in self.stack)


def test_the_way_to_the_kernel_is_short():
    walk, spec, demos = Walk(), make_spec(), demonstrations(6)
    sys.setprofile(walk)
    try:
        ddco_pyro.fit(spec, demos)
    finally:
        sys.setprofile(None)
    print("", *(f"{file}: {name}" for file, name in walk.deepest), sep="\n")
    files = {file for file, _ in walk.deepest}
    print(f"{len(walk.deepest)} frames in {len(files)} files")
    assert walk.deepest
    assert len(walk.deepest) <= MOST_FRAMES
    assert len(files) <= MOST_FILES


@pytest.mark.parametrize("baselines", [(), ("flat", "mixture")])
def test_a_model_is_built_a_few_times(monkeypatch, baselines):
    builds, init = [], Hierarchy.__init__

    def counted(self, *arguments, **named):
        builds.append(arguments)
        init(self, *arguments, **named)

    monkeypatch.setattr(Hierarchy, "__init__", counted)
    ddco_pyro.fit(make_spec(*baselines), demonstrations(6))
    print(f"{len(builds)} builds of {1 + len(baselines)} models")
    assert len(builds) <= MOST_BUILDS * (1 + len(baselines))
