"""Runs compared: against sums by hand, and refused with the reason where their data are not the same."""

import csv
import json
import re
import shutil
from dataclasses import replace
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import call
from made_metrics import made_metrics
from scipy import stats
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro import comparison, load
from ddco_pyro.comparison import Comparison, Row, compare, write
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import UNMATCHED
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.metrics import Marginal
from ddco_pyro.report import write_report
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.data import demonstrations, train_and_valid

SHORT = {"training.epochs": 1, "compare_with": []}


@pytest.fixture(scope="module")
def held_out(toy_spec, cache):
    return train_and_valid(toy_spec, demonstrations(toy_spec))["valid"]


@pytest.fixture(scope="module")
def other(toy_spec, cache, tmp_path_factory):
    """Makes a fit of the toy spec, with changes."""

    def make(name="other", **changes):
        paths = {key.replace("__", "."): value for key, value in changes.items()}
        return fit(with_overrides(toy_spec, SHORT | paths), out=tmp_path_factory.mktemp("runs") / name)

    return make


@pytest.fixture(scope="module")
def folders(toy_run, other):
    """The toy run, both its baselines, and a run with three options."""
    three = other(hierarchy__levels__0__count=3)
    baselines = toy_run.folder / "baselines"
    return [toy_run.folder, baselines / "flat", baselines / "per_timestep", three.folder]


@pytest.fixture(scope="module")
def found(folders):
    return compare(folders)


def jackknifed(values, steps):
    """The standard error of a sum over trajectories as they happen to be drawn, by steps: each left out."""
    n, total = len(steps), sum(steps)
    each = np.array([np.delete(values, i).sum() / np.delete(steps, i).sum() for i in range(n)])
    return total * np.sqrt((n - 1) / n * ((each - each.mean()) ** 2).sum())


def test_rows_are_what_az_compare_would_say(found, folders, held_out):
    """rank, elpd, se, elpd_diff and dse of arviz, with a trajectory's log-likelihood for the elpd of an
    observation; errors are those per step, which for trajectories of one length is the same."""
    values = {str(folder): load(folder).log_likelihood(held_out) for folder in folders}
    order = sorted(values, key=lambda name: -values[name].sum())
    assert [(row.rank, row.name) for row in found.rows] == list(enumerate(order))
    for row in found.rows:
        own, difference = values[row.name], values[order[0]] - values[row.name]
        assert row.each == pytest.approx(own.tolist())
        assert row.total == pytest.approx(own.sum())
        assert row.se == pytest.approx(jackknifed(own, held_out.lengths), rel=0.1)
        assert row.difference == pytest.approx(difference.sum(), abs=1e-9)
        assert row.dse == pytest.approx(jackknifed(difference, held_out.lengths), rel=0.1, abs=1e-9)
        assert row.per_step == pytest.approx(own.sum() / sum(held_out.lengths))
    assert (found.rows[0].difference, found.rows[0].dse) == (0.0, 0.0)
    assert (found.steps, found.trajectories) == (held_out.lengths, held_out.names)


@pytest.mark.parametrize(
    ("each", "said"),
    [
        ([1.0, 1.2, 0.8, 1.0], "1.00 ± 0.08 nats per step better than b"),
        ([4.0, -2.0, 3.0, -1.0], "with no clear difference from b (+1.00 ± 1.47 nats per step)"),
    ],
)
def test_the_verdict_says_whether_a_difference_is_outside_its_error(each, said):
    """By hand, trajectories of one step: ± is their standard deviation by the root of four."""
    apart, error = sum(each), 2 * float(np.std(each, ddof=1))
    rows = [row("a", 0, each), replace(row("b", 1, [0.0] * 4, in_training=0.1), difference=apart, dse=error)]
    found = Comparison(rows, tuple("klmn"), (1, 1, 1, 1), [], [], "a")
    assert comparison.verdict(found) == (
        f"a explains held-out demonstrations {said} (± is one standard error over 4 held-out demonstrations, "
        "for one fit of each model)."
    )


def row(name, rank, each, model="ddco", in_training=1.0):
    mean = sum(each) / len(each)
    training = made_metrics().training
    return Row(rank, name, model, 3, sum(each), 0.1, 0.0, 0.0, mean, in_training, tuple(each), training)


def test_a_run_that_fell_apart_comes_first_in_the_verdict():
    """By the density without observations; nothing follows from a lead over a mixture that fell apart."""
    runs = [("a", "flat", [4.0] * 4, 4.1), ("b", "ddco", [-9.0, -8.0] * 2, 6.0)]
    runs.append(("c", "mixture", [-20.0] * 4, 5.0))
    rows = [row(name, rank, each, model, own) for rank, (name, model, each, own) in enumerate(runs)]
    known = Marginal(train=0.0, valid=-1.0, controls=2)
    said = comparison.verdict(Comparison(rows, tuple("klmn"), (1, 1, 1, 1), [], [], "b", known))
    apart = "b fell apart on held-out demonstrations: −8.50 nats per step there, 6.00 in training."
    assert said.startswith(apart)
    assert "c fell apart" in said
    assert "b is below a by 12.50 ± 0.29 nats per step" in said
    assert "options that last" not in said


def test_one_run_of_each_model_tests_options_against_the_mixture():
    runs = [("a", "ddco", [4.0, 4.1, 4.2, 4.1]), ("b", "mixture", [3.0, 3.1, 3.0, 3.1])]
    rows = [row(name, rank, each, model, 3.5) for rank, (name, model, each) in enumerate(runs)]
    said = comparison.verdict(Comparison(rows, tuple("klmn"), (1, 1, 1, 1), [], [], "a"))
    assert "options that last predict held-out controls better than the mixture does: +1.05 ± " in said
    assert "Success was not measured." in said


def test_demonstrations_are_listed_worst_first_by_the_best_hierarchy(toy_run, found, folders, held_out):
    values = {str(one): load(one).log_likelihood(held_out) / held_out.lengths for one in folders}
    hierarchies = [row.name for row in found.rows if row.model == "ddco"]
    order = np.argsort(values[hierarchies[0]])
    assert [one["name"] for one in found.worst_first] == [held_out.names[n] for n in order]
    for one, n in zip(found.worst_first, order, strict=True):
        assert one["steps"] == held_out.lengths[n]
        expected = {name: each[n] for name, each in values.items()}
        assert one["log_likelihood_per_step"] == pytest.approx(expected)


def test_the_list_leads_to_the_segments_in_the_report(toy_run, toy_spec, tmp_path):
    run = load(shutil.copytree(toy_run.folder, tmp_path / "a run"))
    found = compare([run.folder, run.folder / "baselines" / "flat"])
    assert 'href="' not in write(found, tmp_path / "without").read_text()
    report = write_report(run, demonstrations(toy_spec))
    path = write(found, tmp_path / "compare" / "here")
    links = re.findall(r'<td><a href="([^"]*)">(\w+)</a></td>', path.read_text())
    assert [name for _, name in links] == [one["name"] for one in found.worst_first]
    for link, name in links:
        address, _, place = link.partition("#")
        assert (path.parent / unquote(address)).resolve() == report.resolve()
        assert f'<div class="demonstration" id="{place}"><div class="who">{name}\n' in report.read_text()


def test_demonstrations_may_be_held_out_in_another_order(folders, toy_spec, other, tmp_path):
    """A run that reads the same demonstrations from a file of its own, turned round, with masks."""
    demos = demonstrations(toy_spec)
    split = train_and_valid(toy_spec, demos)
    masks = {name: tuple(reversed(part.names)) for name, part in split.items()}
    Demonstrations(demos.demonstrations[::-1], masks).write(tmp_path / "own.hdf5")
    turned = other("turned", demonstrations__path=str(tmp_path / "own.hdf5"))
    found = compare([folders[0], turned.folder])
    by_name = {row.name: row for row in found.rows}
    expected = load(turned.folder).log_likelihood(split["valid"])
    assert by_name[str(turned.folder)].each == pytest.approx(expected.tolist())


APART = r"not held out on the same data: demo_\d+ was held out by \S+ alone; fit both with the same"
NOTHING = r"held nothing out \(demonstrations.valid_fraction: 0\); there is"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"seed": 1}, APART), ({"demonstrations__valid_fraction": 0.0}, NOTHING)],
    ids=["another split", "nothing held out"],
)
def test_runs_that_share_no_held_out_data_are_refused(folders, other, changes, reason):
    with pytest.raises(BadInput, match=reason) as refused:
        compare([folders[0], other(**changes).folder])
    assert "\n" not in str(refused.value)


def test_demonstrations_of_the_same_names_are_looked_at(folders, toy_spec, other, tmp_path):
    demos = demonstrations(toy_spec)
    for demo in demos:
        demo.observations["visited"][:] = 1 - demo.observations["visited"]
    demos.write(tmp_path / "own.hdf5")
    changed = other("changed", demonstrations__path=str(tmp_path / "own.hdf5"))
    with pytest.raises(BadInput, match=r"same data: demo_\d+ has other obs/visited; fit both to the same"):
        compare([folders[0], changed.folder])


def test_demonstrations_that_have_changed_since_are_refused(toy_spec, other, tmp_path):
    path = tmp_path / "own.hdf5"
    demos = demonstrations(toy_spec)
    demos.write(path)
    first = other("first", demonstrations__path=str(path))
    second = load(shutil.copytree(first.folder, tmp_path / "second"))
    assert len(compare([first.folder, second.folder]).rows) == 2
    metrics = json.loads((first.folder / "metrics.json").read_text())
    # as where the code of a user's network says another one by now
    metrics["valid"][0]["log_likelihood"] += 1
    (first.folder / "metrics.json").write_text(json.dumps(metrics))
    says = r"first: demo_\d+ has changed since this run was fitted to it; fit it"
    with pytest.raises(BadInput, match=says):
        compare([first.folder, second.folder])


def test_a_run_is_not_compared_with_itself(folders):
    with pytest.raises(BadInput, match="the same run is given twice"):
        compare([folders[0], folders[0] / "baselines" / ".."])


def test_agreement_is_that_of_each_run_on_what_was_held_out(found, folders, held_out):
    """NMI by scikit-learn, and what the run says of matching and equal parts; baselines have no options."""
    by_run = {str(folder): load(folder) for folder in (folders[0], folders[-1])}
    runs = [row.name for row in found.rows if row.name in by_run]
    phases = np.concatenate([demo.labels["phase"] for demo in held_out])
    assert [row["run"] for row in found.agreement[::2]] == runs
    for run, ours, equal in zip(runs, found.agreement[::2], found.agreement[1::2], strict=True):
        fitted = by_run[run]
        level = fitted.spec.hierarchy.levels[0]
        assert equal["run"] == f"equal lengths, {level.count} parts"
        assert ours["nmi"] == pytest.approx(
            normalized_mutual_info_score(phases, np.concatenate(*fitted.segment(held_out)))
        )
        agreement = fitted.metrics.agreement
        for row, (scores,) in ((ours, agreement.valid), (equal, agreement.equal_valid)):
            assert (row["level"], row["labels"]) == (level.name, "phase")
            assert row["accuracy"] == scores.matched_globally.accuracy
            assert {key: row[key] for key in UNMATCHED} == {key: getattr(scores, key) for key in UNMATCHED}


@pytest.fixture(scope="module")
def rolled(toy_run, other, folders, tmp_path_factory):
    """Two runs with rollouts from initial states of which some are the same; one more without."""
    first = load(shutil.copytree(toy_run.folder, tmp_path_factory.mktemp("rolled") / "first"))
    second = other("second", rollout__policies=[])
    for run, episodes in ((first, 4), (second, 5)):
        roll_out(run, episodes, film=0, jobs=1)
    return first, second, load(folders[-1])


def successes(folder, method):
    with (folder / "rollouts.csv").open() as file:
        rows = [one for one in csv.DictReader(file) if one["method"] == method]
    return {int(one["seed"]): float(one["success"]) for one in rows}


def test_rollouts_are_paired_by_initial_state(rolled):
    first, second, third = rolled
    flat = first.folder / "baselines" / "flat"
    found = compare([first.folder, flat, second.folder, third.folder])
    outcomes = {str(first.folder): successes(first.folder, "ddco")}
    outcomes[str(flat)] = successes(first.folder, "flat")
    outcomes[str(second.folder)] = successes(second.folder, "ddco")
    order = [row.name for row in found.rows if row.name in outcomes]
    assert [(one["run"], one["other"]) for one in found.rollouts] == [(order[0], name) for name in order[1:]]
    for one in found.rollouts:
        ours, theirs = outcomes[one["run"]], outcomes[one["other"]]
        both = ours.keys() & theirs.keys()
        assert one["trials"] == len(both) < max(len(ours), len(theirs)) + 1
        assert one["only_ours"] == sum(ours[seed] > theirs[seed] for seed in both)
        assert one["only_theirs"] == sum(ours[seed] < theirs[seed] for seed in both)
        assert one["rate"]["successes"] == sum(ours[seed] for seed in both)
        assert one["rate"]["trials"] == one["other_rate"]["trials"] == len(both)
        discordant = one["only_ours"] + one["only_theirs"]
        expected = stats.binomtest(one["only_ours"], discordant).pvalue if discordant else 1.0
        assert one["p_value"] == pytest.approx(expected)


def test_the_command_and_the_files_say_the_same(folders, found, tmp_path):
    folder = tmp_path / "x"
    *_, verdict, place = call("compare", *folders, "--out", folder).out.splitlines()
    assert verdict == comparison.verdict(found)
    assert place == f"comparison: {folder / 'compare.html'}"
    data = json.loads((folder / "compare.json").read_text())
    totals = [(row.name, row.total) for row in found.rows]
    assert [(row["name"], row["total"]) for row in data["rows"]] == totals
    assert data["trajectories"] == list(found.trajectories)
    text = (folder / "compare.md").read_text()
    table = [re.split(r" *\| *", line.strip("| ")) for line in text.splitlines() if line.startswith("|")]
    runs = comparison.run_table(found)
    assert table[0] == runs.head
    assert table[2 : 2 + len(found.rows)] == runs.rows
    html = (folder / "compare.html").read_text()
    rest = [comparison.agreement_table(found), comparison.demonstration_table(found)]
    assert all(f">{cell}<" in html for one in (runs, *rest) for row in (one.head, *one.rows) for cell in row)
    assert not re.search(r'(src|href)="(?!data:)', html)  # nothing is loaded from elsewhere
    assert data["demonstrations"] == found.worst_first
    assert text.startswith(comparison.verdict(found))
    assert data["agreement"] == found.agreement
    assert f'<p class="verdict">{comparison.verdict(found)}</p>' in html
    drawn = "".join(ElementTree.parse(folder / "compare.svg").getroot().itertext())
    assert all(row.name in drawn for row in found.rows)
