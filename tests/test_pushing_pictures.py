"""The study of pushing from pictures: which cells it has, in which order, and what it says of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pushing_pictures as study
import pytest
from cells import described
from pushing_pictures_cell import DEFAULTS, LARGE, SIZE, PictureCell, encoded, spec_of
from pushing_pictures_results import at_one_std, differences, row_of
from scipy import stats

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.training.networks import Dimensions, build_hierarchy, parameters


def results(goals, held_out):
    return {
        "log_likelihood_per_step": {"train": held_out + 0.1, "held_out": held_out},
        "unlimited": {"goals": goals, "topples": [0.0, 1.0], "lost": [0.0, 0.0], "dwell": None, "own_control": None},
        "limited": {"goals": [2.0 * one for one in goals]},
        "parameters": 7,
        "steps": {"device": "cpu"},
        "seconds": {"fit": 90.0, "fit_processor": 30.0, "play": 30.0},
    }


def arguments(name, *words):
    parser = described("")
    study.arguments(parser)
    return parser.parse_args([name, *words])


def test_a_row_has_means_over_episodes():
    row = row_of(PictureCell("ff", 2, 80, 1), results([4.0, 1.0], -3.0))
    assert (row["goals"], row["limited"], row["topples"]) == (2.5, 5.0, 0.5)
    assert (row["minutes"], row["processor"]) == (2.0, 0.5)


def test_pictures_as_the_camera_has_them_end_in_the_same_maps():
    """So the networks differ by the two convolutions before the others, and by the 16 maps that the third one reads."""
    small, large = (
        parameters(build_hierarchy(spec_of(PictureCell(method, 2, 40, 0), DEFAULTS), Dimensions(shapes, 3, 100)))
        for method, shapes in (("ff", {"camera": (*SIZE, 3)}), ("ff_large", {"camera": (*LARGE, 3)}))
    )
    assert large - small == 16 * (75 + 1) + 16 * (16 * 25 + 1) + 16 * 25 * (16 - 3)
    spec = spec_of(PictureCell("ff_large", 2, 40, 0), DEFAULTS)
    assert spec.observations[0].augment.shift == 30
    assert spec.compare_with[0].policy.of["camera"] == spec.hierarchy.trunk.of["camera"]


def test_differences_are_paired_by_seed_and_number():
    """2.5 − 1 and 4 − 3.5 goals: 1 ± 12.706 · 0.5."""
    rows = [
        row_of(PictureCell(method, options, count, seed), results(goals, -3.0 - seed * (method == "ff_flat")))
        | {"std": 1.0}
        for method, options, count, seed, goals in [
            ("ff", 2, 40, 0, [4.0, 1.0]),
            ("ff", 2, 40, 1, [4.0, 4.0]),
            ("ff", 2, 80, 0, [9.0, 9.0]),
            ("ff_flat", 0, 40, 0, [1.0, 1.0]),
            ("ff_flat", 0, 40, 1, [3.0, 4.0]),
        ]
    ]
    (line,) = differences(at_one_std(rows), "count")
    assert line.startswith("- ff minus flat of equal size, 40 demonstrations, paired by seed (2): 1.0 ± 6.4 goals")
    assert "(2.0 ± 12.7 with the limit)" in line
    assert "0.500 ± 6.353 held-out" in line


def test_features_have_versions_of_pictures_that_are_moved():
    """Each demonstration by moves of its own, all of its pictures alike; what is read here is the picture itself."""
    pictures = np.random.default_rng(0).integers(0, 256, (10, 4, *SIZE, 3), dtype=np.uint8)
    demos = Demonstrations(
        tuple(Demonstration(f"demo_{at}", {"camera": own}, np.zeros((4, 2))) for at, own in enumerate(pictures))
    )
    reader = SimpleNamespace(encode=lambda seen: seen.reshape(len(seen), -1).astype(np.float32))
    kept, by = encoded(reader, demos, versions=6, seed=3), set()
    assert kept.names == demos.names
    for demo, whole in zip(kept, pictures, strict=True):
        np.testing.assert_array_equal(demo.observations["camera_features"], whole.reshape(4, -1))
        inside = whole[:, 3:-3, 3:-3]
        height, width = inside.shape[1:3]
        for version in demo.observations["camera_features_moved"].swapaxes(0, 1):
            seen = version.reshape(4, *SIZE, 3)
            places = [
                (row, column)
                for row in range(7)
                for column in range(7)
                if (seen[:, row : row + height, column : column + width] == inside).all()
            ]
            assert len(places) == 1
            by.update(places)
    assert len(by) > 20  # of 49
    assert list(encoded(reader, demos)[0].observations) == ["camera_features"]


def test_likelihoods_are_compared_at_one_std():
    """A flat policy's at σ = 0.35 is that of a Gaussian with its errors; options with another σ have none."""
    errors = np.random.default_rng(0).normal(0, 0.4, (50, 3))
    wide, narrow = (stats.norm.logpdf(errors, scale=std).sum(1).mean() for std in (1.0, 0.35))
    methods = {"ff_flat": (0, 1.0, wide), "encoded": (2, 0.35, -1.0), "ff": (2, 1.0, -2.9)}
    rows = [
        row_of(PictureCell(name, options, 80, 0), results([1.0], held_out)) | {"std": std}
        for name, (options, std, held_out) in methods.items()
    ]
    flat, encoded, other = at_one_std(rows)
    assert flat["at_one_std"] == pytest.approx(narrow)
    assert (encoded["at_one_std"], other["at_one_std"]) == (-1.0, None)
    (line,) = differences([flat, encoded], "count")
    assert "minus the flat policy whose features it reads, 80 demonstrations, paired by seed (1): 0.0 goals" in line


def kept_cell(runs: Path, cell: PictureCell, goals: list[float], commit: str = "y") -> None:
    """As a cell that is done is kept."""
    record = {"command": "x", "commit": commit, "dirty": False, "code": "z", "files": 1}
    path = cell.path(replace(DEFAULTS, runs=runs))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"provenance": [record], "results": results(goals, -3.0)}))


def test_what_the_page_has_is_not_done_again(tmp_path: Path):
    """Fits are gone, and another cell was done elsewhere, at another commit; other settings have another page."""
    words = ("demonstrations", "--counts", "80", "--methods", "ff_flat", "--seeds", "2", "--out", str(tmp_path))
    kept_cell(tmp_path / "here", PictureCell("ff_flat", 0, 80, 0), [2.0, 1.0])
    study.run(arguments(*words, "--summarize", "--runs", str(tmp_path / "here")))
    kept_cell(tmp_path / "there", PictureCell("ff_flat", 0, 80, 0), [9.0, 9.0])  # not read: the page has this cell
    kept_cell(tmp_path / "there", PictureCell("ff_flat", 0, 80, 1), [4.0, 5.0], commit="later")
    page = study.run(arguments(*words, "--summarize", "--runs", str(tmp_path / "there")))
    assert "at commit y, commit later." in page
    assert "not measured yet" not in page
    kept = json.loads((tmp_path / "demonstrations.json").read_text())
    assert [(row["seed"], row["goals"], row["commit"]) for row in kept["results"]["cells"]] == [
        (0, 1.5, "y"),
        (1, 4.5, "later"),
    ]
    assert study.run(arguments(*words, "--minutes", "0", "--runs", str(tmp_path / "none"))) == page  # nothing to do
    other = study.run(arguments(*words, "--summarize", "--updates", "7", "--runs", str(tmp_path / "there")))
    assert "Cells that are not measured yet: 2 of ff_flat." in other
