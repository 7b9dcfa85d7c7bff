"""How often ``ddco_pyro.fit`` builds a model."""

from __future__ import annotations

import pytest
import yaml
from random_demonstrations import demonstrations

import ddco_pyro
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import parse_spec

MOST_BUILDS = 4


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
