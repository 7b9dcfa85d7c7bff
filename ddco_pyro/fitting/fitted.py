"""The fitted model :class:`Fit`, and ``ddco_pyro.load``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, unknown
from ddco_pyro.data.likeness import Traits, Usual, reasons_told, unlike
from ddco_pyro.errors import BadInput, path_of
from ddco_pyro.evaluation.inferred import Inferred, Segmentation, infer
from ddco_pyro.fitting.digest import record, recorded, usual_of
from ddco_pyro.fitting.draws import Draws, draw
from ddco_pyro.fitting.names import Named, checked, read_names, write_names
from ddco_pyro.fitting.run import is_finished, read_model
from ddco_pyro.inference import Posterior
from ddco_pyro.metrics import Metrics
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.names import choice_names
from ddco_pyro.spec import Spec, SpecError, load_spec, user_code
from ddco_pyro.training.data import demonstrations as read_demonstrations
from ddco_pyro.training.networks import model_name, named_baselines

TOLERANCE = 1e-4
"""Relative; a log-likelihood computed again on another machine differs in the last digits of float32."""


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """A fitted model.

    >>> fit.spec.hierarchy.levels[0].count, sorted(fit.baselines), fit.metrics.demonstrations.valid
    (2, ['flat'], 1)

    :param metrics: the contents of ``metrics.json``; None of a model that was not evaluated.
    :param folder: the run folder; None where nothing was written.
    :param given: the demonstrations of the fit; None for those that the spec names.
    :param beside: the fitted baselines, by name; None for those in the run folder.
    :param apart: models that were trained without a demonstration, by its name
        (``demonstrations.hold_out_by``); None for those in the run folder.
    :param named: the names of the options of each level that has names; :meth:`name_options` changes them.
    """

    spec: Spec
    hierarchy: Hierarchy
    metrics: Metrics = field(default=cast(Metrics, None), repr=False)
    folder: Path | None = None
    given: Demonstrations | None = field(default=None, repr=False)
    beside: Mapping[str, Fit] | None = field(default=None, repr=False)
    apart: Mapping[str, Hierarchy] | None = field(default=None, repr=False)
    named: Named = field(default_factory=dict, repr=False)

    @property
    def place(self) -> str:
        """The run folder, or ``this fit`` without one, for messages."""
        return str(self.folder or "this fit")

    def __str__(self) -> str:
        sizes = [f"{name}: {', '.join(choices[1:])}" for name, choices in self.names.items()]
        lines = [f"{self.name}{f' in {self.folder}' if self.folder else ''}", *sizes]
        if self.metrics is not None:
            counts, values = self.metrics.demonstrations, self.metrics.log_likelihood_per_step
            each = {"trained with": (counts.train, values.train), "held out": (counts.valid, values.valid)}
            known = {part: pair for part, pair in each.items() if pair[1] is not None}
            said = [f"{value:.3f} ({number} {part})" for part, (number, value) in known.items()]
            lines.append(f"log-likelihood, nats per step: {', '.join(said)}")
        return "\n  ".join(lines)

    __repr__ = __str__

    @property
    def run_folder(self) -> Path:
        """The run folder.

        :raises BadInput: the fit has none.
        """
        if self.folder is None:
            raise BadInput("this fit has no run folder; fit with out=FOLDER, which this needs")
        return self.folder

    @property
    def name(self) -> str:
        """The name of the model in tables."""
        return model_name(self.spec)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """The name of each choice of each level, lowest first: ``control``, then the options 1 to k."""
        return {one.name: choice_names(one.count, self.named.get(one.name, ())) for one in self.spec.levels}

    def name_options(self, level: str, names: Sequence[str]) -> None:
        """Name the options 1 to k of a level, in ``names.yaml`` of the run folder too.

        >>> fit.name_options("option", ["go there", "go back"])
        >>> fit.names["option"]
        ('control', 'go there', 'go back')

        :raises BadInput: there is no such level, or the names are not k different texts.
        """
        self.named.update(checked(self.spec, {**self.named, level: names}))
        if self.folder is not None:
            write_names(self.folder, self.named)

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """The demonstrations of the fit, training and held out; those of a run are read when asked for.

        :raises BadInput: their file holds other demonstrations.
        """
        if self.given is not None:
            return self.given
        demos = read_demonstrations(self.spec)
        if self.folder is not None:
            record(self.folder, demos)
        return demos

    @cached_property
    def usual(self) -> Usual | None:
        """What the fit's demonstrations have in common; None without a folder and without demonstrations."""
        kept = None if self.folder is None else recorded(self.folder)
        if kept is None and self.given is None:
            return None
        return (kept and kept.usual) or usual_of(self.demonstrations)

    def unlike(
        self, known: Sequence[Traits], nats: Mapping[str, float], frequency: float | None
    ) -> list[str]:
        """A line for each reason why demonstrations are unlike those of the fit.

        :param nats: log p(ξ) per step of each, by name. It is unusual if it lies below that of the fit's by
            their whole range, and a nat for each control dimension: a control one σ farther off costs that.
        :param frequency: control steps per second, Hz; None if unknown.
        """
        reasons = {} if self.usual is None else unlike(known, self.usual, frequency)
        fitted = [row.log_likelihood_per_step[self.name] for row in self.metrics.demonstrations_by_likelihood]
        low, high = min(fitted), max(fitted)
        less = [name for name in nats if nats[name] < 2 * low - high - self.hierarchy.scaling.size]
        median = np.median([nats[name] for name in less] or [0])
        why = f"{median:.1f} nats a step, and {low:.1f} to {high:.1f} in the fit"
        return reasons_told(dict.fromkeys(less, why) | reasons, len(nats))

    @cached_property
    def baselines(self) -> Mapping[str, Fit]:
        """The fitted baselines, by name."""
        if self.beside is not None or self.folder is None:
            return self.beside or {}
        folders = [self.folder / "baselines" / name for name in named_baselines(self.spec)]
        allow_code = bool(user_code(self.spec))  # the spec names theirs too
        return {folder.name: load(folder, allow_code) for folder in folders if is_finished(folder)}

    @property
    def best(self) -> Fit:
        """The model of the run to act with: the likeliest on held-out demonstrations.

        It is a baseline only where that leads this model by more than one standard error.

        :raises BadInput: no demonstrations were held out, or the leads have no standard error.
        """
        leads = {name: one.difference for name, one in self.metrics.comparison.items()}
        if not self.metrics.valid or any(lead.standard_error is None for lead in leads.values()):
            raise BadInput(
                f"{self.place}: fewer than two demonstrations were held out, so no model is known to be the "
                "best; leave out --best, or fit with a larger demonstrations.valid_fraction"
            )
        ahead = [name for name, lead in leads.items() if -lead.nats_per_step > (lead.standard_error or 0.0)]
        best = min(ahead, key=lambda name: leads[name].nats_per_step, default=None)
        return self if best is None else self.baselines[best]

    @cached_property
    def repetitions(self) -> tuple[Fit, ...]:
        """The fits with other training seeds, of ``fit --seeds``."""
        if self.metrics is None or self.metrics.seeds is None:
            return ()
        allow_code = bool(user_code(self.spec))
        seeds = self.metrics.seeds.training_seeds[1:]
        return tuple(load(self.run_folder / "seeds" / str(seed), allow_code) for seed in seeds)

    @cached_property
    def without(self) -> Mapping[str, Hierarchy]:
        """The model without each demonstration, by its name; empty unless each is held out."""
        if self.apart is not None or self.folder is None or not self.spec.demonstrations.holds_out_each:
            return self.apart or {}
        places = left_out(self.folder, self.demonstrations)
        return {name: read_model(place, self.spec) for name, place in places.items()}

    @cached_property
    def held_out(self) -> dict[str, float]:
        """log p(ξ) of each held-out demonstration by name, computed when it was fitted, nats."""
        return {row.name: row.log_likelihood for row in self.metrics.valid}

    def was_held_out(self, name: str, log_likelihood: float) -> bool:
        """Whether a demonstration is among the held-out ones: the name and the log-likelihood are equal."""
        known = self.held_out.get(name, np.nan)
        return bool(np.isclose(known, log_likelihood, rtol=TOLERANCE, atol=TOLERANCE))

    def infer(self, demos: Iterable[Demonstration], held_out: bool = False) -> Iterator[Inferred]:
        """The model's outputs, posteriors and paths for demonstrations in order, in pieces that fit memory.

        >>> for piece in fit.infer(demos):
        ...     print(piece.log_likelihood.shape, piece.posterior.u[0].shape, piece.path.choices[0].shape)
        (6,) torch.Size([6, 10, 3]) torch.Size([6, 10])

        :param demos: :class:`~ddco_pyro.Demonstrations`, or an iterable that reads one after the other.
        :param held_out: with ``demonstrations.hold_out_by: demonstration``, each by the model trained without
            it.
        :raises DemonstrationsError: there are none, an observation or the control has another shape than in
            the fit, or a number is too large for networks.
        """
        if not (held_out and self.without):
            yield from infer(self.hierarchy, demos)
        else:
            for demo in demos:
                if demo.name not in self.without:
                    others = unknown(demo.name, self.without)
                    raise BadInput(f"{demo.name}: no model was trained without it; {others}")
                yield from infer(self.without[demo.name], [demo])

    def log_likelihood(self, demos: Iterable[Demonstration]) -> np.ndarray:
        """log p(ξ) of each demonstration, nats, [N]; the density is in the control's own units.

        >>> fit.log_likelihood(demos).shape
        (6,)
        """
        return np.concatenate([piece.log_likelihood for piece in self.infer(demos)])

    def posterior(self, demos: Iterable[Demonstration]) -> Posterior:
        """u, v and w of §4.1 for every level, each [N, T, 1 + k] with control as choice 0.

        >>> (u,) = fit.posterior(demos).u
        >>> u.shape, float(u[0, 0].sum().round(decimals=6))
        (torch.Size([6, 10, 3]), 1.0)
        """
        parts = [piece.posterior for piece in self.infer(demos)]
        kinds = (zip(*kind, strict=True) for kind in zip(*parts, strict=True))
        return Posterior(*(tuple(map(_stacked, levels)) for levels in kinds))

    def refuse_flat(self) -> None:
        """Refuse a policy without options.

        :raises BadInput: this is one.
        """
        if self.spec.hierarchy is None:
            why = f"is a {self.name} policy without options; name a run that has options"
            raise BadInput(f"{self.place}: {why}")

    def segment(self, demos: Iterable[Demonstration]) -> tuple[Segmentation, ...]:
        """Choices of the most likely path, for each level, lowest first: of each demonstration an array [T].

        >>> (options,) = fit.segment(demos)
        >>> len(options), options[0].shape, options.names[0]
        (6, (10,), 'control')
        >>> segment = options.segments[0]  # pandas.DataFrame(options.segments) is a table
        >>> segment.demonstration, segment.name == options.names[segment.option], segment.start
        ('demo_0', True, 0)

        :raises DemonstrationsError: as :meth:`infer`.
        """
        names: list[str] = []
        found: list[list[tuple[np.ndarray, np.ndarray]]] = []
        for piece in self.infer(demos):
            names += piece.names
            found += map(piece.segmented, range(len(piece.names)))
        return tuple(
            Segmentation(name, tuple(names), known, *zip(*own, strict=True))
            for own, (name, known) in zip(zip(*found, strict=True), self.names.items(), strict=True)
        )

    def draws(self, demos: Sequence[Demonstration], draws: int = 100, seed: int = 0) -> Draws:
        """Draws of the options from their posterior p(ζ | ξ), from this fit and its :attr:`repetitions`.

        >>> draws = fit.draws(demos, draws=50)
        >>> draws.options["option"].shape  # chain, draw, demonstration, step
        (1, 50, 6, 10)
        >>> path, *_ = fit.segment(demos)[0]
        >>> [boundary.step for boundary in draws.boundaries("option", 0, path)] == (
        ...     np.flatnonzero(np.diff(path)) + 1
        ... ).tolist()
        True

        :param draws: from each model.
        :raises BadInput: the model has no options.
        """
        self.refuse_flat()
        fits = (self, *self.repetitions)
        seeds = [fit.spec.seed if (own := fit.spec.training.seed) is None else own for fit in fits]
        return draw([fit.infer(demos) for fit in fits], self.names, seeds, draws, seed)

    def controller(self, seed: int = 0) -> Controller:
        """The model as a policy that acts, as the spec's ``rollout`` says."""
        rollout = self.spec.rollout
        return Controller(self.hierarchy, rollout.control, rollout.options, seed, self.names)

    def monitor(self) -> Monitor:
        """A live monitor of the active options while another policy, or a person, acts."""
        return Monitor(self.hierarchy, self.names)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Parts [N_i, T_i, ...] stacked along N, padded with zeros to the longest."""
    return torch.nn.utils.rnn.pad_sequence([row for part in parts for row in part], batch_first=True)


def left_out(folder: Path, demos: Demonstrations) -> dict[str, Path]:
    """The folder of the model without each demonstration, by its name."""
    return {name: folder / "left_out" / str(number) for number, name in enumerate(demos.names)}


def load(folder: str | Path, allow_code: bool = False, overrides: Iterable[str] = ()) -> Fit:
    """The fit in a run folder.

    >>> again = ddco_pyro.load("runs/mine")
    >>> again.metrics == fit.metrics, (again.log_likelihood(demos) == fit.log_likelihood(demos)).all()
    (True, np.True_)

    :param allow_code: import the user code (``module:name``) that its spec names; nothing else in a run is
        ever executed.
    :param overrides: other settings of the report, such as ``"report.trajectory=pose"``.
    :raises BadInput: the folder has no finished fit, or one of another format; or the model, or
        ``names.yaml``, is of another spec.
    :raises Damaged: the model or ``metrics.json`` is damaged.
    :raises SpecError: its spec names user code unallowed, or an override is no setting of the report.
    """
    folder = path_of(folder, "folder")
    files = ("spec.yaml", "model.safetensors", "metrics.json")
    missing = [name for name in files if not (folder / name).exists()]
    if missing:
        unfinished = "an unfinished run: fit it again to continue it"
        what = "not a run folder" if "spec.yaml" in missing else unfinished
        if (folder / "folds.json").exists():
            what = f"a selection; the fit of what it chose is in {folder / 'fit'} once it is done"
        raise BadInput(f"{folder}: {what} (it has no {missing[0]})")
    recorded(folder)  # or the format is another, and so are the keys of the spec
    fitted, spec = (load_spec(folder / "spec.yaml", those, allow_code) for those in ((), overrides))
    if spec.model_copy(update={"report": fitted.report}) != fitted:
        why = "only settings of the report can change, such as report.trajectory=KEY"
        raise SpecError(f"{folder}: is fitted; {why}")
    hierarchy = read_model(folder, spec)
    metrics = Metrics.read(folder, [level.count for level in spec.levels])
    return Fit(spec, hierarchy, metrics, folder, named=read_names(folder, spec) or {})
