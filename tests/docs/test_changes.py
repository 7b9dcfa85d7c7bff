"""The changes that docs/architecture.md promises, made in a copy of the library: a file each and its row."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy import stats

ROOT = Path(__file__).parents[2]

LAPLACE = '''
"""A control whose dimensions have Laplace distributions: a ~ Laplace(μ, σ)."""
import math
from typing import ClassVar
from ddco_pyro.model.emissions.gaussian import Gaussian, continuous_control

class Laplace(Gaussian):
    helpers: ClassVar = (continuous_control,)

    def by_dimension(self, actions):
        errors = (actions.unsqueeze(-2) - self.mean).abs() / self.std
        return -errors - self.std.log() - self.log_scale - math.log(2)

    def log_density(self, actions):
        return self.by_dimension(actions).sum(-1)
'''

NETWORK = '''
"""A linear network whose weights come in pairs of products."""
import torch
from torch import nn

class Squared(nn.Module):
    def __init__(self, shape, outputs, copies):
        super().__init__()
        self.size, self.weight = (copies, outputs), nn.Parameter(torch.randn(shape.vector, copies * outputs))

    def forward(self, inputs):
        return (inputs.vector @ self.weight.square()).unflatten(-1, self.size)
'''

NPZ = '''
"""Demonstrations of equal length in an .npz file: ``place`` [N, T, D] and ``actions`` [N, T, A]."""
import numpy as np
from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.sources import Source

def open_npz(path):
    with np.load(path) as arrays:
        each = dict(enumerate(zip(arrays["place"], arrays["actions"])))

    def read(name):
        place, actions = each[int(name.removeprefix("demo_"))]
        return Demonstration.stored(name, {"place": place}, actions)

    yield Source(tuple(f"demo_{n}" for n in each), read)
'''

COUNTS = '''
"""How many segments each demonstration has."""
from ddco_pyro.data.files import whole_file

def write(asked, segmented):
    counts = [f"{demo.name} {len(asked.runs(demo))}\\n" for demo in segmented.segments]
    with whole_file(asked.out) as temporary:
        temporary.write_text("".join(counts))
    return str(asked.out)
'''

OF_NPZ = 'FORMATS = {"npz": Format("npz:open_npz", ".npz", fits=lambda path, names: path.suffix == ".npz"),'
OF_COUNTS = 'FORMATS = {"--counts": Format("stream", "counts:write", "Counts."),'
OPTION = '    counts: Annotated[Path | None, _to("--counts")] = None,\n    html: Annotated'
COUNTED = {
    "segmenting/formats/__init__.py": ("FORMATS = {", OF_COUNTS),
    "cli/runs.py": ("    html: Annotated", OPTION),
}
CHANGES = {
    "model/emissions/laplace.py": (LAPLACE, {"spec/settings.py": ('"student",', '"student", "laplace",')}),
    "../squared.py": (NETWORK, {}),  # a spec names a class wherever it lies
    "data/sources/npz.py": (NPZ, {"data/formats.py": ("FORMATS = {", OF_NPZ)}),
    "segmenting/formats/counts.py": (COUNTS, COUNTED),
}
"""A new file, and its rows: in a file what stands there, and the same with the row."""

LINEAR = {"network": "linear"}
LEVEL = {"count": 2, "policy": {"network": "squared:Squared"}, "termination": LINEAR}
SPEC = {
    "demonstrations": {"path": "mine.hdf5"},
    "observations": ["place"],
    "control": {"kind": "laplace", "std": 0.5},
    "hierarchy": {"levels": [LEVEL], "meta_policy": LINEAR},
    "training": {"epochs": 2, "optimizer": {"name": "adam"}},
}


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """A folder with a copy of the library, in which every change has been made."""
    folder = tmp_path_factory.mktemp("changed")
    library = folder / "ddco_pyro"
    shutil.copytree(ROOT / "ddco_pyro", library)  # with what is compiled of it
    for name, (content, rows) in CHANGES.items():
        (library / name).write_text(content)
        for table, (before, after) in rows.items():
            text = (library / table).read_text()
            assert text.count(before) == 1
            (library / table).write_text(text.replace(before, after))
    return folder


ALL = """
import sys
import torch
from ddco_pyro.cli.app import main
from ddco_pyro.model.emissions import KINDS
for words in (
    "import mine.npz --out mine.hdf5",
    "fit spec.yaml --out run --allow-code",
    "segment run mine.hdf5 --csv steps.csv --counts counts.txt --allow-code",
):
    sys.argv = ["ddco-pyro", *words.split()]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, words
one = KINDS["laplace"](torch.ones(1, 2), torch.full((2,), 0.5), torch.zeros(2))
print(one.log_density(torch.tensor([0.0, 3.0])).item())
"""


def test_a_distribution_a_network_and_formats_are_a_file_and_a_row_each(changed):
    random = np.random.default_rng(0)
    place = random.normal(size=(6, 10, 2))
    np.savez(changed / "mine.npz", place=place, actions=2 * place + random.laplace(size=place.shape))
    (changed / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    environment = {**os.environ, "PYTHONPATH": str(changed)}
    command = [sys.executable, "-c", ALL]
    done = subprocess.run(command, cwd=changed, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) == pytest.approx(stats.laplace(1, 0.5).logpdf([0, 3]).sum())
    steps = pd.read_csv(changed / "steps.csv")
    assert len(steps) == 60
    changes = steps.groupby("demonstration").option.apply(lambda options: int(options.diff().ne(0).sum()))
    counts = dict(line.split() for line in (changed / "counts.txt").read_text().splitlines())
    assert {name: int(number) for name, number in counts.items()} == changes.to_dict()
