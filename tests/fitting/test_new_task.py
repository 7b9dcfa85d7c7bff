"""A new task from one demonstration and a library: the command, the strength, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from command_line import done, refused
from planted import small_spec

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.planted import pick_and_place
from ddco_pyro.evaluation.inferred import infer
from ddco_pyro.fitting.library import STRENGTHS, imitation_error
from ddco_pyro.fitting.names import write_names
from ddco_pyro.spec import with_overrides
from ddco_pyro.training import prior

SPEC = small_spec(
    (3,),
    name="option",
    observations=["gripper", "object", "goal", "jaw"],
    control={"std": {"learn": True, "per_option": True}},
    compare_with=["mixture"],
    training={"starts": ["vq_controls"], "optimizer": {"name": "em"}, "epochs": 30},
)


def task(number, count):
    """Pick and place by a hand that is as much faster."""
    about = {"task": f"task {number}"}
    times = np.array([*[1 + 0.1 * number] * 3, 1.0])
    return [
        replace(demo, name=f"task{number}_{demo.name}", actions=demo.actions * times, attributes=about)
        for demo in pick_and_place(count, seed=number)
    ]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    demos = Demonstrations(tuple(demo for number in range(3) for demo in task(number, 4)))
    ddco_pyro.fit(SPEC, demos, out=folder / "run")
    Demonstrations(tuple(task(5, 1))).write(folder / "new.hdf5")
    (folder / "new.yaml").write_text(yaml.safe_dump({"demonstrations": {"path": str(folder / "new.hdf5")}}))
    return folder


def test_controls_are_expected_by_the_belief_of_a_monitor(library):
    """The error is that of an online filter of another implementation, step by step."""
    run, demos = ddco_pyro.load(library / "run"), Demonstrations(tuple(task(5, 3)))
    errors = []
    for demo in demos:
        monitor, (piece,) = run.monitor(), infer(run.hierarchy, [demo])
        for t in range(len(demo)):
            seen = {key: values[t] for key, values in demo.observations.items()}
            monitor.step(seen, demo.actions[t - 1] if t else None)
            expected = monitor.belief[0][0, 1:] @ piece.outputs.emissions[0].mode[0, t].double()
            errors.append((expected - piece.batch.actions[0, t]).abs().numpy())
    assert imitation_error(run.hierarchy, demos) == pytest.approx(np.mean(errors), rel=1e-5)


def test_one_demonstration_and_a_library_are_enough(library, tmp_path):
    """The strength is chosen once, is kept with the library and said; the model is the library's, adapted."""
    places = ("--library", library / "run", "--out", tmp_path / "run")
    ended = done("fit", library / "new.yaml", *places, "--jobs", 1)
    kept = json.loads((library / "run" / "library.json").read_text())
    assert kept["ridge"] in STRENGTHS
    assert kept["ridge"] == STRENGTHS[int(np.argmin([*kept["error"].values()]))]
    assert kept["tasks"] == ["task 0", "task 1", "task 2"]
    assert f"by a ridge of {kept['ridge']:g}, which its own tasks chose" in ended.err + ended.out
    run, adapted = ddco_pyro.load(library / "run"), ddco_pyro.load(tmp_path / "run")
    assert adapted.metrics.demonstrations.train == 1
    assert adapted.metrics.engine_check.value < 1e-6
    assert adapted.spec.hierarchy == run.spec.hierarchy
    for name, value in run.hierarchy.encoder.state_dict().items():
        assert (adapted.hierarchy.encoder.state_dict()[name] == value).all()
    write_names(library / "run", {"option": ("reach", "grasp", "carry")})
    done("report", tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert [name for name in ("reach", "grasp", "carry") if f">{name}<" in page]
    assert not (tmp_path / "run" / "names.yaml").exists()  # they are proposed alone
    (library / "run" / "names.yaml").unlink()
    others = Demonstrations(tuple(task(5, 6)[1:]))
    assert adapted.log_likelihood(others).sum() > run.log_likelihood(others).sum()


def test_baselines_are_drawn_towards_their_own_models(library, tmp_path, monkeypatch):
    drawn = []
    begun = prior.Prior.log_density

    def watched(self, model):
        drawn.append(self.model)
        return begun(self, model)

    monkeypatch.setattr(prior.Prior, "log_density", watched)
    demonstrations = {"path": "none.hdf5", "valid_fraction": 0.3}
    text = yaml.safe_dump({"demonstrations": demonstrations, "compare_with": ["mixture"]})
    (library / "several.yaml").write_text(text)
    from ddco_pyro.fitting.library import for_new_task

    spec = for_new_task(library / "several.yaml", library / "run", ["training.library.ridge=30"])
    fitted = ddco_pyro.fit(spec, task(5, 4))
    assert {model.option_levels()[0].termination is None for model in drawn} == {True, False}
    ours = ddco_pyro.load(library / "run").baselines["mixture"].hierarchy.meta_policy.network.layers[0].weight
    found = fitted.baselines["mixture"].hierarchy.meta_policy.network.layers[0].weight
    assert float((found - ours).detach().abs().max()) < 1.0
    # no restart goes on from the mixture, which has its own prior
    assert not fitted.metrics.training.restarts.each[1:]


OTHER = "has no model with this hierarchy; take observations, control and networks"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training.library.run": "no/run"}, "no/run: not a run folder"),
        ({"hierarchy.levels.0.count": 4}, OTHER),
        ({"training.library.ridge": -1}, "training.library.ridge: must be at least 0"),
        ({"training.library.strength": 3}, "training.library.strength: unknown key"),
        ({"demonstrations.path": "{folder}/wide.hdf5"}, "actions: has shape 3 at each step, and in"),
    ],
)
def test_what_cannot_begin_with_a_library_is_refused_in_one_line(library, tmp_path, changes, message):
    wide = [replace(demo, actions=np.tile(demo.actions[:, :1], (1, 3))) for demo in task(5, 1)]
    Demonstrations(tuple(wide)).write(library / "wide.hdf5")
    settings = [f"--set={key}={value}".replace("{folder}", str(library)) for key, value in changes.items()]
    out = tmp_path / "run"
    places = ("--library", library / "run", "--out", out)
    refused(message, "fit", library / "new.yaml", *places, "--jobs", 1, *settings)
    assert not out.exists()


def test_a_library_of_one_task_says_that_a_strength_is_needed(tmp_path):
    ddco_pyro.fit(with_overrides(SPEC, {"compare_with": []}), task(0, 4), out=tmp_path / "run")
    new = tmp_path / "new.yaml"
    Demonstrations(tuple(task(1, 1))).write(tmp_path / "new.hdf5")
    new.write_text(yaml.safe_dump({"demonstrations": {"path": str(tmp_path / "new.hdf5")}}))
    places = ("--library", tmp_path / "run", "--out", tmp_path / "new")
    refused("training.library.ridge=30", "fit", new, *places, "--jobs", 1)
    assert not (tmp_path / "new").exists()
