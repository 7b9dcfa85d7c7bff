"""Studies: refused declarations, cells that are kept, killed, moved and shared, worlds, simulated people."""

import functools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import toy_task
import yaml
from random_demonstrations import numbered

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import only_one
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import load
from ddco_pyro.jobs import Workers
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import SpecError
from studies import cells, declaration, statistics
from studies.__main__ import told
from studies.cells import Folder
from studies.declaration import Study
from studies.page import report
from studies.statistics import read_tidy

ROOT = Path(__file__).parents[2]
SPEC = {
    "demonstrations": {"path": "unused.hdf5", "labels": "phase"},
    "observations": ["place"],
    "control": {"std": 0.5},
    "hierarchy": {
        "levels": [{"count": 2, "policy": {"network": "linear"}, "termination": {"network": "linear"}}],
        "meta_policy": {"network": "linear"},
    },
    "compare_with": [{"kind": "flat", "policy": {"network": "linear"}}],
    "training": {"epochs": 3, "optimizer": {"name": "em"}, "layerwise": False},
}
STUDY = {
    "question": "Do options help?",
    "spec": "spec.yaml",
    "world": "files:WORLD",
    "methods": {"options": {}, "flat": {"baseline": "flat"}},
    "seeds": {"test": {"count": 2}},
    "demonstrations": {"counts": [4, 6], "held_out": 3, "test": {"count": 10}},
    "measures": ["nats", "nmi"],
    "contrasts": [{"contrast": "options - flat", "measure": "nats", "demonstrations": 6}],
}
HERE = Workers(jobs=1)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Demonstrations of a place that is left and then sought; two linear policies explain them, not one."""
    turn, phase = np.repeat([[-2.0], [2.0]], 5, 0), np.repeat([0, 1], 5)
    path = tmp_path_factory.mktemp("file") / "mine.hdf5"
    places = np.random.default_rng(0).normal(size=(12, 10, 2))
    numbered(({"place": place}, turn * place, {"phase": phase}) for place in places).write(path)
    return path


def study_in(place, file, in_spec=(), **changes):
    """A study that is declared in a folder, with other values at some keys of its spec and of itself."""
    study = {"tasks": [str(file)], **STUDY, **changes}
    for name, content in (("spec", {**SPEC, **dict(in_spec)}), ("study", study)):
        (place / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return Folder(Study.load(place / "study.yaml"), place / "out")


@pytest.fixture
def made(file, tmp_path):
    """Declares a study of the demonstrations."""
    return functools.partial(study_in, tmp_path, file)


@pytest.fixture(scope="module")
def done(file):
    """A finished study."""
    folder = study_in(file.parent, file)
    folder.run(HERE)
    return folder


SIX = {"count": 6}
TUNED = {
    "choose": "nats",
    "seeds": {"test": {"count": 1}, "development": {"first": 7, "count": 1}},
    "demonstrations": {"counts": [3], "held_out": 2, "test": SIX, "development": {"first": 6, **SIX}},
    "contrasts": [],
}
GRID, FLAT = {"options": {"grid": {"control.std": [0.1, 0.2]}}}, {"flat": {"baseline": "flat"}}
SHARED, OVERLAPPING = {"first": 2, "count": 1}, {"first": 39, "count": 10}
NATS = {"contrast": "options - flat", "measure": "nats"}
EQUIVALENCE = {**STUDY["contrasts"][0], "kind": "equivalence"}
OF_GRID = {"overrides": {"control.std": 0.2}}
SAME = {"grid": {"control.std": [0.1, 0.1]}}
RECORDED = {"counts": [10], "held_out": 5, "test": {"first": 0, "count": 20}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": {}}, "seed: unknown key; did you mean seeds?"),
        ({"seeds": {"test": {"count": 3}, "development": SHARED}}, "seeds.development: 2 to 2 "),
        ({"demonstrations": RECORDED, "starts": {"test": OVERLAPPING}}, "starts.test: 39 to 58"),
        ({"demonstrations": {**RECORDED, "test": {"count": 14}}}, "must be at least 15"),
        ({"measures": ["nat"]}, "there is no measure 'nat' (did you mean 'nats'?)"),
        ({"contrasts": [{"contrast": "options - flat", "measure": "nats"}]}, "must be one of 4, 6"),
        ({"contrasts": [{**NATS, "measure": "ari", "demonstrations": 6}]}, "not among measures"),
        ({"failed": {"success": 0.0}}, "failed.success: 'success' is not among measures"),
        ({"contrasts": [EQUIVALENCE]}, "contrasts.0.margin: missing; say which"),
        ({"families": {"door": ["open", "close"]}}, "families: must have tasks of the study, each once"),
        ({"choose": "nats"}, "choose: goes together with seeds.development"),
        ({**TUNED, "methods": GRID | FLAT}, "unequal numbers of points to choose from (options 2, flat 1)"),
        ({**TUNED, "methods": {"options": SAME} | FLAT}, "methods: have nothing to choose from; give each a"),
        ({"methods": {"options": SAME | OF_GRID}}, "has 'control.std', which the grid has"),
        ({"methods": GRID, "contrasts": []}, "choose: missing; name the measure that chooses among the poin"),
        ({"overrides": {"control.stdd": 0.1}}, "options: control.stdd: unknown key; did you mean control.st"),
    ],
)
def test_a_declaration_that_cannot_be_meant_is_refused_in_words(made, changes, said):
    with pytest.raises(SpecError) as refused:
        made(**changes)
    assert said in str(refused.value)


def test_the_page_names_every_key():
    page = (ROOT / "docs" / "studies.md").read_text()
    own, known = declaration.__name__, vars(declaration).values()
    models = [one for one in known if getattr(one, "__module__", "") == own]
    keys = {key for one in models for key in getattr(one, "model_fields", {})}
    assert "margin" in keys
    assert not {key for key in keys if f"`{key}`" not in page}


NO_METHOD = {"world": "simulated:WORLD", "methods": {"on": {"by": "flo"}}, "contrasts": []}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"kept": [{"table": "spec.yaml"}]}, "spec.yaml: is damaged"),
        ({"world": "nowhere:WORLD"}, "world: nowhere:WORLD cannot be loaded: No module named"),
        (NO_METHOD, "has no method 'flo' (did"),
    ],
)
def test_worlds_and_tables_that_cannot_be_used_are_refused_before_any_work(made, changes, said):
    folder = made(**changes)
    with pytest.raises(BadInput, match=re.escape(said)):
        folder.run(HERE)
    assert not (folder.path / "cells").exists()


def test_a_file_with_too_few_demonstrations_fails_every_cell(made):
    folder = made(demonstrations={**STUDY["demonstrations"], "held_out": 7, "test": {"count": 13}})
    assert {one.failed.partition(": ")[2] for one in folder.run(HERE).failed.values()} == {
        "has 12 demonstrations, but the study needs 13; lower counts or held_out"
    }


def test_in_a_registered_task_every_training_seed_has_its_own_episodes(tmp_path):
    task = "toy_task:task"
    folder = study_in(
        tmp_path,
        task,
        yaml.safe_load(toy_task.SPEC) | {"compare_with": [], "training": {"epochs": 1}},
        world="simulated:WORLD",
        methods={"options": {}},
        demonstrations={"counts": [4], "held_out": 2, "test": {"first": 10, "count": 8}},
        starts={"test": {"first": 500, "count": 5}},
        measures=["error", "success", "nats"],
        contrasts=[],
    )
    state = folder.run(HERE)
    assert not state.failed
    for seed, cell in enumerate(folder.cells("test")):
        name = f"toy_task-task-{10 + 8 * seed}-6.hdf5"
        recorded = Demonstrations.read(folder.path / "demonstrations" / name)
        assert recorded.names == tuple(f"demo_{n}" for n in range(10 + 8 * seed, 16 + 8 * seed))
        controller = load(folder.path / "work" / folder.key(cell) / "fit").controller()
        outcomes = [run_episode(toy_task.task, controller, 500 + 5 * seed + n).outcome for n in range(5)]
        assert state.done[cell].values["success"] == np.mean([one["success"] for one in outcomes])
        errors = [one["error"] for one in outcomes if not np.isnan(one["error"])]
        assert state.done[cell].values["error"] == (pytest.approx(np.mean(errors)) if errors else None)


def test_a_world_collects_plays_and_has_methods_of_its_own(made, tmp_path, monkeypatch):
    (tmp_path / "world_of_tests.py").write_text(WORLD)
    monkeypatch.setattr("studies.__path__", [*sys.modules["studies"].__path__, str(tmp_path)])
    study = {
        "spec": "init",
        "world": "world_of_tests:WORLD",
        "tasks": ["there", "back"],
        "overrides": {"training.epochs": 3},
        "methods": {"options": {}, "own": {"by": "own", "overrides": {"a": 1}}},
        "demonstrations": {"counts": [5], "held_out": 2, "test": {"first": 100, "count": 7}},
        "starts": {"test": {"first": 500, "count": 4}},
        "seeds": {"test": {"count": 2}},
        "measures": ["success", "nats"],
        "contrasts": [{"contrast": "options - own", "measure": "success"}],
    }
    folder = made(**study)
    state = folder.run(HERE)
    assert not state.failed
    found = {cell.row: state.done[cell].values for cell in state.cells}
    for (task, method, _, seed), own in found.items():
        first, start = 100 + 7 * int(seed), 500 + 4 * int(seed)
        assert own["success"] == {"there": 1, "back": 0}[task] if method == "options" else start / 1000
        assert method == "options" or (own["demonstrations"], own["a"]) == (first, 1)
    assert "| 5 | options |" in report(folder, state)  # of two tasks
    methods = {"options": {}, "own": {"by": "own", "overrides": {"a": 2}}}
    assert [cell.of for cell in made(**study | {"methods": methods}).state().missing] == ["own"] * 4


WORLD = """
import numpy as np
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations

class World:
    def __init__(self):
        self.methods = {"own": self.own}

    def collect(self, task, seeds, count, path):
        places = [np.random.default_rng(seed).normal(size=(10, 2)) for seed in seeds]
        turn = np.repeat([[-2.0], [2.0]], 5, 0)
        demos = (Demonstration(f"demo_{n}", {"place": x}, turn * x, attributes={"seed": seed})
                 for n, (seed, x) in enumerate(zip(seeds, places)))
        Demonstrations(tuple(demos)[:count]).write(path)

    def play(self, task, fitted, starts, folder):
        return [{"success": float(task == "there")} for _ in starts]

    def own(self, job):
        assert set(job.demos.masks["train"]) | set(job.demos.masks["valid"]) == set(job.demos.names)
        first = min(demo.attributes["seed"] for demo in job.demos)
        return {"success": job.starts[0] / 1000, "demonstrations": float(first), **job.settings}

WORLD = World()
"""


@pytest.mark.parametrize(("study", "count"), [("frozen", 27), ("frozen_again", 26)])
def test_a_frozen_test_is_fresh(study, count):
    """Its tasks and seeds are no other study's, and no other page names one of the tasks.

    Drawer-open is of development since the first test. Studies of libraries take tasks of both tests since
    these were done, and choose nothing on them.
    """
    frozen = Study.load(ROOT / "studies" / f"{study}.yaml")
    pages = [path.read_text() for path in (ROOT / "docs").rglob("*.md")
             if not path.stem.startswith(("frozen", "library"))]  # fmt: skip
    assert len(frozen.declared.tasks) == count
    tasks = {*frozen.declared.tasks} - {"drawer-open-v3"}
    names = [task.removesuffix("-v3") for task in tasks]
    names = [name if "-" in name else f"{name}-v3" for name in names]  # "push" and "reach" are words, too
    named = re.compile(rf"(?<![\w-])({'|'.join(names)})(-v3)?(?![\w-])")
    assert not [found for page in pages for found in named.findall(page)]
    for path in (ROOT / "studies").glob("*.yaml"):
        other = Study.load(path)
        if path.stem != study:
            assert path.stem.startswith(("frozen", "library")) or not tasks & {*other.declared.tasks}
            for key in ("seeds", "demonstrations", "starts"):
                ranges = [one.declared.ranges(key) for one in (frozen, other) if getattr(one.declared, key)]
                ours, *theirs = ({n for numbers in one.values() for n in numbers} for one in ranges)
                assert not any(ours & numbers for numbers in theirs)


def test_a_training_seed_draws_its_own_demonstrations(done, file):
    names = {}
    for cell in done.cells("test"):
        _, demos = done._prepared(cell, done._recorded(cell, done.study.world()))
        places = {part: [np.asarray(demos.select([name])[0].observations["place"]).sum() for name in names]
                  for part, names in demos.masks.items()}  # fmt: skip
        names[cell.seed, cell.demonstrations] = {*places["train"]}, {*places["valid"]}
    known = {np.asarray(demo.observations["place"]).sum() for demo in Demonstrations.read(file)}
    for (_, count), (train, valid) in names.items():
        assert (len(train), len(valid), train & valid) == (count, 3, set())
        assert train | valid < known
    assert names[0, 4][0] < names[0, 6][0]
    assert names[0, 4][1] == names[0, 6][1] != names[1, 6][1]


def test_planted_options_win_in_the_table_and_the_contrast(done):
    state = done.state()
    assert not state.failed
    assert not state.missing
    said = report(done, state)
    rows = read_tidy(done.path / "table.csv")
    # nats of both methods, nmi of options
    assert len(rows[rows.measure.isin(["nats", "nmi"])]) == 2 * 2 * 2 + 2 * 2
    (contrast,) = statistics.tested(done.study, rows)
    nats = rows[(rows.measure == "nats") & (rows.demonstrations == "6")].set_index(["method", "seed"]).value
    by_hand = [nats["options", seed] - nats["flat", seed] for seed in "01"]
    assert contrast.estimate.value == pytest.approx(np.mean(by_hand))
    assert min(by_hand) > 0.3
    assert "| options - flat | held-out nats/step | 6 |" in said
    assert f"{contrast.estimate.value:+.2f} [" in said


def test_nothing_is_done_twice_and_a_copy_elsewhere_goes_on(done, tmp_path, monkeypatch):
    shutil.copytree(done.study.path.parent, tmp_path / "moved")
    moved = Folder(Study.load(tmp_path / "moved" / "study.yaml"), tmp_path / "moved" / "out")
    gone = moved.cells("test")[3]
    moved.place(gone).unlink()  # its fit stays
    fitted = []
    monkeypatch.setattr(cells, "fit", lambda *given, **named: fitted.append(1) or fit(*given, **named))
    before = {path: path.stat().st_mtime_ns for path in (moved.path / "cells").iterdir()}
    state = moved.run(HERE)
    assert (len(fitted), len(state.done)) == (1, 8)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert read_record(moved, gone)["values"] == read_record(done, gone)["values"]


fit = cells.fit


def read_record(folder, cell):
    return json.loads(folder.place(cell).read_text())


def test_another_key_for_whatever_a_result_depends_on(done, made):
    same, keys = made(), {done.key(cell) for cell in done.cells("test")}
    assert {same.key(cell) for cell in same.cells("test")} == keys
    assert len(keys) == 8
    noted = made(in_spec={"report": {"trajectory": None}, "selection": {"folds": 3}}, measures=["nats"])
    assert {noted.key(cell) for cell in noted.cells("test")} == keys
    for change in (
        {"in_spec": {"seed": 3, "training": {**SPEC["training"], "epochs": 4}}},
        {"seeds": {"test": {"first": 2, "count": 2}}},
        {"demonstrations": {**STUDY["demonstrations"], "test": {"first": 1, "count": 10}}},
        {"demonstrations": {**STUDY["demonstrations"], "held_out": 4}},
        {"overrides": {"control.std": 0.4}},
    ):
        other = made(**change)
        assert not {other.key(cell) for cell in other.cells("test")} & keys, change
    more = made(demonstrations={**STUDY["demonstrations"], "counts": [4, 5, 6]}, seeds={"test": {"count": 3}})
    assert {more.key(cell) for cell in more.cells("test")} > keys


def test_another_default_is_another_result(done):
    path, text = done.place(cell := done.cells("test")[0]), done.place(done.cells("test")[0]).read_text()
    content = json.loads(text)
    content["depends"]["added"]["training"]["batch_size"] += 1
    try:
        path.write_text(json.dumps(content))
        assert done.kept(cell) is None
    finally:
        path.write_text(text)
    assert done.kept(cell)


def test_a_cell_that_another_process_works_on_is_left_to_it(made):
    folder = made(demonstrations={**STUDY["demonstrations"], "counts": [6]}, seeds={"test": {"count": 1}})
    first, second = folder.cells("test")
    with only_one(folder.path / "work" / folder.key(first)):
        state = folder.run(HERE)
    assert state.missing == [first]
    assert folder.kept(second)


SMALL = {"demonstrations": {**STUDY["demonstrations"], "counts": [6]}, "seeds": {"test": {"count": 2}}}


def test_a_failed_cell_counts_what_is_declared(made, monkeypatch, tmp_path):
    """Of flat fits none is done: each counts −50 nats, here and from the table that is kept."""

    def fails(spec, *given, **named):
        return fit(spec, *given, **named) if spec.hierarchy else 1 / 0

    folder = made(**SMALL, failed={"nats": -50.0})
    monkeypatch.setattr(cells, "fit", fails)
    state = folder.run(HERE)
    options = [state.done[cell].values["nats"] for cell in state.done]
    report(folder, state)
    rows = read_tidy(folder.path / "table.csv")
    (contrast,) = statistics.tested(folder.study, rows)
    assert contrast.estimate.units == pytest.approx([own + 50 for own in options], rel=1e-8)
    says = "failed, and count nats -50: unexpected ZeroDivisionError: division by zero (2)"
    assert says in [*told(folder, state)]
    second = made(**SMALL, failed={"nats": -50.0}, kept=[{"table": "out/table.csv"}])
    elsewhere = Folder(second.study, tmp_path / "elsewhere")
    assert (len(elsewhere.state().done), len(elsewhere.state().failed)) == (2, 2)
    pd.testing.assert_frame_equal(
        elsewhere.table(elsewhere.state()).sort_values(statistics.COLUMNS[:-1], ignore_index=True),
        rows.sort_values(statistics.COLUMNS[:-1], ignore_index=True), check_dtype=False,
    )  # fmt: skip
    monkeypatch.undo()
    assert len(elsewhere.run(HERE).done) == 4


def test_a_pinned_study_is_of_one_commit(made, monkeypatch, tmp_path):
    codes = iter(["11aa", "11aa", "22bb", "22bb", "22bb", "11aa-dirty", "11aa"])

    def pinned(**changes):
        code = next(codes)
        monkeypatch.setattr(cells, "commit_of", lambda path: code)
        return made(**SMALL | {"measures": ["nats"]}, pinned=True, **changes)

    def refused(folder):
        with pytest.raises(BadInput) as error:
            folder.state()
        return str(error.value)

    first = pinned()
    state = first.run(HERE)
    report(first, state)
    assert "commits: 11aa (4)" in [*told(first, state)]
    shutil.copy(first.path / "table.csv", tmp_path)
    kept = [{"table": "table.csv"}]
    second = pinned(kept=kept)
    elsewhere = Folder(second.study, tmp_path / "elsewhere")
    assert len(elsewhere.state().done) == 4
    later = Folder(pinned(kept=kept).study, tmp_path / "elsewhere")
    assert len(later.run(HERE).done) == 4  # nothing is left to do, so that a page quotes it at any commit
    table = pd.read_csv(tmp_path / "table.csv", dtype=str)
    table.head(1).to_csv(tmp_path / "fewer.csv", index=False)
    fewer = Folder(pinned(kept=[{"table": "fewer.csv"}]).study, tmp_path / "fewer")
    says = "pinned: results are of commit 11aa, here is 22bb; run it at that commit, or"
    with pytest.raises(BadInput, match=says):
        fewer.run(HERE)
    of_rows = np.where(table.seed == table.seed[0], "11aa", "22bb")
    table.assign(code=of_rows).to_csv(tmp_path / "mixed.csv", index=False)
    mixed = Folder(pinned(kept=[{"table": "mixed.csv"}]).study, tmp_path / "mixed")
    assert "pinned: results are of commits 11aa, 22bb; keep those of one" in refused(mixed)
    with pytest.raises(BadInput, match="pinned: the code has changes since 11aa; commit them"):
        Folder(pinned().study, tmp_path / "third").run(HERE)
    other = pinned(kept=kept, in_spec={"seed": 1}, overrides={"control.std": 0.4}).study
    changed = Folder(other, tmp_path / "fourth")
    assert "was done with key" in refused(changed)
    table = pd.read_csv(tmp_path / "table.csv")
    table[statistics.COLUMNS].to_csv(tmp_path / "table.csv", index=False)
    said = refused(Folder(second.study, tmp_path / "elsewhere"))
    assert "was done with key unknown" in said
    assert "\n" not in said


def test_an_unfinished_fit_goes_on_under_the_same_commit_alone(tmp_path):
    seen = []

    def work(folder):
        (folder / "fit").mkdir(exist_ok=True)
        seen.append(len([*(folder / "fit").iterdir()]))
        (folder / "fit" / str(len(seen))).touch()
        raise BadInput("stopped")

    for code in ("11aa", "11aa", "22bb", "22bb"):
        assert cells.do(tmp_path / "cells" / "a.json", {"a": 1}, work, code) == "stopped"
    assert seen == [0, 1, 0, 1]


def test_the_commit_of_the_code_is_that_of_library_and_study(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "ROOT", tmp_path)
    study, module = tmp_path / "studies" / "mine.yaml", tmp_path / "studies" / "world.py"
    for path in (study, module, tmp_path / "ddco_pyro" / "a.py", tmp_path / "docs" / "a.csv"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("1")
    assert cells.commit_of(study) == "unknown"

    def committed():
        who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        for words in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "a"], ["rev-parse", "HEAD"]):
            told = subprocess.run(["git", *words], cwd=tmp_path, capture_output=True, text=True, check=True)
        return told.stdout[:10]

    first = committed()
    assert cells.commit_of(study) == first
    (tmp_path / "docs" / "a.csv").write_text("2")
    assert cells.commit_of(study) == first
    assert committed() != first
    assert cells.commit_of(study) == first
    for path in (study, module, tmp_path / "ddco_pyro" / "a.py"):
        path.write_text(f"{path} changed")
        assert cells.commit_of(study) == f"{first}-dirty"
        first = committed()
        assert cells.commit_of(study) == first


def test_the_best_point_on_development_seeds_is_tested(made):
    """With σ of 50 every method explains demonstrations worse than with 0.5. Options have their own grid."""
    flat = {"baseline": "flat", "grid": {"control.std": [0.5, 50.0]}}
    methods = {"options": {"grid": {"control.std": [50.0, 0.5]}}, "flat": flat}
    folder = made(**TUNED, methods=methods)
    state = folder.run(HERE)
    parts = [cell.part for cell in state.cells]
    assert (parts.count("development"), parts.count("test"), len(state.done)) == (4, 2, 6)
    tested = {(cell.method, cell.point["control.std"]) for cell in state.cells if cell.part == "test"}
    assert tested == {("options", 0.5), ("flat", 0.5)}
    report(folder, state)
    rows = read_tidy(folder.path / "table.csv")
    points = {f"{name} (std = {std})" for name in ("options", "flat") for std in (0.5, 50.0)}
    names = {"options", "flat", *points}
    assert {*rows.method} == names
    chosen = "the points with the highest nats in development: options (std = 0.5), flat (std = 0.5)"
    assert chosen in [*told(folder, state)]
    assert not made(**TUNED, methods=methods, kept=[{"table": "out/table.csv"}]).state().missing


def test_a_measure_of_nothing_is_better_than_less(made):
    """Means over development cells: of two values at the first point, one of them 0; −0.4 at the second."""
    seeds = {"test": {"count": 1}, "development": {"first": 7, "count": 2}}
    folder = made(**{**TUNED, "seeds": seeds}, methods={"options": {"grid": {"control.std": [0.5, 1.0]}}})
    places = folder.cells("development")

    def chosen(first):
        values = {(7, 0.5): first, (8, 0.5): 0.0, (7, 1.0): -0.4, (8, 1.0): -0.4}
        nats = {one: values[one.seed, one.point["control.std"]] for one in places}
        done = {one: cells.Done(values={"nats": value}) for one, value in nats.items()}
        return folder.chosen(cells.State(places, done, {}))["options"]["control.std"]

    # None: it applies to no episode
    assert [chosen(first) for first in (-1.0, -0.7, None)] == [1.0, 0.5, 1.0]


def test_some_tasks_choose_for_all(made):
    study = {
        **TUNED,
        "tasks": ["needle", "pushing"],
        "choose_on": ["pushing"],
        "methods": {"options": {"grid": {"control.std": [0.5, 1.0]}}},
        "demonstrations": {**RECORDED, "development": {"first": 100, "count": 20}},
    }
    folder = made(**study)
    assert {cell.task for cell in folder.cells("development")} == {"pushing"}
    assert {cell.task for cell in folder.cells("test")} == {"needle", "pushing"}
    with pytest.raises(SpecError, match=r"choose_on\.0: 'needles' is not among tasks"):
        made(**study | {"choose_on": ["needles"]})


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("needle", set()),
        ("pushing", set()),
        ("pushing_test", set()),
        ("arena", {"options by em", "options by em without ridges"}),
        ("bins", set()),
        ("tuned", set()),
        ("frozen", set()),
    ],
)
def test_kept_results_are_not_done_again(name, missing, tmp_path):
    folder = Folder(Study.load(ROOT / "studies" / f"{name}.yaml"), tmp_path)
    assert {cell.method for cell in folder.state().missing} == missing
