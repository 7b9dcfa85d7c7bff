"""Labels of a few demonstrations say which options are active, and name them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from command_line import call, done
from oracle import brute_force, paths
from planted import (
    CONTROL,
    LINEAR,
    in_units_of,
    make_spec,
    make_trainer,
    make_truth,
    plant,
    small_spec,
    tabulated,
)
from random_demonstrations import numbered
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.evaluation.inferred import infer
from ddco_pyro.evaluation.verdicts import contributions
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.model.batch import encode
from ddco_pyro.report import write_report
from ddco_pyro.spec import SpecError
from ddco_pyro.training.checkpoint import Progress
from ddco_pyro.training.initialization import Clusters
from ddco_pyro.training.loop import backward
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.recognition import chosen as best_of
from ddco_pyro.training.restarts import Trainer
from ddco_pyro.training.stages import plan

STEPS = 3
LABELS = [[5, -1, -1], [-1, 9, 5], [-1, -1, 9], [-1, -1, -1], [9, 9, -1]]


def random_demonstrations(labels=LABELS):
    random = np.random.default_rng(0)

    def one(phase):
        state, actions = random.normal(size=(2, len(phase), 2))
        return {"state": state}, 0.1 * actions, {"phase": np.array(phase)}

    return numbered(map(one, labels))


def labelled(level=1, counts=(2,), training=(), **own):
    """A spec whose training uses labels."""
    return make_spec(counts, labels={"level": f"level-{level}", "from": "phase", **own}, **dict(training))


def make(spec, demos):
    """What restarts are trained on."""
    return Trainer(spec, Dimensions.of(demos), *demos.split(0.2, 0)).data


def whole(material):
    """What is maximised in the last stage."""
    return Objective(material, Progress(0), plan(material.spec, len(material.spec.hierarchy.levels))[-1])


def options(labels):
    """Those of :data:`LABELS`: 5 is option 1, 9 is option 2."""
    return [{5: 1, 9: 2}.get(label, -1) for label in labels]


# --- what is maximised --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("counts", "level"), [((2,), 1), ((2, 2), 1), ((2, 2), 2)])
def test_it_is_the_likelihood_of_the_paths_that_have_the_labels(counts, level):
    """Against the sum over all paths, one after another."""
    demos = random_demonstrations(LABELS[: 5 if len(counts) == 1 else 3])
    material = make(labelled(level, counts), demos)
    model = material.hierarchy(0)
    objective = whole(material)
    values = {}
    for name, batch in (("train", material.train), ("tune", material.tune)):
        names = material.names if name == "train" else [n for n in demos.names if n not in material.names]
        with torch.no_grad():
            tables = model(batch.inputs).tables(batch.actions)
        values[name] = 0.0
        for n, demo in enumerate(demos.select(names)):
            known = options(demo.labels["phase"].tolist())
            every = paths(tables, n, STEPS, [1 + count for count in counts])
            total = sum(
                probability
                for path, _, probability in every
                if all(option in (-1, h[level - 1]) for option, h in zip(known, path, strict=True))
            )
            values[name] += math.log(total)
    assert backward(objective, model, [*material.train.pieces()]) == pytest.approx(values["train"], abs=1e-5)
    assert objective.tune(model) == pytest.approx(values["tune"] / STEPS, abs=1e-5)


def test_the_label_wins_over_the_cluster():
    first = [[7, -1, 3, 3], [-1, 3, -1, -1], [3, 7, 7, -1]]
    demos = random_demonstrations([*first, [-1, -1, -1, 7], [7, -1, -1, -1]])
    material = make(labelled(), demos)
    objective = Objective(material, Progress(0), plan(material.spec, 1)[0])
    names_of = (material.names, set(demos.names) - set(material.names))
    for known, names in zip(objective.known, names_of, strict=True):
        for choices, demo in zip(known[1].tolist(), demos.select(names), strict=True):
            for choice, label in zip(choices, demo.labels["phase"].tolist(), strict=True):
                assert choice == {3: 1, 7: 2}.get(label, choice)
                assert choice in (1, 2)


# --- which labels are used ----------------------------------------------------------------------------------


MANY = r"labels/phase has 3 labels from 0 on \(0, 1, 2\), but level 'level-1' has 2 options"
NONE = "labels/phase is -1 at every step of the demonstrations to train with"


@pytest.mark.parametrize(
    ("labels", "message"), [([[0, 1, 2], [0, 1, 2]], MANY), ([[-1, -1], [-1, -1]], NONE)]
)
def test_labels_that_cannot_be_used_are_one_line(labels, message):
    demos = random_demonstrations(labels)
    with pytest.raises(SpecError, match=message) as caught:
        make(labelled(), demos)
    assert "\n" not in str(caught.value)


# --- clusters -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_the_clusters_of_labelled_options_start_from_their_steps(order):
    """Three places far apart; a step of each has a label, or of two of them: then the third cluster is 3."""
    places = np.array([[0.0, 9.0], [9.0, 0.0], [0.0, 0.0]])
    truth = np.arange(12) % 3
    states = places[truth] + 0.1 * np.random.default_rng(0).normal(size=(12, 2))
    numbers = np.array(order) + 1
    for known in (3, 2):
        labels = np.where((np.arange(12) < 3) & (numbers[truth] <= known), numbers[truth], -1)
        np.testing.assert_array_equal(clustered(states, 3, labels), numbers[truth])


def test_labels_of_every_option_name_the_other_steps():
    """Two options side by side along a way that both have gone: being nearest to a mean says little."""
    random, truth = np.random.default_rng(0), np.arange(400) % 3 + 1
    along = random.uniform(-10, 10, 400)
    states = np.column_stack(
        [along, np.select([truth == 1, truth == 2], [0.0, 1.0], 9.0) + 0.1 * random.normal(size=400)]
    )
    labels = np.where((along > 0) | (np.arange(400) > 200), -1, truth)  # of the near half of the first ones
    # and of a few others, so that the means are apart along the way
    labels[np.flatnonzero(truth == 2)[:3]] = 2
    means = np.stack([states[labels == option].mean(0) for option in (1, 2, 3)])
    nearest = np.linalg.norm(states[:, None] - means, axis=-1).argmin(1) + 1
    assert (nearest == truth).mean() < 0.9
    assert (clustered(states, 3, labels) == truth).mean() > 0.99
    some = np.where(labels == 3, -1, labels)
    assert len(np.unique(clustered(states, 3, some))) == 3


def clustered(states, count, labels):
    """The clusters of the steps of one demonstration, of which some have labels."""
    model = make_truth(make_spec((2,)))
    batch = encode(numbered([({"state": states}, states)]), model.encoder, model.scaling)
    return Clusters(batch, count, seed=0, labels=torch.tensor([list(labels)])).choices(batch)[0].numpy()


# --- a recogniser of labelled steps -------------------------------------------------------------------------

RECOGNISER = {"weight": 0.7, "ridge": 3.0}
WIDTHS = 1, 2
"""Of its windows: most labelled segments have two steps."""


def window(rows, width, past=False):
    """Means over windows that are cut at the ends, one after another."""
    ends = [t + 1 + (0 if past else width) for t in range(len(rows))]
    return np.stack([rows[max(t - width, 0) : end].mean(0) for t, end in enumerate(ends)])


def features(demo, mean=None):
    """Those of a demonstration, not standardised; of the past with the mean of controls before the first."""
    past = mean is not None
    actions = np.concatenate([mean[None], demo.actions[:-1]]) if past else demo.actions
    rows = np.concatenate([demo.observations["state"], actions], axis=1)
    return np.concatenate([rows, *(window(rows, width, past) for width in WIDTHS)], axis=1)


@pytest.fixture(scope="module")
def recognised():
    """Demonstrations, some with labels of two of three options, and a trainer with a recogniser of them."""
    random = np.random.default_rng(3)
    phases = [[5, 5, -1, 9, 9], [-1] * 4, [9, 9, 5, 5, 5, -1], [-1] * 5, [5, 9, 5], [-1] * 6]

    def one(phase):
        state, actions = random.normal(size=(2, len(phase), 2))
        return {"state": state + np.array(phase)[:, None] / 5}, actions, {"phase": np.array(phase)}

    demos = numbered(map(one, phases))
    spec = labelled(counts=(3,), training={"seed": 1, "epochs": 2}, recogniser=RECOGNISER)
    return demos, make_trainer(spec, demos, None)


def recogniser_of_sklearn(demos, mean=None):
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    known = [demo for demo in demos if (demo.labels["phase"] >= 0).any()]
    rows, labels = (
        np.concatenate([part[demo.labels["phase"] >= 0] for demo, part in zip(known, each, strict=True)])
        for each in ([features(demo, mean) for demo in known], [demo.labels["phase"] for demo in known])
    )
    regression = LogisticRegression(C=1 / RECOGNISER["ridge"], max_iter=500)
    return make_pipeline(StandardScaler(), regression).fit(rows, labels), np.array(
        [(labels == 5).mean(), (labels == 9).mean()]
    )


@pytest.mark.parametrize("past", [False, True])
def test_it_is_the_regression_of_scikit_learn_on_windows(recognised, past):
    demos, trainer = recognised
    model = trainer.hierarchy
    mean = model.scaling.shift.numpy() if past else None
    truth, share = recogniser_of_sklearn(demos, mean)
    batch = encode(demos, model.encoder, model.scaling)
    windows = model.recogniser.past if past else model.recogniser.around
    ratio = windows.log_ratio(windows.features(batch.inputs, batch.actions, batch.lengths))
    for demo, own in zip(demos, ratio.numpy(), strict=True):
        expected = np.maximum(truth.predict_log_proba(features(demo, mean)), -12) - np.log(share)
        np.testing.assert_allclose(own[: len(demo), 1:3], expected, atol=1e-4)
        # of control, and of the option without labels
        np.testing.assert_array_equal(own[: len(demo), [0, 3]], 0.0)


def test_evidence_is_a_factor_of_every_path(recognised):
    """Against the sum over all paths, and Pyro's program with factors; the log-likelihood has no evidence."""
    demos, trainer = recognised
    model = trainer.hierarchy
    (piece,) = infer(model, demos.select(["demo_1", "demo_4"]))
    assert float(piece.tables.evidence[0].abs().max()) > 0.1
    for n, length in enumerate(piece.lengths):
        truth = brute_force(piece.tables, n, length)
        np.testing.assert_allclose(piece.posterior.u[0][n, :length].numpy(), truth.u[0], atol=1e-9)
        for engine in ("fused", "enumerate"):
            found = log_likelihood(piece.tables, piece.batch.lengths, engine)[n]
            assert float(found) == pytest.approx(truth.log_likelihood, abs=1e-6)
        path = max(paths(piece.tables, n, length, [4]), key=lambda one: one[2])
        assert piece.path.choices[0][n, :length].tolist() == [h for (h,) in path[0]]
        alone = brute_force(model.tabulate(piece.batch), n, length).log_likelihood
        assert piece.log_likelihood[n] == pytest.approx(alone, abs=1e-6)


def test_a_recogniser_places_what_labels_alone_do_not(tmp_path):
    """Two skills alike at every single step, at places that differ by person: only what is around tells."""
    random = np.random.default_rng(0)

    def one(number):
        phase = np.repeat([0, 1, 0, 1], random.integers(12, 18, 4))
        waves = np.sin(np.arange(len(phase)) * np.where(phase, 2.4, 0.3))[:, None]
        fast = waves + random.normal(size=(len(phase), 1))
        drift = np.where(phase, 1.0, -1.0)[:, None] + 1.5 * random.normal(size=(len(phase), 1))
        known = phase if number < 3 else np.full_like(phase, -1)
        return (
            {"state": np.hstack([drift, fast])},
            random.normal(size=(len(phase), 2)),
            {"phase": phase, "known": known},
        )

    demos = numbered(one(number) for number in range(14))
    train, held_out = demos.select(demos.names[:10]), demos.select(demos.names[10:])
    found = {}
    for name, own in {"clamped": None, "recogniser": "cross_validated"}.items():
        labels = {"level": "level-1", "from": "known", **({"recogniser": own} if own else {})}
        training = {"optimizer": {"name": "em"}, "labels": labels, "epochs": 40}
        read = {"path": "unused.hdf5", "labels": "phase"}
        compared = ["mixture"] if own else []
        spec = small_spec((2,), training=training, demonstrations=read, compare_with=compared)
        fit = ddco_pyro.fit(spec, train, out=tmp_path / name)
        paths = [*fit.segment(held_out)[0]]
        truth = [demo.labels["phase"] + 1 for demo in held_out]
        found[name] = np.mean(np.concatenate(paths) == np.concatenate(truth))
    assert found["recogniser"] > 0.9
    assert found["recogniser"] > found["clamped"] + 0.1
    again = ddco_pyro.load(tmp_path / "recogniser")
    chosen = again.metrics.training.recogniser
    assert (chosen.power, chosen.weight, chosen.ridge) == best_of(chosen.tried)
    assert float(again.hierarchy.power) == chosen.power
    assert float(again.hierarchy.recogniser.gamma) == chosen.weight
    for own, other in zip(fit.segment(held_out)[0], again.segment(held_out)[0], strict=True):
        np.testing.assert_array_equal(own, other)
    mixture = again.baselines["mixture"]
    shared = mixture.spec.training.labels.recogniser
    used = (mixture.spec.control.power, shared.weight, shared.ridge)
    assert used == (chosen.power, chosen.weight, chosen.ridge)
    assert float(mixture.hierarchy.recogniser.gamma) == chosen.weight
    said = contributions(again.metrics.training)
    assert max(map(sum, said.values())) == sum(said["labels, recogniser and policies, as chosen"])
    page = write_report(again, again.demonstrations).read_text()
    assert f"<td>labels alone</td><td>{said['labels alone'][0]:.2f}</td>" in page
    row = again.metrics.agreement.recogniser["train"]
    assert f"<td>recogniser alone, training</td><td>{row.nmi:.2f}</td>" in page


def test_a_recogniser_reads_pictures():
    """Planted: the brighter half of a noisy picture is the active option; two demonstrations tell it."""
    random = np.random.default_rng(5)

    def one(number):
        phase = np.repeat([0, 1, 0], random.integers(6, 10, 3))
        side = np.arange(16) // 8 == phase[:, None, None, None]
        camera = random.integers(0, 128, (len(phase), 8, 16, 1)) + 60 * side.transpose(0, 1, 3, 2)
        seen = {"state": random.normal(size=(len(phase), 2)), "camera": camera.astype(np.uint8)}
        known = phase if number < 2 else np.full_like(phase, -1)
        return seen, random.normal(size=(len(phase), 2)), {"phase": known, "truth": phase}

    demos = numbered(one(number) for number in range(6))
    layers = [{"filters": 2, "kernel": 3, "stride": 2, "padding": 1}]
    conv = {"network": "conv", "layers": layers, "hidden": [3]}
    labels = {"level": "level-1", "from": "phase", "recogniser": RECOGNISER}
    seen = ["state", "camera"]
    level = {"name": "level-1", "count": 2, "policy": conv, "termination": {**LINEAR, "inputs": ["state"]}}
    hierarchy = {"levels": [level], "meta_policy": {**LINEAR, "inputs": ["state"]}}
    spec = small_spec((2,), observations=seen, hierarchy=hierarchy, training={"labels": labels})
    model = Trainer(spec, Dimensions.of(demos), demos, demos).hierarchy
    batch, reads = encode(demos, model.encoder, model.scaling), model.recogniser.around
    features = reads.features(batch.inputs, batch.actions, batch.lengths)
    found = model.recogniser.options(batch)
    for demo, rows, options in zip(demos, features.numpy(), found.numpy(), strict=True):
        pictures = demo.observations["camera"].reshape(len(demo), 8, 8, 2)
        brightness = pictures.mean(-1).reshape(len(demo), 64) / 255
        np.testing.assert_allclose(rows[: len(demo), 2:66], brightness, atol=1e-6)
        np.testing.assert_allclose(rows[: len(demo), 70:134], window(brightness, 2), atol=1e-6)
        assert (options[: len(demo)] == demo.labels["truth"] + 1).mean() > 0.9


# --- planted options ----------------------------------------------------------------------------------------


def test_three_labelled_demonstrations_name_the_options_of_thirty(tmp_path):
    """Held-out segments have the numbers of the labels, whichever those are; the truth's options do not."""
    names = [30, 10, 20]
    training = {"epochs": 160, "patience": 15, "starts": ["vq"], "optimizer": {"lr": 0.03}}
    labels = {"level": "level-1", "from": "phase"}
    spec = make_spec((3,), control=CONTROL, labels=labels, **training)
    truth = make_truth(spec)
    demos, choices = plant(truth, 30, 24, seed=1)
    phases = np.array(names)[choices[..., 0].numpy() - 1]
    phases[3:] = -1
    pairs = zip(demos, phases, strict=True)
    demos = Demonstrations(tuple(replace(demo, labels={"phase": row}) for demo, row in pairs))
    held_out, true = plant(truth, 20, 24, seed=11)
    model = make_trainer(in_units_of(spec, demos), demos, tmp_path).run()
    tables, batch = tabulated(model, held_out)
    (found,) = segment(tables, batch.lengths)
    number = np.argsort(np.argsort(names)) + 1
    assert normalized_mutual_info_score(true.flatten(), found.flatten()) > 0.95
    assert (found.numpy() == number[true[..., 0] - 1]).mean() > 0.98


# --- the spec, the run and what is said of it ---------------------------------------------------------------


@pytest.fixture
def files(tmp_path):
    """A spec and demonstrations with labels, of which two of three options have one."""
    labels = [[0, 0, 2, 2], [0, 2, 2, 2], [0, 0, 0, 2], [-1, -1, -1, -1], [0, 2, 0, 2]]
    random_demonstrations(labels).write(tmp_path / "demos.hdf5")
    (tmp_path / "mine.yaml").write_text(
        f"""
demonstrations: {{path: {tmp_path / "demos.hdf5"}}}
observations: [state]
hierarchy:
  levels: [{{name: skill, count: 3, policy: {{network: linear}}}}]
  meta_policy: {{network: linear}}
compare_with: [{{kind: flat, policy: {{network: linear}}}}]
training: {{epochs: 3, labels: {{level: skill, from: phase}}}}
"""
    )
    return tmp_path


@pytest.mark.parametrize("start", ["equal_parts", "vq"])
def test_a_start_that_does_not_follow_labels_is_warned_of(files, start):
    given = [files / "mine.yaml", "--set", f"training.starts=[{start}]", "--set", "compare_with=[]"]
    page = files / "run" / "report.html"
    outputs = [call("check", *given).out, call("fit", *given, "--out", files / "run").out, page.read_text()]
    for said in (" ".join(output.split()) for output in outputs):
        assert (f"training.starts: {start} numbers options in the order of time" in said) == (start != "vq")
    assert "training.labels say" not in call("check", *given, "--set", "training.labels=null").out


def test_a_run_says_for_which_labels_its_options_stand(files):
    output = call("check", files / "mine.yaml").out
    says = "labels/phase, level 'skill': phase 0 is option 1, phase 2 is option 2; used of 3 demonstrations"
    assert says in output
    call("fit", files / "mine.yaml", "--out", files / "run")
    said = json.loads((files / "run" / "metrics.json").read_text())["trained_labels"]
    assert (said["level"], said["labels"], said["values"]) == ("skill", "phase", [0, 2])
    again = ddco_pyro.load(files / "run")
    labelled = again.demonstrations.select(said["demonstrations"])
    assert len(labelled) == 3
    option = {0: 1, 2: 2}
    (segments,) = again.segment(labelled)
    same = [
        option[label] == choice
        for demo, row in zip(labelled, segments, strict=True)
        for label, choice in zip(demo.labels["phase"].tolist(), row.tolist(), strict=True)
    ]
    assert said["agreement"] == pytest.approx(np.mean(same))
    assert again.baselines["flat"].spec.training.labels is None
    call("segment", files / "run", files / "demos.hdf5", "--html", files / "page.html")
    for page in (files / "page.html", files / "run" / "report.html"):
        text = page.read_text()
        assert "phase 2 (option 2)" in text
        assert "option 3" in text
        assert "option 3 (" not in text
        assert "(option 3)" not in text


# --- labels of several levels -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("labels", "names"), [(["phase", "half"], ["phase", "half"]), ("half", ["half", "half"])]
)
def test_each_level_is_measured_with_its_own_labels(tmp_path, labels, names):
    random, phase = np.random.default_rng(0), np.repeat([0, 1, 2, 3], 4)
    own = {"phase": phase, "half": np.where(np.arange(16) == 8, -1, phase // 2)}
    places = (phase[:, None] + 0.1 * random.normal(size=(16, 1)) for _ in range(6))
    demos = numbered(({"state": place}, random.normal(size=(16, 1)), own) for place in places)
    files = {"path": "demos.hdf5", "labels": labels, "valid_fraction": 0.34}
    spec = small_spec((3, 2), demonstrations=files, training={"epochs": 3, "layerwise": False})
    fit = ddco_pyro.fit(spec, demos, out=tmp_path / "run")
    metrics, valid = fit.metrics.agreement, demos.select([row.name for row in fit.metrics.valid])
    assert metrics.labels == names
    measured = zip(fit.segment(valid), names, metrics.valid, metrics.confusion, strict=True)
    for level, name, found, table in measured:
        truth = [demo.labels[name] for demo in valid]
        assert found == agreement(level, truth)
        assert np.sum(table.steps) == sum((one >= 0).sum() for one in truth)
    page = write_report(fit, demos).read_text()
    for level, name in zip(("level-1", "level-2"), names, strict=True):
        assert f"Where each label’s steps lie: level “{level}”, label “{name}”" in page
    demos.write(tmp_path / "demos.hdf5")
    done("segment", fit.folder, tmp_path / "demos.hdf5", "--html", tmp_path / "page.html")
    shown = (tmp_path / "page.html").read_text()
    found = [shown.count(f"Agreement with the label “{name}”") for name in names]
    assert found == [names.count(one) for one in names]
