"""Labels for several levels: each level is compared with its own, in ``metrics.json``, report and page."""

from __future__ import annotations

import numpy as np
import pytest
from command_line import call

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.report import write_report
from ddco_pyro.spec import parse_spec


def demonstrations():
    random = np.random.default_rng(0)
    demos = []
    for number in range(6):
        phase = np.repeat([0, 1, 2, 3], 4)
        place = phase[:, None] + 0.1 * random.normal(size=(16, 1))
        labels = {"phase": phase, "half": np.where(np.arange(16) == 8, -1, phase // 2)}
        demos.append(Demonstration(f"demo_{number}", {"place": place}, random.normal(size=(16, 1)), labels))
    return Demonstrations(tuple(demos))


def spec(labels):
    levels = [
        {"name": name, "count": count, "policy": {"network": "linear"}, "termination": {"network": "linear"}}
        for name, count in (("low", 3), ("high", 2))
    ]
    return parse_spec(
        {
            "demonstrations": {"path": "demos.hdf5", "labels": labels, "valid_fraction": 0.34},
            "observations": ["place"],
            "hierarchy": {"levels": levels, "meta_policy": {"network": "linear"}},
            "training": {"epochs": 3, "layerwise": False},
        }
    )


@pytest.mark.parametrize(("labels", "names"), [(["phase", "half"], ["phase", "half"]), ("half", ["half", "half"])])
def test_each_level_is_measured_with_its_own_labels(tmp_path, monkeypatch, labels, names):
    monkeypatch.chdir(tmp_path)
    demonstrations().write(tmp_path / "demos.hdf5")
    fit = ddco_pyro.fit(spec(labels), out=tmp_path / "run")
    metrics = fit.metrics.agreement
    assert metrics.labels == names
    valid = demonstrations().select([row.name for row in fit.metrics.valid])
    measured = zip(fit.segment(valid), names, metrics.valid, metrics.confusion, strict=True)
    for level, name, found, table in measured:
        truth = [demo.labels[name] for demo in valid]
        assert found == agreement(list(level), truth)
        assert np.sum(table.steps) == sum((one >= 0).sum() for one in truth)
    if labels == "half":
        return
    page = write_report(ddco_pyro.load(tmp_path / "run"), fit.demonstrations).read_text()
    for level, name in zip(("low", "high"), names, strict=True):
        assert f"Where each label’s steps lie: level “{level}”, label “{name}”" in page
    assert call("segment", "run", "demos.hdf5", "--html", "page.html").status == 0
    shown = (tmp_path / "page.html").read_text()
    assert [shown.count(f"Agreement with the label “{name}”") for name in names] == [names.count(one) for one in names]
