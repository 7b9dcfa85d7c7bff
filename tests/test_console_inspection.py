"""What `inspect` shows of a field, against what was put into the file."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from ddco_pyro.cli import console
from ddco_pyro.data.inspection import inspect


def test_each_field_has_its_range_and_what_is_odd_about_it(tmp_path: Path, capsys) -> None:
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for number, length in enumerate((4, 6)):
            group = file.create_group(f"data/demo_{number}")
            steps = np.arange(length, dtype=float)
            group["actions"] = np.stack([steps, np.full(length, 7.0)], axis=1)
            group["obs/goal"] = np.full((length, 1), 1.0 + number)
            group["obs/odd"] = np.where(steps == 1, [np.nan, np.inf][number], -steps)[:, None]
            group["obs/nothing"] = np.full((length, 1), np.nan)
            group["obs/camera"] = np.full((length, 8, 8, 3), 10 * number, np.uint8)
    console.inspection(inspect(path))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("2 demonstrations of 4 to 6 steps (median 5, 10 in all)")
    assert lines[1] == "control frequency: not in the file"
    rows = {line.split("│")[0].strip(): [cell.strip() for cell in line.split("│")[1:]] for line in lines}
    assert rows["actions"] == ["[2]", "float64", "0 to 7", "constant: 1"]
    assert rows["obs/goal"] == ["[1]", "float64", "1 to 2", "one value per demonstration"]
    assert rows["obs/odd"] == ["[1]", "float64", "-5 to 0", "1 NaN, 1 infinite"]
    assert rows["obs/nothing"][2:] == ["-", "10 NaN, 0 infinite"]
    assert rows["obs/camera"][:2] == ["[8, 8, 3]", "uint8"]
    assert rows["obs/camera"][3].startswith("image")
    assert sum(line.startswith("problem: ") for line in lines) == len(inspect(path).problems) > 0
