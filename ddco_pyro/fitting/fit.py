"""``ddco_pyro.fit``: train a model and its baselines, evaluate them, and write the run folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import only_one
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.labels import label_names
from ddco_pyro.errors import BadInput, path_of
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.fitting.digest import record, recorded
from ddco_pyro.fitting.evaluation import evaluate
from ddco_pyro.fitting.fitted import Fit, left_out, load
from ddco_pyro.fitting.library import check_library, dimensions_for, prior_of
from ddco_pyro.fitting.names import accepted, read_names, write_names
from ddco_pyro.fitting.run import Clock, claim, claimed, is_finished, write_model
from ddco_pyro.inference import compile_all
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Metrics, Seeds, write_table
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec, load_spec, with_overrides
from ddco_pyro.training.data import demonstrations as read_demonstrations
from ddco_pyro.training.data import known_demonstrations, refuse_unfit, seen, train_and_valid
from ddco_pyro.training.labels import used
from ddco_pyro.training.networks import check_models, check_networks, model_name
from ddco_pyro.training.optimizers import optimizer_of
from ddco_pyro.training.processes import Ranks, device_of, repeatable
from ddco_pyro.training.restarts import train_model, training_began

ALONE = Workers(1)
"""This process."""


def fit(
    spec: Spec | str | Path,
    demonstrations: Iterable[Demonstration] | str | Path | None = None,
    out: str | Path | None = None,
    on_event: OnEvent = ignore,
    jobs: int = 1,
    resume: bool = True,
    keep: bool = True,
) -> Fit:
    """Fit a spec's hierarchy and its baselines to demonstrations, and evaluate them.

    >>> import numpy as np
    >>> random = np.random.default_rng(0)
    >>> def demonstration(n):  # to the place, then away from it
    ...     place = random.normal(size=(10, 2))
    ...     controls = place * np.repeat([[-2.0], [2.0]], 5, 0)
    ...     return ddco_pyro.Demonstration(f"demo_{n}", {"place": place}, controls)
    >>> demos = ddco_pyro.Demonstrations(tuple(demonstration(n) for n in range(6)))
    >>> fit = ddco_pyro.fit("mine.yaml", demos)
    >>> fit.metrics.demonstrations
    Counts(train=4, tune=1, valid=1, left_out=False, supervisor={})
    >>> ddco_pyro.fit("mine.yaml", demos, out="runs/mine").folder.as_posix()
    'runs/mine'

    :param spec: a spec, or its YAML file; one that names user code is given by ``load_spec(path,
        allow_code=True)``.
    :param demonstrations: in memory, in any order, or the HDF5 file to use instead of
        ``demonstrations.path``; None for those that the spec names.
    :param out: the run folder, as ``ddco-pyro fit`` makes it, with a copy of demonstrations from memory; None
        to write nothing. An unfinished run is continued; a finished one is loaded.
    :param on_event: called with progress events (:mod:`ddco_pyro.events`), such as
        :class:`ddco_pyro.Progress`.
    :param jobs: processes that train side by side: restarts, or the model, its baselines and the models
        without each demonstration. -1 is one on each core, 1 this process alone. The result is the same for
        any number. In a script, more than one needs the usual ``if __name__ == "__main__":``.
    :param resume: whether ``out`` may hold the finished run.
    :param keep: whether ``out`` has a copy of demonstrations from memory; False where the spec's file has
        them.
    :raises BadInput: there is no such number of jobs, ``torchrun`` started too many processes, or the folder
        holds something else, such as a run of other demonstrations.
    :raises SpecError: something in the spec does not fit the demonstrations.
    :raises DemonstrationsError: the demonstrations cannot be used.
    :raises TrainingError: training stopped; the checkpoints stay.
    """
    spec = spec if isinstance(spec, Spec) else load_spec(spec)
    folder = None if out is None else path_of(out, "out")
    processes, shards = Ranks.here().size, spec.training.shards
    if processes > shards:
        raise BadInput(
            f"torchrun started {processes} processes, but a minibatch is cut into training.shards={shards}; "
            f"add --set training.shards={processes} (results depend on the shards, not on the processes)"
        )
    workers = Workers(jobs) if processes == 1 else ALONE  # torchrun's others train along
    clock, given = Clock(), None
    with clock("demonstrations"):
        if isinstance(demonstrations, Iterable) and not isinstance(demonstrations, str | Demonstrations):
            demonstrations = Demonstrations(tuple(demonstrations))
        if isinstance(demonstrations, Demonstrations):
            names = sorted(demonstrations.names, key=natural)  # as they are read back
            ordered = demonstrations.select(names)
            given = replace(ordered, masks=demonstrations.masks)
            if keep and folder is not None:
                spec = with_overrides(spec, {"demonstrations.path": str(folder / "demonstrations.hdf5")})
            demos: Demonstrations | None = seen(spec, given)
        else:
            if demonstrations is not None:
                path = str(path_of(demonstrations, "demonstrations"))
                spec = with_overrides(spec, {"demonstrations.path": path})
            demos = known_demonstrations(spec)
        models = check_models(spec, dimensions_for(spec, demos))
        for its, _ in models.values():
            check_library(its)
        if demos is not None:
            refuse_unfit(spec, demos)
            used(spec, demos)
            label_names(demos.attributes)
    with ExitStack() as stack:  # all checks are done: from here on files are written
        if folder is not None:
            stack.enter_context(claimed(folder, spec, resume))
            read_names(folder, spec)  # or they are refused
        finished = folder is not None and is_finished(folder)
        if demos is None and not finished:
            with clock("demonstrations"):
                demos = read_demonstrations(spec, on_event)
            # the control decides the baselines too
            models = check_models(spec, dimensions_for(spec, demos))
        if folder is not None:
            if demos is not None:
                record(folder, demos)
            if keep and given is not None and not (kept := folder / "demonstrations.hdf5").exists():
                given.write(kept)
            if finished:
                return replace(load(folder, allow_code=True), given=demos)  # the caller has this very spec
        assert demos is not None
        return _fit_models(models, demos, folder, on_event, workers, clock)


def _fit_models(
    models: Mapping[str, tuple[Spec, Hierarchy]],
    demos: Demonstrations,
    folder: Path | None,
    on_event: OnEvent = ignore,
    workers: Workers = ALONE,
    clock: Clock | None = None,
    name: str | None = None,
) -> Fit:
    """Train a model and its baselines, evaluate it, and write its folder.

    :param models: specs and networks by name: of the model, then of its baselines.
    :param name: of a baseline, in events.
    """
    clock = clock or Clock()
    spec, *_ = next(iter(models.values()))
    specs = {other: its for other, (its, _) in list(models.items())[1:]}
    split, size = train_and_valid(spec, demos), dimensions_for(spec, demos)
    # the model chooses the recogniser of all
    labels = {other: its.training.labels for other, its in specs.items()}
    later = {other for other, own in labels.items() if own and own.recogniser == "cross_validated"}

    def baseline(other: str) -> Callable[..., Fit]:
        place = folder and folder / "baselines" / other
        return partial(fit_beside, other, specs[other], demos, place)

    # several long restarts share the processes among themselves
    short = len(spec.training.starts) == 1 or all(_over_all(*model) for model in models.values())
    possible = [other for other in specs if short and other not in later]
    beside = [other for other in possible if _worth_a_process(*models[other], demos)]
    if beside:
        compile_all()
    calls = {other: baseline(other) for other in beside}
    waiting = {other: training_began(specs[other], other) for other in beside}
    with run_all(calls, workers, "trained a baseline", on_event, True, True, waiting) as fitted_beside:
        with clock("training"):
            free, checkpoints = max(1, workers.number() - len(beside)), folder and folder / "checkpoints"
            prior, valid = prior_of(spec, Workers(free)), split.get("valid")
            trained = train_model(spec, size, split["train"], on_event, checkpoints, valid, name, free, prior)
        specs |= {other: _with_recogniser(specs[other], trained.summary["recogniser"]) for other in later}
        with clock("baselines"):
            here = {other: baseline(other)(on_event, workers) for other in specs if other not in beside}
            fits = here | dict(fitted_beside)
    by_name = {other: replace(fits[other], given=demos) for other in specs}
    contained = [other for other in by_name if _contains(spec, specs[other])]
    with clock("training"):
        for other in contained:
            trained.contain(by_name[other].hierarchy, by_name[other].metrics.training.objective)
        hierarchy = trained.hierarchy
        if folder:
            columns = ("restart", "stage", "epoch", "train", "tune")
            write_table(folder / "history.csv", columns, trained.history)
            write_model(folder, hierarchy)
        alone = workers if _worth_a_process(spec, hierarchy, demos) else ALONE
        apart = _without_each(spec, demos, folder, on_event, alone)
    fitted = Fit(spec, hierarchy, folder=folder, given=demos, beside=by_name, apart=apart)
    with clock("evaluation"), repeatable(hierarchy.device):
        metrics = evaluate(fitted, trained, size, split, contained, name is None)
        named = read_names(folder, spec) if folder else None
        if named is None:
            named = accepted(spec, metrics.named_by_labels)
            if folder and named:
                write_names(folder, named)
    metrics.seconds = clock.seconds
    if folder:
        metrics.write(folder)
    return replace(fitted, metrics=metrics, named=named)


def _contains(spec: Spec, baseline: Spec) -> bool:
    """Whether a hierarchy contains a baseline, a mixture of the same policies, trained in the same way."""
    if spec.hierarchy is None or baseline.hierarchy is None or spec.training.library is not None:
        return False  # of a library the two have priors of their own
    return baseline.training == spec.training and baseline.control == spec.control


def _with_recogniser(baseline: Spec, chosen: Mapping[str, Any]) -> Spec:
    """A baseline's spec with the model's recogniser, which leaves the policies and what lasts to differ.

    :param chosen: of :class:`~ddco_pyro.metrics.Recogniser`.
    """
    own = {"weight": chosen["weight"], "ridge": chosen["ridge"]}
    changes = {"control.power": chosen["power"], "training.labels.recogniser": own}
    return with_overrides(baseline, changes)


def _without_each(
    spec: Spec, demos: Demonstrations, folder: Path | None, on_event: OnEvent, workers: Workers
) -> dict[str, Hierarchy]:
    """The model trained without each demonstration, by its name; each is a fit that holds one out."""
    if not spec.demonstrations.holds_out_each:
        return {}
    alone = with_overrides(spec, {"demonstrations.hold_out_by": None, "compare_with": []})
    places = left_out(folder, demos) if folder else {}
    calls = {}
    for name in demos.names:
        others = replace(demos, masks={"valid": (name,)})
        title = f"{model_name(spec)} without {name}"
        calls[name] = partial(fit_beside, title, alone, others, places.get(name))
    with run_all(calls, workers, "trained without a demonstration", on_event) as trained:
        fits = dict(trained)
    return {name: fits[name].hierarchy for name in demos.names}


def fit_beside(
    name: str,
    spec: Spec,
    demos: Demonstrations,
    folder: Path | None,
    on_event: OnEvent = ignore,
    workers: Workers = ALONE,
) -> Fit:
    """The fit of a baseline, of a fold, or without a demonstration: loaded where it is done.

    It is without demonstrations, which another process need not send back.

    :param name: of the model in events.
    :param folder: two below that of the run or selection, which has a digest of the same demonstrations.
    """
    if folder:
        claim(folder, spec)
        record(folder, demos, recorded(folder.parent.parent))
        if is_finished(folder):
            return load(folder, allow_code=True)
    models = {name: (spec, check_networks(spec, dimensions_for(spec, demos)))}
    return replace(_fit_models(models, demos, folder, on_event, workers, name=name), given=None)


# --- other training seeds -----------------------------------------------------------------------------------


def training_seeds(spec: Spec, seeds: int) -> list[int]:
    """The training seeds of a fit and its repetitions: the spec's own, and the numbers after it.

    :raises BadInput: no demonstrations are held out, or the last seed is too large.
    """
    if not spec.demonstrations.validates:
        raise BadInput("--seeds compares on held-out demonstrations; raise demonstrations.valid_fraction")
    first = spec.seed if spec.training.seed is None else spec.training.seed
    with_overrides(spec, {"training.seed": first + seeds - 1})
    return list(range(first, first + seeds))


def repeat(first: Fit, seeds: int, on_event: OnEvent = ignore, jobs: int = 1) -> Fit:
    """Repeat a fit and its baselines with other training seeds, ``seeds`` in all.

    Each repetition is a run in ``seeds/SEED`` of the run folder; a finished one is not done again.

    :param jobs: processes that fit side by side; -1 is one for each core. Any number gives the same result.
    :returns: the fit, with the results of all repetitions in ``metrics.seeds`` and ``metrics.json``.
    :raises Failed: a process died.
    """
    folder, (own, *others) = first.run_folder, training_seeds(first.spec, seeds)
    found = {own: first.metrics}
    with only_one(folder):
        calls = {seed: partial(_again, first.spec, seed, folder / "seeds" / str(seed)) for seed in others}
        with run_all(calls, Workers(jobs), "repeated the fit") as repeated:
            for seed, metrics in repeated:
                found[seed] = metrics
                on_event(Counted("fitting with other training seeds", len(calls)))
        each = [found[seed] for seed in (own, *others)]
        worth = [metrics.worth.parts if metrics.worth else {} for metrics in each]
        models = {first.metrics.model: each} | {
            name: [metrics.comparison[name] for metrics in each] for name in first.metrics.comparison
        }
        values = {name: [one.log_likelihood_per_step for one in them] for name, them in models.items()}
        held_out = {name: [own.valid for own in them] for name, them in values.items()}
        nats = {part: [parts[part].nats_per_step for parts in worth] for part in worth[0]}
        errors = {part: [parts[part].standard_error for parts in worth] for part in worth[0]}
        about = {"training_seeds": [own, *others], "held_out": held_out, "worth": nats}
        about["standard_error"] = errors
        first.metrics.seeds = Seeds.model_validate(about)
        first.metrics.write(folder)
    return first


def _again(spec: Spec, seed: int, folder: Path) -> Metrics:
    return fit(with_overrides(spec, {"training.seed": seed}), None, folder).metrics


# --- in other processes -------------------------------------------------------------------------------------

LONG = 1000
"""Gradient steps, at least, of a training that takes longer than starting a process."""
MANY = 50_000
"""Steps of demonstrations, at least, for the same where each step of a training is over all of them."""
LITTLE = 256e6
"""Bytes of demonstrations, at most, that another process gets a copy of."""


def _over_all(spec: Spec, networks: Hierarchy) -> bool:
    """Whether each step is over all demonstrations: such trainings are short."""
    return optimizer_of(spec.training.optimizer, networks) in ("em", "lbfgs")


def _worth_a_process(spec: Spec, networks: Hierarchy, demos: Demonstrations) -> bool:
    """Whether training takes long, on a CPU and on demonstrations that are small and in memory."""
    own, arrays = spec.training, [array for demo in demos for array in demo.observations.values()]
    steps = math.inf if own.epochs is None else own.epochs * math.ceil(len(demos) / own.batch_size)
    long = sum(map(len, demos)) >= MANY if _over_all(spec, networks) else steps >= LONG
    sizes = [array.nbytes if isinstance(array, np.ndarray) else math.inf for array in arrays]
    return device_of(own).type == "cpu" and sum(sizes) < LITTLE and long
