"""Observations that vary by rounding: `inspect` says so, `init` leaves them out, no encoder makes them loud.

What rests is planted: a simulator's quaternion of an object that never turns, with components 1e-6 apart.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from random_demonstrations import numbered

from ddco_pyro.data.controls import rounding
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.spec import ObservationSpec


def make_demonstrations(number: int = 6, steps: int = 20) -> Demonstrations:
    random = np.random.default_rng(0)
    records = []
    for index in range(number):
        noise = random.normal(0, 2e-7, (steps, 3))
        place = random.normal(size=(steps, 2)).cumsum(0)
        observations = {
            "resting": np.column_stack([np.ones(steps), noise]),  # a quaternion
            "half": np.column_stack([place[:, :1], 0.7 + noise[:, :1], random.normal(0, 1e-3, steps)]),
            "place": place,
            "distance": 1e-7 * place[:, :1],  # small, and nothing but signal
            "settled": np.full((steps, 1), 0.3 * index)
            + noise[:, :1],  # differs between demonstrations alone
        }
        observations = {key: values.astype(np.float32) for key, values in observations.items()}
        records.append((observations, np.sin(place) + random.normal(0, 0.1, (steps, 2))))
    return numbered(records)


DEMOS = make_demonstrations()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rounding") / "demos.hdf5"
    DEMOS.write(path)
    return path


@pytest.mark.parametrize(
    ("low", "high", "dtype", "expected"),
    [
        ([1.0, -6e-7], [1.0, 6e-7], "float32", [True, True]),  # Meta-World's hand-insert and sweep-into
        # its shelf-place, after 500 steps of a simulator
        ([1.0, -8.6e-6], [1.0, 7.7e-6], "float64", [True, True]),
        ([1.0, -5e-5], [1.0, 5e-5], "float32", [True, False]),  # a tenth of a millimetre, or of a milliradian
        # nothing large beside it: a signal in small units
        ([-6e-7, -1e-7], [6e-7, 1e-7], "float32", [False, False]),
        ([1e3, -1e-3], [1e3, 1e-3], "float64", [True, False]),  # mixed units: parts of 1, not of 1000
        ([5e6], [5e6 + 3], "float64", [False]),  # metres in a map's coordinates
        ([5e6], [5e6 + 1], "float32", [True]),  # two units in the last place
        ([1000], [1001], "int64", [False]),  # whole numbers are not rounded
        ([0.0], [0.0], "float32", [True]),
        ([np.inf], [-np.inf], "float32", [False]),  # no finite value
    ],
)
def test_what_rests(low, high, dtype, expected) -> None:
    low, high = np.array(low), np.array(high)
    assert (high - low <= rounding(low, high, np.dtype(dtype))).tolist() == expected


def test_inspect_says_so(path: Path) -> None:
    found = inspect(path)
    assert found.fields["obs/resting"].constant == [0]
    assert found.fields["obs/resting"].rounding == [1, 2, 3]
    assert found.fields["obs/half"].rounding == [1]
    for key in ("place", "distance", "settled"):
        assert found.fields[f"obs/{key}"].rounding == []
    assert found.fields["actions"].rounding == []
    lines = [line.split("│") for line in call("inspect", path).out.splitlines()]
    rows = {cells[0].strip(): cells[-1].strip() for cells in lines}
    assert rows["obs/resting"] == "constant up to rounding"
    assert rows["obs/half"] == "constant up to rounding: 1"
    fields = {field["place"]: field for field in json.loads(call("inspect", path, "--json").out)["fields"]}
    assert fields["obs/resting"]["rounding"] == [1, 2, 3]


def test_init_leaves_them_out(path: Path) -> None:
    text = starting_spec(inspect(path), path).text
    assert "  # - resting   # is constant up to rounding\n" in text
    assert all(f"  - {{key: {key}, differences: true}}\n" in text for key in ("half", "place", "distance"))


def features(key: str, differences: bool = False, demos: Demonstrations = DEMOS) -> np.ndarray:
    """What networks see of an observation in all steps, [steps, F]."""
    observed = ObservationSpec(key=key, differences=differences)
    encoder = ObservationEncoder([observed], demos.observation_shapes)
    encoder.fit(demos)
    return encoder.inputs(demo.observations for demo in demos).vector.flatten(0, 1).numpy()


def test_the_encoder_only_centres_them() -> None:
    """And differences of what rests in each demonstration, though it differs between them."""
    found = features("resting", differences=True)
    assert found.shape[1] == 8
    assert np.abs(found).max() < 2e-6
    np.testing.assert_allclose(features("half").std(0), [1, 0, 1], atol=1e-5)
    np.testing.assert_allclose(features("distance").std(0), 1, atol=1e-5)
    np.testing.assert_allclose(features("settled", differences=True).std(0), [1, 0], atol=1e-5)


def test_slow_motion_is_no_rounding() -> None:
    """At 1 kHz a metre of float64 moves by micrometres in a step, which is a velocity."""
    steps = np.sin(np.linspace(0, 3, 50))[:, None]
    moving = numbered(({"place": 0.5 + 1e-5 * (steps * n).cumsum(0)}, steps) for n in range(1, 4))
    np.testing.assert_allclose(features("place", True, moving).std(0), 1, atol=1e-5)
