"""Exported controllers act as the original does, with numpy alone and as ONNX."""

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import torch
from command_line import call
from hierarchies import varied
from planted import small_spec
from user_networks import Remembering

import ddco_pyro
import ddco_pyro.exporting as module
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.exporting import TOLERANCE, export, runner
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.model.networks import InputShape, UserNetwork

SHAPES = {"state": (3,), "goal": (2, 2), "camera": (9, 12, 3)}


def make(
    network="mlp",
    counts=(3,),
    emits=("options",),
    camera=False,
    steps=7,
    endings=None,
    built_in=(),
    trunk=None,
    meta_policy=None,
    vectors=True,
    bins=0,
    turns=False,
    std=MappingProxyType({"learn": True}),
    **rollout,
):
    """A run that was never fitted: random weights, observations with a mean and a spread.

    :param camera: whether there are pictures, or how they are cut.
    """
    policy = network if isinstance(network, dict) else {"network": network}
    levels = [
        {"name": f"level-{d}", "count": k, "policy": policy | ({"emits": list(emits)} if d else {})}
        for d, k in enumerate(counts)
    ]
    turned = [{"angles": [1]}, {"quaternions": [0]}] if turns else [{}, {}]
    state, goal = ({"key": key} | own for key, own in zip(("state", "goal"), turned, strict=True))
    own = {"differences": True, "bins": bins}
    seen = [state | own, goal, *built_in] if vectors else []
    pictures = [{"key": "camera", **(camera if isinstance(camera, dict) else {})}] if camera else []
    endings = endings or {"network": network if network in ("conv", "per_timestep") else "linear"}
    hierarchy = {
        "trunk": trunk,
        "levels": [level | {"termination": endings} for level in levels],
        "meta_policy": (meta_policy or policy) | {"emits": list(emits)},
    }
    model = {"hierarchy": hierarchy} if counts else {}
    observations, control = [*seen, *pictures], {"std": dict(std)}
    spec = small_spec(counts, policy, observations=observations, control=control, rollout=rollout, **model)
    torch.manual_seed(1)
    hierarchy = Hierarchy(spec, Dimensions(SHAPES, 2, steps))
    hierarchy.encoder.mean.uniform_(-3, 3)
    hierarchy.encoder.std.uniform_(0.5, 2)
    hierarchy.encoder.mean[3:6] = 0  # of the differences: it goes to and fro
    if bins:
        own = slice(6, 6 * (1 + bins))
        hierarchy.encoder.low[own].uniform_(-3, 1)
        hierarchy.encoder.high[own] = hierarchy.encoder.low[own] + 2
    hierarchy.scaling.scale.copy_(torch.tensor([10.0, 0.3]))
    hierarchy.scaling.shift.copy_(torch.tensor([-4.0, 1.0]))
    return Fit(spec, varied(hierarchy).eval())


def observe(random):
    """A random observation."""
    seen = {key: random.normal(size=shape) for key, shape in SHAPES.items()}
    return seen | {"camera": random.integers(0, 256, SHAPES["camera"], dtype=np.uint8)}


CONVOLUTIONS = {
    "network": "conv",
    "inputs": ["camera", "state"],
    "layers": [{"filters": 3, "kernel": 4, "stride": 2, "padding": 1}, {"filters": 2, "kernel": 3}],
    "activation": "elu",
    "pool": "spatial_softmax",
}
LEAKY = {
    "network": "conv",
    "layers": [{"filters": 2, "kernel": 5, "stride": 2, "padding": 2}],
    "pool": "flatten",
    "activation": "leaky_relu",
    "standardize": True,
}
RECURRENT = {"network": "lstm", "over": {"hidden": [6]}, "hidden": [5, 4]}
BRANCHES = {
    "network": "branches",
    "of": {
        "camera": {"network": "lstm", "over": LEAKY, "hidden": [4, 3], "horizon": 3},
        "pair": {"network": "mlp", "inputs": ["goal", "state"], "hidden": [6], "activation": "tanh"},
        "state": {"network": "lstm", "hidden": 3},
        "step": {"network": "linear"},
    },
    "hidden": [7],
}
SMALL = {"camera": {"resize": [7, 6]}, "built_in": ("step",)}
BOTH = ("options", "control")
AFTER = {"network": "linear", "inputs": ["step", "goal"]}
OVER = {"network": "lstm", "over": CONVOLUTIONS}
FITS = {
    "linear": make("linear", options="most_likely"),
    "mlp": make("mlp", control="sample", options="sample"),
    "constant": make("constant", (2, 3), BOTH, camera=True, vectors=False, endings={"network": "constant"}),
    "per_timestep": make("per_timestep", steps=30),
    "bins": make("mlp", bins=4),
    "angles and quaternions": make("mlp", turns=True),
    "conv": make("conv", camera={"crop": [1, 2, 7, 9], "resize": [6, 8]}, options="sample"),
    "hybrid": make("mlp", (2, 3), BOTH, control="sample"),
    "σ of the state": make("mlp", (2, 3), BOTH, std={"learn": True, "per_state": True}, control="sample"),
    "three levels": make("mlp", (2, 3, 2), BOTH),
    "mixture": make("mlp", (3,), BOTH, endings="always", control="sample", options="sample"),
    "memoryless below": make("mlp", (2, 3), endings="always", options="marginal"),
    "flat": make("mlp", (), built_in=("step",)),
    "lstm": make(RECURRENT, (2, 2), BOTH, endings=RECURRENT, control="sample"),
    "lstm over pictures": make(OVER, camera=True, endings=CONVOLUTIONS, steps=30, options="sample"),
    "trunk": make("mlp", (2, 3), BOTH, trunk=BRANCHES, options="sample", **SMALL),
    "branches": make(BRANCHES, (2, 3), BOTH, endings={"network": "linear", "inputs": ["state"]}, **SMALL),
    "pictures alone": make(LEAKY, camera=True, endings=LEAKY, vectors=False, options="sample"),
    "several convolutions": make(CONVOLUTIONS, camera=True, endings=AFTER, built_in=("step",)),
}

PROGRAMS = ("trunk", "conv", "lstm", "branches", "σ of the state", "per_timestep", "constant")
"""The first has convolutions, LSTMs, perceptrons and linear networks, together."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name != PROGRAMS[0] else ()) for name in PROGRAMS]
)
def test_every_form_acts_as_the_controller_does(name, tmp_path):
    """On other observations than it was compared on when written, past the longest demonstration."""
    forms(name, tmp_path, ["numpy", "onnx"])


@pytest.mark.parametrize("name", [name for name in FITS if name != PROGRAMS[0]])
def test_numpy_acts_as_the_controller_does(name, tmp_path):
    forms(name, tmp_path, ["numpy"])


def forms(name, folder, expected):
    """Export and compare each form."""
    fit, found = FITS[name], export(FITS[name], folder, "onnx" in expected)
    assert list(found) == expected
    assert all(difference < TOLERANCE for difference, _ in found.values())
    for form in found:
        active = compare(runner.Runner(folder, form), fit.controller(), fit.hierarchy.steps + 4)
        assert len(active) > 1 or name == "flat"


def compare(exported, original, steps):
    """Act with both; the choices that were active."""
    random, active = np.random.default_rng(3), set()
    for seed in range(4):
        exported.reset(seed)
        original.reset(seed)
        for _ in range(steps):
            seen = observe(random)
            difference = np.abs(exported.act(seen) - original.act(seen))
            assert (difference < TOLERANCE * np.array([10.0, 1.0])).all()
            assert exported.choices == original.choices
            assert exported.terminations == pytest.approx(original.terminations, abs=1e-6)
            active.add(original.choices)
    return active


@pytest.fixture(scope="module")
def exported(toy_run, tmp_path_factory):
    """The folder that the command wrote, and how it ended."""
    folder = tmp_path_factory.mktemp("exported") / "controller"
    return folder, call("export", toy_run.folder, "--out", folder, "--onnx")


def test_the_command_says_how_well_each_form_does(exported):
    folder, ended = exported
    assert ended.status == 0, ended.err
    *lines, last = ended.out.splitlines()
    for line, form in zip(lines, ("numpy", "onnx"), strict=True):
        assert line.startswith(f"{form}: largest difference ")
    assert last == f"{folder}: try it with: python {folder / 'runner.py'} {folder}"
    names = {"controller.json", "controller.onnx", "weights.npz", "check.npz", "runner.py"}
    assert {path.name for path in folder.iterdir()} == names


ALONE = """
import sys
import runner
form, sys.argv = sys.argv[1], ["runner.py", ".", sys.argv[1]]
try:
    runner.main()
except SystemExit as ended:
    assert ended.code == 0
needed = {"numpy": None, "onnx": "onnxruntime"}[form]
assert not {"torch", "onnxruntime", "pyro", "ddco_pyro"} .difference({needed}) & set(sys.modules)
"""


def test_the_runner_is_one_file_in_which_nothing_is_missing(exported):
    folder, _ = exported
    linter = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F,E402", folder / "runner.py"]
    assert subprocess.run(linter, capture_output=True, text=True).stdout == "All checks passed!\n"


@pytest.mark.parametrize("form", ["numpy", "onnx"])
def test_each_form_runs_without_this_library(exported, form):
    folder, _ = exported
    ended = subprocess.run([sys.executable, "-c", ALONE, form], cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("largest difference: ")


TEXT = {"offsets": np.array(list("abcd")), "visited": np.zeros(1)}


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"visited": np.zeros(1)}, r"the observation has no 'offsets' \(it has: visited\)"),
        ({"offsets": np.zeros(3), "visited": np.zeros(1)}, r"'offsets' has shape \(3,\), the demonst"),
        ({"offsets": np.full(4, np.nan), "visited": np.zeros(1)}, "'offsets' is not finite"),
        (TEXT, "'offsets' is <U1, it has to be numbers"),
    ],
)
def test_both_refuse_the_same_observations(exported, toy_run, observation, message):
    folder, _ = exported
    for controller in (runner.Runner(folder), ddco_pyro.load(toy_run.folder).controller()):
        with pytest.raises(ValueError, match=message):
            controller.act(observation)


# --- what acts otherwise ------------------------------------------------------------------------------------


@contextmanager
def edited_numpy(folder):
    with np.load(folder / "weights.npz") as file:
        weights = {name: file[name] for name in file.files}
    yield weights
    np.savez(folder / "weights.npz", **weights)


def damage_numpy(folder, tensor="networks.caller_0.layers.0.bias", by=1e-3):
    with edited_numpy(folder) as weights:
        weights[tensor][-1, :, -1] += by


@pytest.fixture
def damaged(monkeypatch):
    """Damage what was written, on the disk, before it is compared."""
    write = module.write_numpy

    def damaging(damage):
        def writing(fit, folder):
            written = write(fit, folder)
            damage(folder)
            return written

        monkeypatch.setattr(module, "write_numpy", writing)

    return damaging


MANY = make("linear", (200,), options="most_likely")
LONG = make("per_timestep", (), steps=30)


OTHERS, FAR = ".*; with networks", r"1\.0e-03, of 1\.0e-06 that"


@pytest.mark.parametrize(
    ("fit", "tensor", "by", "message"),
    [
        pytest.param(MANY, "caller_0.layers.0.bias", 1e-3, OTHERS, id="policies"),
        pytest.param(MANY, "caller_1.layers.0.bias", np.nan, OTHERS, id="selections"),
        pytest.param(MANY, "end_0.layers.0.bias", 1e-3, OTHERS, id="terminations"),
        pytest.param(LONG, "caller_0.layers.1.bias", 1e-3, FAR, id="steps"),
    ],
)
def test_every_network_of_every_option_and_step_is_compared(fit, tensor, by, message, tmp_path, damaged):
    """Though of 200 options most are active in no step, and of 30 steps' networks the last alone differs."""
    damaged(lambda folder: damage_numpy(folder, f"networks.{tensor}", by))
    with pytest.raises(Failed, match=rf"^nothing was written: as numpy it differs from the run by {message}"):
        export(fit, tmp_path / "out")


def test_a_file_that_cannot_be_loaded_is_not_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_onnx", lambda program: b"no model")
    with pytest.raises(Failed, match=r"^nothing was written: as onnx it cannot be run: \w+: "):
        export(make("linear"), tmp_path / "out", onnx=True)
    assert list(tmp_path.iterdir()) == []


def test_what_was_exported_before_is_replaced_by_what_agrees_alone(tmp_path, damaged):
    out = tmp_path / "out"
    export(make("linear"), out)
    (out / "controller.onnx").write_text("of the last export")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    export(make("mlp"), out)
    after = {path.name: path.read_bytes() for path in out.iterdir()}
    assert before.keys() - after.keys() == {"controller.onnx"}
    assert all(after[name] != before[name] for name in after.keys() - {"runner.py"})
    damaged(damage_numpy)
    with pytest.raises(Failed):
        export(make("linear"), out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == after
    assert list(tmp_path.iterdir()) == [out]


def test_what_else_is_in_a_folder_is_not_lost(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    says = r": holds what was not exported, such as notes\.txt; choose another --out$"
    with pytest.raises(BadInput, match=says):
        export(make("linear"), tmp_path)
    with pytest.raises(BadInput, match=r"notes\.txt: is a file; choose another --out$"):
        export(make("linear"), tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


# --- a user's networks --------------------------------------------------------------------------------------


class Inner(torch.nn.Module):
    """A user's network that is a built-in one, and has float32 written into it."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, inputs):
        return self.network(inputs.map(torch.Tensor.float, inputs.time))[0]


def test_networks_that_numpy_cannot_evaluate_are_compared_as_a_program(tmp_path):
    fit = make("linear")
    fit.hierarchy.meta_policy.network = UserNetwork(Inner(fit.hierarchy.meta_policy.network), 3, 1)
    says = r"networks that numpy cannot evaluate; export it with --out and --onnx$"
    with pytest.raises(BadInput, match=says):
        export(fit, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    assert list(export(fit, tmp_path / "out", onnx=True)) == ["onnx"]
    assert len(compare(runner.Runner(tmp_path / "out", "onnx"), fit.controller(), 10)) > 1
    with pytest.raises(ValueError, match="it has networks that numpy cannot evaluate: use "):
        runner.Runner(tmp_path / "out")


@pytest.mark.parametrize("place", ["network", pytest.param("over", marks=pytest.mark.slow)])
def test_a_users_state_is_carried_by_programs(place, tmp_path):
    fit = make(RECURRENT)
    meta_policy = fit.hierarchy.meta_policy
    if place == "network":
        meta_policy.network = UserNetwork(Remembering(InputShape({"all": 10}), 3, 1), 3, 1)
    else:
        meta_policy.network.over = UserNetwork(Remembering(InputShape({"all": 10}), 6, 1), 6, 1)
    assert list(export(fit, tmp_path / "out", onnx=True)) == ["onnx"]
    assert len(compare(runner.Runner(tmp_path / "out", "onnx"), fit.controller(), 10)) > 1


class Adding(torch.nn.Module):
    """Adds up what it sees: it acts otherwise than it was trained, step by step otherwise than at once."""

    def forward(self, inputs):
        return inputs.vector.cumsum(1)[..., None, :3]


class Branching(torch.nn.Module):
    """What torch.export cannot follow."""

    def forward(self, inputs):
        if inputs.vector.sum() > 0:
            return inputs.vector[..., None, :3]
        return -inputs.vector[..., None, :3]


@pytest.mark.parametrize(
    ("network", "message"),
    [(Adding, "as onnx it differs from the run"), (Branching, r"the networks cannot be exported: \w+: .*$")],
)
def test_networks_that_act_otherwise_or_make_no_program_leave_nothing_behind(network, message, tmp_path):
    fit = make("linear")
    fit.hierarchy.meta_policy.network = UserNetwork(network(), 3, 1)
    with pytest.raises(Failed, match=rf"^nothing was written: {message}"):
        export(fit, tmp_path / "out", onnx=True)
    assert list(tmp_path.iterdir()) == []


# --- how much an exported form may differ: the truth is the same perceptron in float64 ----------------------


HALF = 32


def steep(gain: float) -> Fit:
    """A policy of pairs of hidden units that differ by 1 / gain, of which it takes gain times the difference:
    what float32 rounds in a unit it has gain times.
    """
    fit = perceptron(2 * HALF)
    first, *_, last = fit.hierarchy.meta_policy.network.layers
    with torch.no_grad():
        first.weight[..., HALF:] = first.weight[..., :HALF]
        first.bias[..., HALF:] = first.bias[..., :HALF] + 1 / gain
        last.weight[:, HALF:] = -last.weight[:, :HALF]
        last.weight.mul_(gain)
    return fit


def perceptron(units: int) -> Fit:
    """A policy of one observation, which acts with its mean."""
    spec = small_spec((), {"network": "mlp", "hidden": [units]}, rollout={"control": "mean"})
    torch.manual_seed(2)
    return Fit(spec, Hierarchy(spec, Dimensions({"state": (5,)}, 2, 7)).eval())


def measured(folder: Path) -> float:
    """How far the original's controls are from those of float64: what it says of an episode at once
    (``control_0``), and what it did (``controls``), one step after the other.
    """
    with np.load(folder / "weights.npz") as file:
        parts = [f"{layer}.{part}" for layer in (0, 1) for part in ("weight", "bias")]
        names = [f"networks.caller_0.layers.{part}" for part in parts]
        weight, bias, weight_2, bias_2 = (file[name][0].astype(np.float64) for name in names)
    largest = 0.0
    with np.load(folder / "check.npz") as file:
        for episode in file["seeds"]:
            seen = file[f"observation_{episode}_state"].astype(np.float32).astype(np.float64)
            exact = np.maximum(seen @ weight + bias, 0) @ weight_2 + bias_2
            for name in ("control_0", "controls"):
                found = file[f"{name}_{episode}"].reshape(exact.shape)
                error = np.abs(found - exact) / np.maximum(1, np.abs(exact))
                largest = max(largest, error.max())
    return largest


def allowed(folder: Path) -> float:
    with np.load(folder / "check.npz") as file:
        return float(file["tolerance"])


def test_a_sound_fit_may_differ_by_what_float32_does(tmp_path, capsys, monkeypatch):
    differences = export(steep(40.0), tmp_path, onnx=True)
    assert max(difference for difference, _ in differences.values()) > 1e-6  # which was refused before
    error = measured(tmp_path)
    assert 1e-6 < error < 2.5e-5
    assert allowed(tmp_path) == pytest.approx(4 * error, rel=1e-6)
    monkeypatch.setattr("sys.argv", ["runner.py", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 0
    assert f" of {allowed(tmp_path):.1e} that are allowed; " in capsys.readouterr().out


def test_no_fit_is_so_unsound_that_anything_goes(tmp_path):
    """A hundred thousand times the difference of units: what it says is rounding to 1 %."""
    with pytest.raises(
        Failed, match=r"^nothing was written: .* of 1\.0e-04 that are allowed; the weights are so large"
    ):
        export(steep(1e5), tmp_path / "out")
