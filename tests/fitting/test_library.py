"""The library calls: the command's fit, in memory or in a folder; what is read, and in which pieces."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from command_line import done
from made_metrics import compared as made
from selecting import data_at, two_skills

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.metrics import Compared
from ddco_pyro.report import write_report
from ddco_pyro.spec import load_spec, with_overrides


@pytest.fixture(scope="module")
def commanded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes of a file: ``spec.yaml``, ``demos.hdf5`` and ``run``."""
    folder = tmp_path_factory.mktemp("commanded")
    flat = {"kind": "flat", "policy": {"network": "linear"}}
    (folder / "spec.yaml").write_text(yaml.safe_dump(data_at(folder) | {"compare_with": [flat]}))
    done("fit", folder / "spec.yaml", "--out", folder / "run")
    return folder


@pytest.fixture(scope="module")
def in_memory(commanded: Path) -> ddco_pyro.Fit:
    return ddco_pyro.fit(commanded / "spec.yaml", two_skills())


# --- the same questions as the command asks -----------------------------------------------------------------

READ = "log_likelihood", "segment", "draws"
"""Methods of a fit that take demonstrations."""


def one(place: object = np.ones((8, 2)), actions: object = np.ones((8, 2)), **more: object) -> Demonstration:
    return Demonstration("demo", {"place": place, "turn": np.ones((8, 1)), **more}, actions)


MISSPELT = Demonstration("demo", {"plce": np.ones((8, 2))}, np.ones((8, 2)))
NOT_READ = {
    "a control too many": (lambda: [one(actions=np.ones((8, 3)))], r"demo: actions has shape \(3,\) at each"),
    "a wide observation": (lambda: [one(np.ones((8, 3)))], r"demo: obs/place has shape \(3,\)"),
    "a missing observation": (
        lambda: [MISSPELT],
        r"demo: there is no observation 'place' \(did you mean 'pl",
    ),
    "a huge number": (lambda: [one(np.full((8, 2), 1e20))], "demo: obs/place at step 0 is 1e"),
    "a name twice": (lambda: [one(), one()], "demo: there are two demonstrations of this name"),
    "none": (list, "there are no demonstrations"),
    "one without a list": (one, "got Demonstration"),
    "a path": (lambda: "demos.hdf5", r"Demonstrations\.read\(FILE\); got str"),
}


@pytest.mark.parametrize("method", READ)
@pytest.mark.parametrize("fault", NOT_READ)
def test_demonstrations_that_a_fit_cannot_read_are_refused_in_a_line(
    method: str, fault: str, in_memory: ddco_pyro.Fit
) -> None:
    give, says = NOT_READ[fault]
    with pytest.raises(BadInput, match=says) as refused:
        getattr(in_memory, method)(give())
    assert "\n" not in str(refused.value)


SEEN = {"place": np.zeros(2), "turn": np.ones(1)}
UNSEEN = {
    "missing": ({"turn": np.ones(1)}, "the observation has no 'place'"),
    "wide": ({**SEEN, "place": np.zeros(3)}, r"'place' has shape \(3,\), the demonstrations had \(2,\)"),
    "NaN": ({**SEEN, "place": [np.nan, 0]}, "'place' is not finite"),
    "ragged": ({**SEEN, "place": [[1], [1, 2]]}, "'place' is no array"),
    "huge": ({**SEEN, "place": [1e20, 0]}, r"'place' is 1e\+20 once it is scaled"),
    "huge as float32": ({**SEEN, "place": [1e300, 0]}, "'place' is too large"),
    "an array": (np.zeros(2), "has to be a mapping, such as {'place': array}; got ndarray"),
}
UNAPPLIED = {
    "missing": (None, "the control applied since the last observation is needed"),
    "wide": (np.zeros(3), r"the control has shape \(3,\)"),
    "huge": ([1e25, 0], "the control is .*e.* once it is scaled.*units"),
}


@pytest.mark.parametrize("fault", [*UNSEEN, *(f"control: {name}" for name in UNAPPLIED)])
def test_what_cannot_be_acted_on_is_refused_and_changes_nothing(fault: str, in_memory: ddco_pyro.Fit) -> None:
    of_control, applied = fault.startswith("control: "), np.zeros(2)
    wrong, says = UNAPPLIED[fault.removeprefix("control: ")] if of_control else UNSEEN[fault]
    monitor, controller, found = in_memory.monitor(), in_memory.controller(), []
    for refuse in (False, True):
        monitor.reset()
        controller.reset()
        monitor.step(SEEN)
        controller.act(SEEN)
        asks = [lambda: monitor.step(*((SEEN, wrong) if of_control else (wrong, applied)))]
        asks += [] if of_control else [lambda: controller.act(wrong)]
        for ask in asks if refuse else ():
            with pytest.raises(BadInput, match=says) as refused:
                ask()
            assert "\n" not in str(refused.value)
        found.append((monitor.step(SEEN, applied), monitor.log_likelihood, controller.act(SEEN).tolist()))
    assert found[0] == found[1]


WAYS, FILES = "control='average': has to be one of mean,", "demonstrations: has to be the path .*; got Dem"


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda fit: fit.controller(-1), "seed=-1: has to be a whole number from 0 on"),
        (lambda fit: ddco_pyro.Controller(fit), "a Fit in place of networks: give fit.hierarchy"),
        (lambda fit: ddco_pyro.Controller(fit.hierarchy, "average"), WAYS),
        (lambda fit: fit.draws(two_skills(), 0), "draws=0: has to be a whole number from 1 on"),
        (lambda fit: fit.draws(two_skills(), 2).boundaries("skill", 0, np.ones(8)), "no level 'skill'"),
        (lambda fit: fit.monitor().step(SEEN, np.zeros(2)), "no control comes before the first observation"),
        (lambda fit: ddco_pyro.fit(fit.spec, np.ones((8, 2))), "got ndarray"),
        (lambda fit: ddco_pyro.fit({"observations": []}, two_skills()), "spec: has to be the path .*; got d"),
        (lambda fit: ddco_pyro.segment(fit, two_skills()), FILES),
        (lambda fit: Demonstration("a", np.ones(3), np.ones((3, 1))), "observations have to be a mapping"),
        (lambda fit: Demonstration("a", {"x": [[1], [1, 2]]}, np.ones((2, 1))), "a: obs/x is no array"),
        (lambda fit: two_skills().split(1.5, 0), "valid_fraction=1.5"),
        (lambda fit: two_skills().split(0.5, -1), "seed=-1"),
    ],
)
def test_wrong_arguments_are_refused_in_a_line(ask, says: str, in_memory: ddco_pyro.Fit) -> None:
    with pytest.raises(BadInput, match=says) as refused:
        ask(in_memory)
    assert "\n" not in str(refused.value)


# --- what is printed ----------------------------------------------------------------------------------------


def test_what_is_printed_is_a_few_lines(in_memory: ddco_pyro.Fit) -> None:
    demos = replace(two_skills(), masks={"valid": ("demo_3",)})
    values, counts = in_memory.metrics.log_likelihood_per_step, in_memory.metrics.demonstrations
    trained = f"{values.train:.3f} ({counts.train} trained with)"
    assert str(in_memory).splitlines() == [
        "ddco",
        "  option: option 1, option 2",
        f"  log-likelihood, nats per step: {trained}, {values.valid:.3f} ({counts.valid} held out)",
    ]
    arrays = ["  actions [2] float64", "  obs/place [2] float64", "  obs/turn [1] float64"]
    assert repr(demos[1]).splitlines() == ["demo_1: 9 steps", *arrays]
    assert repr(demos).splitlines() == ["12 demonstrations of 8 to 10 steps", *arrays, "  mask/valid: 1"]


def test_segments_are_a_table_of_the_most_likely_path(in_memory: ddco_pyro.Fit) -> None:
    demos = two_skills()
    (options,) = in_memory.segment(demos)
    assert list(map(len, options)) == list(demos.lengths)
    about = ("option", in_memory.names["option"], demos.names)
    assert (options.level, options.names, options.demonstrations) == about
    rows = options.segments
    for demo, path in zip(demos, options, strict=True):
        own = [row for row in rows if row.demonstration == demo.name]
        assert [row.option for row in own for _ in range(row.steps)] == path.tolist()
        assert [row.start for row in own] == [0, *np.cumsum([row.steps for row in own])[:-1]]
        assert all(row.name == options.names[row.option] for row in own)
    first = f"option: 12 demonstrations, {len(rows)} segments\n  demo_0: {rows[0].name} ("
    assert str(options).startswith(first)
    table = pytest.importorskip("pandas").DataFrame(rows)
    assert [*table.columns] == ["demonstration", "level", "option", "name", "start", "steps"]


# --- a fit without a folder ---------------------------------------------------------------------------------


def numbers(fit: ddco_pyro.Fit) -> dict[str, object]:
    return fit.metrics.model_dump(exclude={"seconds"})


def test_the_fit_in_memory_is_the_commands(in_memory: ddco_pyro.Fit, commanded: Path) -> None:
    loaded, demos = ddco_pyro.load(commanded / "run"), two_skills()
    assert (in_memory.folder, loaded.folder) == (None, commanded / "run")
    assert numbers(in_memory) == numbers(loaded)
    assert numbers(in_memory.baselines["flat"]) == numbers(loaded.baselines["flat"])
    np.testing.assert_array_equal(in_memory.log_likelihood(demos), loaded.log_likelihood(demos))
    assert in_memory.demonstrations.names == loaded.demonstrations.names == demos.names


def test_nothing_is_written_unless_it_is_asked_for(commanded: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    spec = with_overrides(load_spec(commanded / "spec.yaml"), {"training.epochs": 1})
    assert ddco_pyro.fit(spec, commanded / "demos.hdf5").folder is None
    assert not any(tmp_path.iterdir())


def test_what_needs_a_folder_says_so(in_memory: ddco_pyro.Fit) -> None:
    line = r"^this fit has no run folder; fit with out=FOLDER, which this needs$"
    for ask in (lambda: write_report(in_memory, two_skills()), lambda: roll_out(in_memory, 1)):
        with pytest.raises(BadInput, match=line):
            ask()


def test_demonstrations_from_memory_are_kept_with_the_run(commanded: Path, tmp_path: Path) -> None:
    spec, folder = load_spec(commanded / "spec.yaml"), tmp_path / "run"
    fit = ddco_pyro.fit(spec, two_skills(), out=folder)
    ours, theirs = ((each / "model.safetensors").read_bytes() for each in (folder, commanded / "run"))
    assert ours == theirs
    assert numbers(ddco_pyro.load(folder)) == numbers(fit)
    done("report", folder)
    done("compare", folder, commanded / "run", "--out", tmp_path / "compared")
    before = (folder / "metrics.json").read_bytes()
    assert ddco_pyro.fit(spec, two_skills(), out=folder).metrics == fit.metrics
    assert (folder / "metrics.json").read_bytes() == before
    says = r"run: is a run of other demonstrations \(actions and obs/place changed\)"
    with pytest.raises(BadInput, match=says):
        ddco_pyro.fit(spec, two_skills(seed=1), out=folder)


def test_demonstrations_in_another_order_are_the_same(in_memory: ddco_pyro.Fit, tmp_path: Path) -> None:
    """That of their names, as in a file; so a run goes on from what it keeps of them."""
    backwards = Demonstrations(tuple(reversed(two_skills())))
    fit = ddco_pyro.fit(in_memory.spec, backwards, out=tmp_path / "run")
    assert numbers(fit) == numbers(in_memory)
    assert numbers(ddco_pyro.fit(in_memory.spec, backwards, out=tmp_path / "run")) == numbers(fit)


def test_masks_of_demonstrations_from_memory_say_which_are_held_out(in_memory, tmp_path: Path) -> None:
    """In whatever order they come, with a run that keeps them or without."""
    names = two_skills().names
    given = replace(two_skills(), demonstrations=tuple(reversed(two_skills())), masks={"valid": names[2:5]})
    kept = ddco_pyro.fit(in_memory.spec, given, out=tmp_path / "run")
    for fit in (kept, ddco_pyro.fit(in_memory.spec, given)):
        assert tuple(one.name for one in fit.metrics.valid) == names[2:5]
    kept = Demonstrations.read(tmp_path / "run" / "demonstrations.hdf5", ["place"])
    assert kept.masks == {"valid": names[2:5]}


def test_the_spec_says_what_is_seen_of_demonstrations_from_memory(in_memory: ddco_pyro.Fit) -> None:
    """Another observation, and a demonstration that is left out."""
    records = [*two_skills(), Demonstration("other", two_skills()[0].observations, two_skills()[0].actions)]
    noisy = [{**d.observations, "noise": np.ones((len(d), 3))} for d in records]
    more = [Demonstration(d.name, own, d.actions) for d, own in zip(records, noisy, strict=True)]
    spec = with_overrides(in_memory.spec, {"demonstrations.exclude": ["other"]})
    fit = ddco_pyro.fit(spec, Demonstrations(tuple(more)))
    assert numbers(fit) == numbers(in_memory)
    assert numbers(ddco_pyro.fit(in_memory.spec, Demonstrations(tuple(more[:-1])))) == numbers(in_memory)
    other = with_overrides(spec, {"demonstrations.exclude": ["another"]})
    with pytest.raises(DemonstrationsError, match=r"there is no demonstration 'another'"):
        ddco_pyro.fit(other, Demonstrations(tuple(more)))
    says = r"there is no obs/plac .did you mean 'place'..; there is: place"
    with pytest.raises(DemonstrationsError, match=says):
        ddco_pyro.fit(with_overrides(in_memory.spec, {"observations": ["plac"]}), two_skills())
    with pytest.raises(DemonstrationsError, match=r"there is no labels/phase; there is: nothing"):
        ddco_pyro.fit(with_overrides(in_memory.spec, {"demonstrations.labels": "phase"}), two_skills())


# --- the model to act with ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("leads", "expected"),
    [
        ({"flat": (0.5, 0.1)}, "ddco"),
        ({"flat": (-0.5, 0.6)}, "ddco"),  # less than a standard error
        ({"flat": (-0.5, 0.4)}, "flat"),
        ({"flat": (-0.5, 0.4), "mixture": (-0.9, 1.0)}, "flat"),
        ({"flat": (-0.5, 0.4), "mixture": (-0.9, 0.8)}, "mixture"),
    ],
)
def test_the_best_model_is_the_likeliest_by_more_than_a_standard_error(in_memory, leads, expected) -> None:
    metrics = in_memory.metrics.model_copy(
        update={"comparison": {name: compared(mean, error) for name, (mean, error) in leads.items()}}
    )
    others = {name: replace(in_memory.baselines["flat"], folder=Path(name)) for name in leads}
    fit = replace(in_memory, metrics=metrics, beside=others)
    assert fit.best is (fit if expected == "ddco" else others[expected])


def compared(mean: float, error: float | None) -> Compared:
    """A baseline that this fit leads by ``mean`` nats per step."""
    return Compared.model_validate(made(mean, error))


def test_no_model_is_known_to_be_the_best_where_too_few_were_held_out(in_memory) -> None:
    one = in_memory.metrics.model_copy(update={"comparison": {"flat": compared(-1.0, None)}})
    with pytest.raises(BadInput, match="fewer than two demonstrations were held out"):
        _ = replace(in_memory, metrics=one).best


def test_the_best_model_is_exported(commanded: Path, tmp_path: Path) -> None:
    run = ddco_pyro.load(commanded / "run")
    best = replace(run, metrics=run.metrics.model_copy(update={"comparison": {"flat": compared(-1.0, 0.1)}}))
    best.metrics.write(commanded / "run")
    try:
        done("export", commanded / "run", "--best", "--out", tmp_path / "best")
    finally:
        run.metrics.write(commanded / "run")
    done("export", commanded / "run", "--out", tmp_path / "own")
    files = [tmp_path / name / "controller.json" for name in ("own", "best")]
    names = [json.loads(file.read_text())["names"] for file in files]
    assert [sorted(each) for each in names] == [["option"], []]  # a flat policy has no options


# --- what is read -------------------------------------------------------------------------------------------


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter:
    """How much of each dataset has been read, in parts of its size."""
    counted: Counter = Counter()
    read = h5py.Dataset.__getitem__

    def counting(dataset, *arguments, **named):
        values = read(dataset, *arguments, **named)
        counted[dataset.name] += np.size(values) / max(1, math.prod(dataset.shape))
        return values

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counting)
    return counted


def everything(path: Path) -> set[str]:
    names = set()
    with h5py.File(path) as file:
        file.visititems(lambda name, one: names.add(f"/{name}") if isinstance(one, h5py.Dataset) else None)
    return names


def test_a_fit_reads_its_demonstrations_once(commanded: Path, tmp_path: Path, reads: Counter) -> None:
    """The report looks for pictures in one more demonstration, with its control."""
    done("fit", commanded / "spec.yaml", "--out", tmp_path / "run")
    again = Counter(reads) - Counter(dict.fromkeys(everything(commanded / "demos.hdf5"), 1.0))
    assert reads.keys() == everything(commanded / "demos.hdf5")
    assert [name.rpartition("/")[-1] for name in again] == ["actions"]
    assert (tmp_path / "run" / "report.html").exists()


def test_check_reads_no_observations(commanded: Path, reads: Counter) -> None:
    """The controls are read: which are constant, or take two values, is part of what it says."""
    done("check", commanded / "spec.yaml")
    assert reads == {name: 1.0 for name in everything(commanded / "demos.hdf5") if name.endswith("/actions")}
