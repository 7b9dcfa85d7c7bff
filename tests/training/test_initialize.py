"""Clusters: planted ones are found, and hardly any others scatter less."""

import itertools

import numpy as np
import pytest
import torch
from planted import LINEAR, make_trainer, small_spec
from random_demonstrations import numbered
from sklearn.metrics import adjusted_rand_score

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.networks.conv import POOLED
from ddco_pyro.training.checkpoint import Progress
from ddco_pyro.training.initialization import Clusters, equal_parts
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.stages import plan

LENGTHS = (7, 4, 6)


def make_batch(vector, actions, images=None, lengths=LENGTHS):
    """A batch of [steps, ...] rows, cut into demonstrations; what pads them is far from everything."""
    cuts = np.cumsum(lengths)[:-1]

    def pad(rows, value):
        parts = [torch.as_tensor(part) for part in np.split(rows, cuts)]
        return torch.nn.utils.rnn.pad_sequence(parts, batch_first=True, padding_value=value)

    pictures = {key: pad(rows, 255) for key, rows in (images or {}).items()}
    inputs = Inputs({"state": pad(vector, 1e3).float()}, pictures, torch.arange(max(lengths)))
    return Batch(inputs, pad(actions, 1e3).float(), torch.tensor(lengths))


def alive(choices, lengths=LENGTHS):
    """The choices of every step, padding left out."""
    return np.concatenate([row[:length] for row, length in zip(choices.numpy(), lengths, strict=True)])


def random_rows(seed, columns):
    return np.random.default_rng(seed).normal(size=(sum(LENGTHS), columns))


def test_equal_parts_cut_each_demonstration_for_itself():
    batch = make_batch(random_rows(0, 3), random_rows(1, 2))
    assert equal_parts(batch, 3).tolist() == [
        [1, 1, 1, 2, 2, 3, 3],
        [1, 1, 2, 3, 0, 0, 0],
        [1, 1, 2, 2, 3, 3, 0],
    ]


@pytest.mark.parametrize(("read", "found"), [(["quiet"], "quiet"), ([], "loud")])
def test_what_policies_of_options_do_not_read_does_not_begin_them(read, found):
    """Two observations say different things; gates and meta-policy read both, policies what they name."""
    steps = sum(LENGTHS)
    truth = {"quiet": np.arange(steps) % 2, "loud": np.arange(steps) // 2 % 2}
    rows = {"quiet": truth["quiet"][:, None], "loud": np.repeat(truth["loud"][:, None], 9, axis=1)}
    cuts = np.cumsum(LENGTHS)[:-1]
    parts = {key: np.split(each + 0.01 * random_rows(3, each.shape[1]), cuts) for key, each in rows.items()}
    each = [{key: parts[key][number] for key in parts} for number in range(len(LENGTHS))]
    demos = numbered((one, np.arange(len(one["quiet"]))[:, None]) for one in each)
    training = {"starts": ["vq"], "tune_fraction": 0.3, "optimizer": {"name": "adam"}}
    spec = small_spec(policy=LINEAR | {"inputs": read}, observations=["quiet", "loud"], training=training)
    material = make_trainer(spec, demos, None).data
    objective = Objective(material, Progress(0), plan(spec, 1)[0])
    known = [int(name.removeprefix("demo_")) for name in material.names]
    truths = np.concatenate([np.split(truth[found], cuts)[number] for number in known])
    begun = alive(objective.known[0][1], [LENGTHS[number] for number in known])
    assert adjusted_rand_score(truths, begun) == 1


FEW = (3, 2, 4)


def scatter(rows, labels):
    """The sum of squared distances of the rows to the means of their clusters, which k-means makes small."""
    return sum(((rows[labels == k] - rows[labels == k].mean(0)) ** 2).sum() for k in np.unique(labels))


def assert_k_means(rows, choices, clusters):
    """Every row is nearest to its own cluster's mean, and no way to part the rows scatters much less (k-means
    tries ten starts and finds the best or nearly so).
    """
    means = np.stack([rows[choices == k].mean(0) for k in range(1, clusters + 1)])
    np.testing.assert_array_equal(np.linalg.norm(rows[:, None] - means, axis=-1).argmin(1) + 1, choices)
    every = (np.array((0, *rest)) for rest in itertools.product(range(clusters), repeat=len(rows) - 1))
    assert scatter(rows, choices) <= 1.05 * min(scatter(rows, labels) for labels in every)


def few_rows(seed, columns):
    return np.random.default_rng(seed).normal(size=(sum(FEW), columns)).astype(np.float32)


@pytest.mark.parametrize("seed", range(2))
def test_clusters_are_k_means_of_observations_and_weighted_controls(seed):
    vector, actions = few_rows(seed, 8), few_rows(seed + 10, 1)
    batch = make_batch(vector, actions, lengths=FEW)
    choices = Clusters(batch, 3, seed).choices(batch)
    assert (choices[torch.arange(4) >= torch.tensor(FEW)[:, None]] == 0).all()  # padding belongs to none
    assert_k_means(vector, alive(choices, FEW), 3)
    choices = alive(Clusters(batch, 3, seed, controls=True).choices(batch), FEW)
    assert_k_means(np.hstack([vector, np.sqrt(8) * actions]), choices, 3)


def test_images_are_seen_as_block_means():
    """Mean brightness of each block of 2 × 3 pixels, by hand, in [0, 1]; beside it the vector."""
    random = np.random.default_rng(8)
    images = random.integers(0, 256, (sum(FEW), 2 * POOLED, 3 * POOLED, 3), dtype=np.uint8)
    vector, actions = few_rows(9, 2), few_rows(10, 2)
    batch = make_batch(vector, actions, {"camera": images}, FEW)
    blocks = images.reshape(-1, POOLED, 2, POOLED, 3, 3).mean((2, 4)) / 255
    rows = np.hstack([vector, blocks.reshape(len(blocks), -1)])
    choices = alive(Clusters(batch, 3, seed=0).choices(batch), FEW)
    assert_k_means(rows, choices, 3)


@pytest.mark.filterwarnings("error")
def test_there_are_no_more_clusters_than_distinct_observations():
    place = np.arange(sum(LENGTHS)) % 3
    corners = np.array([[0.0, 0.0, 4.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    batch = make_batch(corners[place], random_rows(1, 2))
    assert adjusted_rand_score(place, alive(Clusters(batch, 5, seed=0).choices(batch))) == 1
    assert set(alive(Clusters(batch, 5, seed=0, controls=True).choices(batch))) == {1, 2, 3, 4, 5}


def test_further_restarts_have_other_clusters_than_the_best_of_ten():
    """Nine heaps: ten runs of k-means find them whatever the seed, a single one from random steps others."""
    random = np.random.default_rng(1)
    heaps = 3.0 * np.stack(np.meshgrid(range(3), range(3)), -1).reshape(9, 2)
    places = heaps[random.integers(0, 9, 240)] + 0.1 * random.normal(size=(240, 2))
    demos = numbered(({"state": rows}, 0.1 * random.normal(size=(40, 1))) for rows in np.split(places, 6))
    spec = small_spec((9,), training={"starts": ["vq"] * 6, "optimizer": {"name": "adam"}})
    data = make_trainer(spec, demos, None).data

    def clusters(restart):
        return Objective(data, Progress(restart), plan(spec, 1)[0]).known[0][1].flatten()

    one = Clusters(data.train, 9, 5, read=("state",)).choices(data.train).flatten()
    best = clusters(0)
    assert adjusted_rand_score(one, best) > 0.99  # another seed
    assert min(adjusted_rand_score(best, clusters(number)) for number in range(1, 6)) < 0.9
