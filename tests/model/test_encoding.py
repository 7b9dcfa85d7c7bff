"""Features, scaled controls and batches against numpy and scipy."""

import numpy as np
import pytest
import torch
from planted import small_spec
from scipy import stats
from sklearn.preprocessing import QuantileTransformer

from ddco_pyro.data.controls import all_gaussian
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.inference import log_likelihood
from ddco_pyro.model.batch import encode
from ddco_pyro.model.controls import ControlScaling
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.spec import ControlSpec, ObservationSpec

LENGTHS = (5, 3, 4)
SHAPES = {"pose": (3,), "grid": (2, 2), "camera": (6, 4, 3)}


def make_demonstrations():
    """Three demonstrations far from mean 0 and standard deviation 1; ``pose[1]`` never changes."""
    random = np.random.default_rng(0)
    records = []
    for number, steps in enumerate(LENGTHS):
        pose = random.normal([100, 0, -3], [7, 0, 0.01], (steps, 3))
        pose[:, 1] = 0.3
        observations = {
            "pose": pose,
            "grid": random.normal(2, 5, (steps, 2, 2)),
            "camera": random.integers(0, 256, (steps, 6, 4, 3), dtype=np.uint8),
        }
        large, small = random.normal(40, 9, steps), random.normal(0, 1e-3, steps)
        actions = np.column_stack([large, np.full(steps, 2.5), small])
        records.append(Demonstration(f"demo_{number}", observations, actions))
    return Demonstrations(tuple(records))


DEMOS = make_demonstrations()


def fitted(*specs):
    encoder = ObservationEncoder(specs, SHAPES)
    encoder.fit(DEMOS)
    return encoder


def alive(vector):
    """The steps that are not padding, one after another."""
    return np.concatenate([vector[n, :length].numpy() for n, length in enumerate(LENGTHS)])


def rows(key, change=lambda values: values):
    """An observation of all steps, after a change within each demonstration."""
    return np.concatenate([change(demo.observations[key].reshape(len(demo), -1)) for demo in DEMOS])


def test_features_are_standardised_with_differences_behind_their_observation():
    """Over all steps; differences begin with 0. What never changes is only centred; it moves in its units."""
    encoder = fitted(ObservationSpec(key="pose", differences=True), ObservationSpec(key="grid"))
    found = encoder.inputs(demo.observations for demo in DEMOS).vector
    differences = rows("pose", lambda values: np.diff(values, axis=0, prepend=values[:1]))
    raw = np.hstack([rows("pose"), differences, rows("grid")])
    spread = np.where(np.ptp(raw, axis=0) > 0, raw.std(0), 1)
    np.testing.assert_allclose(alive(found), (raw - raw.mean(0)) / spread, atol=1e-5)
    other = {"pose": np.array([[100.0, 0.8, -3.0]]), "grid": np.zeros((1, 2, 2))}
    np.testing.assert_allclose(encoder.inputs([other]).vector[0, 0, 1], 0.5, rtol=1e-6)


@pytest.mark.parametrize("key", ["pose", "grid"])
def test_bins_add_up_to_quantiles(key):
    """How far each number has come through all of its parts together is scikit-learn's quantile transform,
    where quantiles are values that there are.
    """
    bins, raw = sum(LENGTHS) - 1, rows(key)
    encoder = fitted(ObservationSpec(key=key, bins=bins))
    seen = alive(encoder.inputs(demo.observations for demo in DEMOS).vector).astype(float)
    width, own = raw.shape[1], slice(raw.shape[1], None)
    plain = fitted(ObservationSpec(key=key)).inputs(demo.observations for demo in DEMOS)
    np.testing.assert_allclose(seen[:, :width], alive(plain.vector))
    cut = seen * encoder.std.numpy() + encoder.mean.numpy()
    low, high = encoder.low.numpy()[own], encoder.high.numpy()[own]
    through = (cut[:, own] - low) / np.where(high > low, high - low, 1)
    expected = QuantileTransformer(n_quantiles=bins + 1, subsample=None).fit_transform(raw)
    expected[:, np.ptp(raw, axis=0) == 0] = 0  # it never changes
    np.testing.assert_allclose(through.reshape(len(raw), bins, width).mean(1), expected, atol=1e-5)
    np.testing.assert_allclose(seen.mean(0), 0, atol=1e-5)
    varies = np.tile(np.ptp(raw, axis=0) > 0, 1 + bins)
    np.testing.assert_allclose(seen.std(0), np.where(varies, 1, 0), atol=1e-5)


def test_a_value_that_most_steps_have_is_one_value_of_a_part():
    """What is 0 but for a few steps, as the shape of what is seen at times, has its parts where it is not."""
    random = np.random.default_rng(0)
    area = np.where(random.random((200, 1)) < 0.9, 0.0, random.random((200, 1)) * 100)
    encoder = ObservationEncoder([ObservationSpec(key="area", bins=4)], {"area": (1,)})
    encoder.fit(Demonstrations((Demonstration("demo_0", {"area": area}, np.zeros((200, 1))),)))
    different = np.unique(area)
    ends = encoder.low[1:].numpy(), encoder.high[1:].numpy()
    parts = [((different >= low) & (different < high)).sum() for low, high in zip(*ends, strict=True)]
    np.testing.assert_allclose(parts, (len(different) - 1) / 4, atol=1)


def test_a_part_that_holds_one_value_alone_is_only_centred():
    """Of two values, one of five parts has them at its ends, and others are of one; of one value, all are."""
    jaw = np.column_stack([np.arange(40) % 2, np.ones(40)])
    encoder = ObservationEncoder([ObservationSpec(key="jaw", bins=5)], {"jaw": (2,)})
    encoder.fit(Demonstrations((Demonstration("demo_0", {"jaw": jaw}, np.zeros((40, 1))),)))
    seen = encoder.inputs([{"jaw": jaw}]).vector[0].numpy()
    parts = seen[:, 2:].reshape(len(jaw), 5, 2)
    np.testing.assert_allclose(np.sort(parts.std(0), axis=0), [[0, 0]] * 4 + [[1, 0]], atol=1e-6)


def test_the_step_is_a_part_of_the_longest_training_demonstration():
    encoder = fitted(ObservationSpec(key="pose"), ObservationSpec(key="step"))
    found = encoder.inputs(demo.observations for demo in DEMOS)
    assert list(found.vectors) == ["pose", "step"]
    steps = (found.vectors["step"][..., 0].double() * encoder.std[-1] + encoder.mean[-1]).numpy()
    np.testing.assert_allclose(steps[0], np.arange(5) / 5, atol=1e-6)
    np.testing.assert_allclose(steps[1, :3], np.arange(3) / 5, atol=1e-6)
    assert "step" not in encoder.shapes  # nothing has to be observed for it


def batch():
    encoder = fitted(ObservationSpec(key="pose"), ObservationSpec(key="camera"))
    scaling = ControlScaling(ControlSpec(), 3, {}, all_gaussian(range(3)))
    return encode(DEMOS, encoder, scaling)


def test_batches_are_padded_with_zeros_and_images_stay_bytes():
    found = batch()
    assert (len(found), found.steps, found.lengths.tolist()) == (3, 12, [5, 3, 4])
    assert found.inputs.time.tolist() == [0, 1, 2, 3, 4]
    seen = found.inputs.loaded().images["camera"]
    assert (found.inputs.vector.shape, seen.dtype) == ((3, 5, 3), torch.uint8)
    for n, demo in enumerate(DEMOS):
        np.testing.assert_array_equal(seen[n, : len(demo)], demo.observations["camera"])
        np.testing.assert_allclose(found.actions[n, : len(demo)], demo.actions, rtol=1e-6)
        for padded in (found.inputs.vector, seen, found.actions):
            assert padded.shape[:2] == (3, 5)
            assert not padded[n, len(demo) :].any()


def test_the_density_is_in_the_controls_own_units():
    """log p(a) of a flat policy against scipy's Gaussian of a, its moments carried over to a's units."""
    spec = small_spec((), observations=["pose"], control={"std": 0.2})
    torch.manual_seed(0)
    hierarchy = Hierarchy(spec, Dimensions(SHAPES, 3, 5))
    hierarchy.encoder.fit(DEMOS)
    hierarchy.scaling.fit(DEMOS)
    encoded = encode(DEMOS, hierarchy.encoder, hierarchy.scaling)
    with torch.no_grad():
        found = log_likelihood(hierarchy.tabulate(encoded), encoded.lengths)
        mean = hierarchy.scaling.emitted(hierarchy(encoded.inputs).emissions[0].mean[:, :, 0])
    std = 0.2 * hierarchy.scaling.scale.numpy()
    expected = [
        stats.norm.logpdf(demo.actions, mean[n, : len(demo)], std).sum() for n, demo in enumerate(DEMOS)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
