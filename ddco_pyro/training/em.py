"""Expectation-maximisation (§4.1) for hierarchies whose networks are linear: exact E-steps, closed or Newton
M-steps.

Every output of a network is z = W^T x, where x has a 1 at its end. One backward pass of the exact
log-likelihood gives its gradient g in every output, and the posterior in every table (the E-step). The M-step
then solves, for each network,

    (Σ_t h_t x_t x_t^T + R) (W' - W) = Σ_t x_t g_t^T - R W

where h is the information that the posterior expects of an output and R a ridge. With a library W - W0 stands
for W on the right (:class:`~ddco_pyro.training.prior.Prior`). For the mean of a Gaussian, clipped or not,
this is the weighted least squares of the M-step (for a clipped one: of the censored moments, by Fisher's
identity). For switches and terminations it is one Fisher scoring step. For categories and gates h is at least
Fisher's information, one matrix for each output in place of one for each pair. σ follows in closed form.

Steps are overrelaxed (Salakhutdinov and Roweis 2003): as long as each raises the penalised log-likelihood,
the next is longer. A step that lowers it is halved, and the next one is EM's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.controls import ABOVE_FLOOR, raw_of
from ddco_pyro.model.emissions import Emission, Information
from ddco_pyro.model.emissions.base import over_dimensions
from ddco_pyro.model.hierarchy import Caller, Hierarchy
from ddco_pyro.model.networks.inputs import Inputs
from ddco_pyro.model.networks.perceptrons import Mlp, StackedLinear
from ddco_pyro.model.outputs import TERMINATION_BOUND, CallerOutputs, Outputs
from ddco_pyro.model.tables import Tables, by_step, by_trajectory
from ddco_pyro.spec import RidgeSpec

if TYPE_CHECKING:
    from ddco_pyro.training.prior import Prior

LARGEST = 3.0
"""The most that a weight of a logit changes in a step: where the curve is flat, Fisher scoring overshoots."""
GROWTH = 1.3
"""The ratio of a step's stretch to the last one's, where that raised the penalised log-likelihood."""
FARTHEST = 8.0
"""The most that a step is stretched."""
HALVINGS = 10
"""How often a step that lowers the penalised log-likelihood is halved before it is given up."""
TOLERANCE = 1e-5
"""EM has converged where a step gains less, in nats per step of the demonstrations."""
ROUGHLY = 1e-3
"""The same in a stage whose end is a start alone."""
MOST = 100_000
"""The most steps that such a stage learns from, of demonstrations spread evenly over their lengths."""
BLOCK, NARROWEST = 65536, 16
"""Products of features that are computed at once: they stay in the cache. The least steps of them."""
BIAS = 1e-6
"""Ridge of biases, and the least of weights: an option that is never active keeps its own."""

Array = np.ndarray
Score = Callable[[Tables, Batch, Tensor], Tensor]
"""What is maximised of a piece of the demonstrations, nats: its tables, itself, and its rows."""


class Features:
    """The features of a piece of the demonstrations. What networks say of a step is float32, as they compute
    it, and so are gradients of a piece. Sums over pieces, and the matrices that are solved, are float64.

    :param reads: the vectors that networks read; none for constants.
    :ivar x: the vectors with a 1 at the end, [F, T·N].
    """

    def __init__(self, inputs: Inputs, reads: Sequence[str]) -> None:
        vectors = by_step(inputs.joined(reads))
        self.shape = vectors.shape[1:]
        self.x = torch.cat([vectors, torch.ones(1, *self.shape)]).flatten(1)

    def outputs(self, weights: Sequence[Array]) -> list[Tensor]:
        """W^T x of networks with weights [K, F, n] each: [N, T, K, n] each."""
        rows = np.concatenate([own.swapaxes(1, 2).reshape(-1, len(self.x)) for own in weights])
        said = (torch.from_numpy(rows).to(self.x) @ self.x).numpy()
        parts = _parts(said.reshape(-1, *self.shape), [own.shape[::2] for own in weights])
        return [by_trajectory(torch.from_numpy(part)) for part in parts]

    def gradients(self, of: Sequence[Tensor]) -> list[Array]:
        """Σ_t x_t g_t^T of the gradients of the outputs of networks, [N, T, K, n] each: [K, F, n] each."""
        sums = (self.x @ self._side_by_side(of).T).T.double().numpy()
        return [part.swapaxes(1, 2) for part in _parts(sums, [own.shape[2:] for own in of])]

    def moments(self, weights: Sequence[Tensor]) -> list[Array]:
        """Σ_t h_t x_t x_t^T of weights h [N, T, K, n], none below 0: [K, n, F, F] each."""
        from ddco_pyro.inference.kernel import products  # and numba and pyro, which not every command needs

        each, x = self._side_by_side(weights).double().numpy(), self.x.numpy()
        number = len(x) * (len(x) + 1) // 2
        pairs = np.empty((number, max(NARROWEST, BLOCK // number)))
        found = np.zeros((len(each), number))
        for first in range(0, x.shape[1], pairs.shape[1]):
            own = each[:, first : first + pairs.shape[1]]
            products(x, first, pairs)
            found += own @ pairs[:, : own.shape[1]].T  # torch's own takes twice as long
        return _parts(found.take(_places(len(x)), 1), [own.shape[2:] for own in weights])

    def _side_by_side(self, each: Sequence[Tensor]) -> Tensor:
        """Numbers of networks, [N, T, K, n] or [N, T, K] each, one after the other: [columns, T·N]."""
        return torch.cat([by_step(own).reshape(-1, self.x.shape[1]) for own in each])


def _parts(columns: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Numbers of networks that stand one after the other, [columns, ...], in these shapes [*shape, ...]."""
    ends = [*accumulate(map(math.prod, shapes), initial=0)]
    parts = (columns[first:last] for first, last in pairwise(ends))
    return [part.reshape(*shape, *part.shape[1:]) for part, shape in zip(parts, shapes, strict=True)]


@cache
def _places(features: int) -> Array:
    """Where a symmetric matrix [F, F] has each entry in its lower triangle, row by row."""
    places, lower = np.empty((features, features), np.int64), np.tril_indices(features)
    places[lower] = places[lower[::-1]] = np.arange(len(lower[0]))
    return places


@dataclass
class Sums:
    """Sums over all steps for one network.

    :ivar gradient: in W, [K, F, n].
    :ivar std: the gradient in σ, [K, C].
    :ivar groups: of outputs, by the first: the group, of the last piece, its matrix of information, and how
        many controls it stands for, [K].
    """

    gradient: Array | float = 0.0
    std: Array | float = 0.0
    groups: dict[int, tuple[Information, Array, Array]] = field(default_factory=dict)

    def add_information(self, group: Information, moments: Array) -> None:
        """Add that of a piece from the moments of its weights."""
        _, information, count = self.groups.get(group.columns.start, (None, 0.0, 0.0))
        information = information + moments
        number = group.weight if group.count is None else group.count
        self.groups[group.columns.start] = group, information, count + number.sum((0, 1)).numpy()


class Linear:
    """One network of K linear maps, its weights in float64, the bias as the last row: [K, F, n].

    :param ridge: of all outputs but those whose ridge is in units of 1/σ².
    :param library: the same network of a library, at whose weights the prior is centred; None for 0.
    """

    def __init__(
        self, network: nn.Module, ridge: float, trained: bool, library: nn.Module | None = None
    ) -> None:
        self.ridge, self.trained, self.reads = ridge, trained, tuple(cast(Mlp, network).reads)
        self.layer = _layer(network)
        self.weight = _weight(self.layer)
        self._center = np.zeros_like(self.weight) if library is None else _weight(_layer(library))

    @property
    def away(self) -> Array:
        """The weights, from the centre of their prior."""
        return self.weight - self._center

    def store(self) -> None:
        """Give the network these weights."""
        with torch.no_grad():
            self.layer.weight.copy_(torch.from_numpy(self.weight[:, :-1]))
            self.layer.bias.copy_(torch.from_numpy(self.weight[:, -1:]))


def _layer(network: nn.Module) -> StackedLinear:
    """The only layer of a linear network."""
    return cast(StackedLinear, cast(Mlp, network).layers[0])


def _weight(layer: StackedLinear) -> Array:
    return torch.cat([layer.weight.detach(), layer.bias.detach()], dim=1).double().cpu().numpy()


class Std:
    """σ of a caller's continuous dimensions, [K, C] float64, except where it depends on the state.

    :param count: how many controls the prior of σ stands for, of each copy and dimension.
    :param library: the same caller of a library, whose σ these controls have; None where ``count`` is 0.
    """

    def __init__(
        self, caller: Caller, trained: bool, count: float = 0.0, library: Caller | None = None
    ) -> None:
        assert caller.std is not None
        self.module, self.trained, self.count = caller.std, trained, count
        self.learned, self._shared = [*caller.std.own, *caller.std.shared], caller.std.shared
        self.least = caller.std.floor.double().numpy() + ABOVE_FLOOR
        self.value = _stds(caller)
        self._known = None if library is None else _stds(library)

    @property
    def penalty(self) -> float:
        """Minus the log-density of log σ under 1/σ² ~ Gamma(c/2, c s²/2), up to a constant."""
        if self._known is None:
            return 0.0
        value, known = self.value[:, self.learned], self._known[:, self.learned]
        return self.count * float((np.log(value) + 0.5 * (known / value) ** 2).sum())

    def squares(self, places: Sequence[int]) -> Array | float:
        """The sum of squares that the prior stands for, [K, C']."""
        return 0.0 if self._known is None else self.count * self._known[:, list(places)] ** 2

    def updated(self, value: Array, square: Array, count: Array, places: Sequence[int]) -> Array:
        """A table of σ [K, C] with those at these places from sums of squares [K, C'] and counts [K]."""
        columns = [column for column, place in enumerate(places) if place in self.learned]
        at = [places[column] for column in columns]
        square, value, known = square[:, columns], value.copy(), value[:, at] ** 2
        number = np.where([place in self._shared for place in at], count.sum(), count[:, None])  # [K, C']
        together = np.where([place in self._shared for place in at], square.sum(0), square)
        mean = np.divide(together, number, out=known, where=count[:, None] > 0).clip(min=0)
        value[:, at] = np.maximum(np.sqrt(mean), self.least[at])
        return value

    def store(self) -> None:
        """Give the module these values."""
        module = self.module
        with torch.no_grad():
            raw = raw_of(torch.from_numpy(self.value), module.floor)
            if module.shared:
                module.raw.copy_(raw[0, module.shared])
            if module.own:
                module.raw_own.copy_(raw[:, module.own])


def _stds(caller: Caller) -> Array:
    assert caller.std is not None
    return caller.std.table().detach().double().cpu().expand(caller.copies, -1).numpy().copy()


class Expectation:
    """EM steps of some networks of a hierarchy.

    :param trained: prefixes of the names of the parameters that change.
    :param score: what is maximised of a piece of the demonstrations.
    :param discovering: d has levels 1 to d alone under a uniform meta-policy.
    :param roughly: whether the end is a start alone, for which :data:`MOST` steps and :data:`ROUGHLY` are
        enough.
    :param prior: that of a library, in place of the ridges; None without one.
    :ivar steps: steps of the demonstrations that are learned from, once the first step has begun.
    :ivar parts: these demonstrations in pieces, with their features; none where they are to be cut again.
    :ivar value: the penalised log-likelihood of the weights that the last step began at.
    :ivar gain: the larger gain of the last two steps, nats per step; a stretched one that gains nothing may
        have gone too far.
    :ivar stretch: of the last step, 1 for EM's own.
    """

    def __init__(
        self,
        model: Hierarchy,
        trained: tuple[str, ...],
        score: Score,
        ridge: RidgeSpec,
        discovering: int | None = None,
        roughly: bool = False,
        prior: Prior | None = None,
    ) -> None:
        self.model, self._score, self._discovering, self._ridge = model, score, discovering, ridge
        self._roughly, self.steps, self._bias = roughly, 0, BIAS
        centers: Mapping[str, nn.Module] = {}
        if prior is not None and prior.ridge:
            self._ridge = RidgeSpec(policy=prior.ridge, gate=prior.ridge)
            self._bias, centers = prior.ridge, prior.model.networks()
        self._callers = model.named_callers()
        self._networks: dict[str, Linear] = {}
        for name, network in model.networks().items():
            trains = f"{name}.".startswith(trained)
            self._networks[name] = Linear(network, self._ridge.gate, trains, centers.get(name))
        known: Mapping[str, Caller] = {} if prior is None else prior.model.named_callers()
        spread = 0.0 if prior is None else prior.spread
        self._stds = {
            name: Std(caller, self._networks[name].trained, spread, known.get(name))
            for name, caller in self._callers.items()
            if caller.std is not None
        }
        self._before: dict[str, Array] | None = None
        self.parts: list[tuple[Tensor, Batch, dict[tuple[str, ...], Features]]] = []
        self.value, self.gain, self.stretch, self._last = -math.inf, math.inf, 1.0, math.inf

    @property
    def converged(self) -> bool:
        """Whether each of the last two steps gained less than :data:`TOLERANCE` (or :data:`ROUGHLY`)."""
        return self.gain < (ROUGHLY if self._roughly else TOLERANCE)

    def log_prior(self, batch: Batch) -> float:
        """The log-density of the prior of what is trained, up to a constant, nats: the same for any batch."""
        return self._penalty(self._expect(batch)[2])

    def step(self, batch: Batch) -> float:
        """One EM step over the demonstrations; their log-likelihood before the step, nats.

        All steps are over the same demonstrations, whose features are kept.
        Where the last step lowered the penalised log-likelihood, that step is halved first.
        """
        value, penalised, sums = self._expect(batch)
        stretch = min(GROWTH * self.stretch, FARTHEST)
        for halvings in range(1 + HALVINGS):
            if self._before is None or (
                halvings < HALVINGS and penalised >= self.value - 1e-9 * abs(self.value)
            ):
                break
            now, stretch = self._state(), 1.0
            half = {name: 0.5 * (old + now[name]) for name, old in self._before.items()}
            self._restore(half if halvings < HALVINGS else self._before)
            value, penalised, sums = self._expect(batch)
        gain = (penalised - self.value) / self.steps
        self.gain, self._last = max(gain, self._last), gain
        self.value, self._before = penalised, self._state()
        self.stretch = stretch if gain >= TOLERANCE else 1.0
        self._maximise(sums)
        self._extend(self._before)
        for name in sums:
            self._networks[name].store()
            if name in self._stds:
                self._stds[name].store()
        return value

    def _state(self) -> dict[str, Array]:
        weights = {name: network.weight for name, network in self._networks.items()}
        return weights | {f"{name}.std": std.value for name, std in self._stds.items()}

    def _restore(self, state: Mapping[str, Array]) -> None:
        for name, network in self._networks.items():
            network.weight = state[name]
        for name, std in self._stds.items():
            std.value = state[f"{name}.std"]

    def _extend(self, before: Mapping[str, Array]) -> None:
        """Stretch the step from these weights, in log σ."""
        for name, network in self._networks.items():
            network.weight = before[name] + self.stretch * (network.weight - before[name])
        for name, std in self._stds.items():
            old = before[f"{name}.std"]
            moved = std.value != old  # a σ that depends on the state is 0 here
            ratio = np.divide(std.value, old, out=np.ones_like(old), where=moved)
            std.value = np.where(moved, np.maximum(old * ratio**self.stretch, std.least), old)

    def _penalty(self, sums: Mapping[str, Sums]) -> float:
        """The log-density of the prior that the ridges stand for, up to a constant, of what is trained.

        That of policies counts β times, as the density of their controls does.
        """
        total = 0.0
        for name, network in self._networks.items():
            if not network.trained:
                continue
            away, log_stds = network.away, 0.0
            each = self._penalties(away, network.ridge)
            caller = self._callers.get(name)
            choices = each.shape[1] if caller is None else caller.sizes[0]
            each[:, choices:] = self._penalties(away[..., choices:], self._ridge.policy)
            for group, *_ in sums[name].groups.values():
                if group.std:
                    std, places = self._stds[name], list(group.std)
                    squares = self._penalties(away[..., group.columns], self._ridge.policy)
                    each[:, group.columns] = squares / std.value[:, places] ** 2
                    learned = [place for place in places if place in std.learned]
                    log_stds += float(np.log(std.value[:, learned]).sum())
            policy = 0.5 * float(each[:, choices:].sum()) + self._prior_count(away) * log_stds
            policy += self._stds[name].penalty if name in self._stds else 0.0
            total -= 0.5 * float(each[:, :choices].sum()) + float(self.model.power) * policy
        return total

    def _prior_count(self, weight: Array) -> int:
        """How many numbers a mean's prior N(W0, σ²/ρ) is of: the weights, and the bias of a library."""
        return weight.shape[1] - (self._bias == BIAS) if self._ridge.policy else 0

    def _penalties(self, away: Array, ridge: float) -> Array:
        """Σ_f ρ_f W_f² of each copy and output, [K, n]."""
        return (_ridges(away.shape[1], ridge, self._bias)[:, None] * away**2).sum(1)

    def _expect(self, batch: Batch) -> tuple[float, float, dict[str, Sums]]:
        """The E-step: the score, also penalised, and the sums for the M-step of each trained network."""
        total, sums = 0.0, {name: Sums() for name, network in self._networks.items() if network.trained}
        if not self.parts:
            order = batch.by_length[:: math.ceil(batch.steps / MOST) if self._roughly else 1]
            self.parts = [(*part, {}) for part in batch.parts(order, self.model.steps_at_once)]
            self.steps = int(batch.lengths[order].sum())
        for piece in self.parts:
            total += self._expect_piece(*piece, sums)
        return total, total + self._penalty(sums), sums

    def _expect_piece(
        self, rows: Tensor, piece: Batch, xs: dict[tuple[str, ...], Features], sums: dict[str, Sums]
    ) -> float:
        """The score of a piece. Its gradient in the log-tables is the posterior, from which gradients in
        logits follow. torch differentiates the densities alone.
        """
        levels, power = self.model.option_levels()[: self._discovering], float(self.model.power)
        said: dict[str, Tensor] = {}
        for reads in dict.fromkeys(network.reads for network in self._networks.values()):
            if reads not in xs:
                xs[reads] = Features(piece.inputs, reads)
            weights = {
                name: network.weight for name, network in self._networks.items() if network.reads == reads
            }
            said |= zip(weights, xs[reads].outputs([*weights.values()]), strict=True)
        stds = {name: torch.from_numpy(std.value).requires_grad_() for name, std in self._stds.items()}
        for name in stds:
            said[name].requires_grad_()
        scaling, policies = self.model.scaling, self._callers.items()
        callers = {name: caller(said[name], scaling, stds.get(name)) for name, caller in policies}
        named = [f"levels.{number}" for number in range(len(levels))]
        ends = (said.get(f"{name}.termination") for name in named)
        logits = [None if end is None else end.squeeze(-1) for end in ends]
        top = callers["meta_policy"]
        if self._discovering:
            uniform = torch.zeros(*piece.inputs.batch, 1, levels[-1].count)
            top = CallerOutputs(levels[-1].count, uniform, None)
        outputs = Outputs((*(callers[f"{name}.policy"] for name in named), top), tuple(logits), power)
        before = outputs.logits(piece.actions)
        tables = before.normalised()
        leaves = [None if leaf is None else leaf.detach().requires_grad_() for leaf in tables.leaves()]
        value = self._score(Tables.of(tables.depth, leaves, power), piece, rows)
        found = torch.autograd.grad(value, [leaf for leaf in leaves if leaf is not None], allow_unused=True)
        depth = len(levels)
        chosen, ended, acted = found[:depth], found[depth : 2 * depth], found[2 * depth :]
        every = [*(f"{name}.policy" for name in named), *([] if self._discovering else ["meta_policy"])]
        of_callers = zip(every, acted, strict=False)
        acting = {name: own for name, own in of_callers if name in stds and own is not None}
        densities = [table for name, table in zip(every, tables.control, strict=False) if name in acting]
        wanted = [leaf[name] for leaf in (said, stds) for name in acting]
        weighed = [(own * table).sum() for own, table in zip(acting.values(), densities, strict=True)]
        # weights in place of sums would import sympy
        slopes = torch.autograd.grad(weighed, wanted, allow_unused=True) if acting else ()
        halves = slopes[: len(acting)], slopes[len(acting) :]
        of, of_std = (dict(zip(acting, part, strict=True)) for part in halves)
        learned: dict[str, list[Information]] = {}
        with torch.no_grad():
            selecting = (name for name in every if callers[name].options)
            for name, posterior, table in zip(selecting, chosen, tables.selection, strict=False):
                if name in sums and posterior is not None and self._callers[name].sizes[0]:
                    asked, p = over_dimensions(posterior), table.exp()
                    columns = slice(0, self._callers[name].sizes[0])
                    of.setdefault(name, torch.zeros_like(said[name]))
                    of[name][..., columns] = (posterior - asked.unsqueeze(-1) * p)[..., -columns.stop :]
                    learned[name] = [Information.of_logits(columns, asked, p[..., -columns.stop :])]
            for name, own in acting.items():
                if name in sums:
                    of[name][..., self._callers[name].sizes[0] :] /= power  # M-steps of policies know none
                    emission = callers[name].emission
                    assert emission is not None  # it has parameters
                    caller, emission = self._callers[name], emission.map(Tensor.detach)
                    groups = _emitted(caller, emission, said[name].detach(), own / power, piece.actions)
                    learned.setdefault(name, []).extend(groups)
            for prefix, end, logit in zip(named, ended, before.termination, strict=True):
                name = f"{prefix}.termination"
                if name in sums and end is not None:
                    slope = 1 - (logit[..., 1:] / TERMINATION_BOUND).square()
                    ending = logit[..., 1:].sigmoid()
                    asked = end[..., :1] + end[..., 1:]
                    of[name] = (end[..., 1:] - asked * ending) * slope
                    learned[name] = [Information(slice(0, 1), asked * ending * (1 - ending) * slope.square())]
            for reads, x in xs.items():
                its = [name for name in of if name in sums and self._networks[name].reads == reads]
                if not its:
                    continue  # none of those that read these vectors is trained
                gradients = x.gradients([of[name] for name in its])
                pairs = [(name, group) for name in its for group in learned.get(name, ())]
                moments = x.moments([group.weight for _, group in pairs])
                for name, gradient in zip(its, gradients, strict=True):
                    sums[name].gradient = sums[name].gradient + gradient
                    if (of_sigma := of_std.get(name)) is not None:
                        sums[name].std = sums[name].std + of_sigma.numpy() / power  # counted so often
                for (name, group), part in zip(pairs, moments, strict=True):
                    sums[name].add_information(group, part)
        return float(value.detach())

    def _maximise(self, sums: dict[str, Sums]) -> None:
        """The M-step."""
        for name, own in sums.items():
            if isinstance(own.gradient, float):
                continue  # nothing depends on it in this stage
            network = self._networks[name]
            change = np.zeros_like(network.weight)
            std = self._stds.get(name)
            value = None if std is None else std.value
            for group, information, count in own.groups.values():
                columns = group.columns
                gradient, away = own.gradient[..., columns], network.away[..., columns]
                if group.std:
                    assert std is not None
                    assert value is not None
                    assert isinstance(own.std, Array)
                    sigma = std.value[:, list(group.std)]
                    variance = sigma**2
                    ridge = _ridges(away.shape[1], self._ridge.policy, self._bias)
                    right = variance[:, None] * gradient - ridge[:, None] * away
                    solved = np.linalg.solve(information + np.diag(ridge), right)
                    # Σ w E[(a - W^T x)²] from the gradient in σ (Fisher's identity), then that of W'
                    square = variance * (count[:, None] + sigma * own.std[:, list(group.std)])
                    square += (solved * (information @ solved)).sum(1)
                    square -= 2 * variance * (solved * gradient).sum(1)
                    square += self._penalties(away + solved, self._ridge.policy) + std.squares(group.std)
                    count = count + self._prior_count(away) + std.count
                    value = std.updated(value, square, count, group.std)
                else:
                    emitted = name in self._callers and columns.start >= self._callers[name].sizes[0]
                    strength = self._ridge.policy if emitted else network.ridge
                    ridge = _ridges(away.shape[1], strength, self._bias)
                    solved = _damped(information, gradient, away, ridge)
                change[..., columns] = solved
            network.weight = network.weight + change
            if std is not None and std.trained and value is not None:
                std.value = value


@cache
def _ridges(features: int, ridge: float, bias: float) -> Array:
    """The ridge of each feature, [F]."""
    return np.array([max(ridge, BIAS)] * (features - 1) + [bias])


def _damped(information: Array, gradient: Array, away: Array, ridges: Array) -> Array:
    """A Fisher scoring step [K, F, n], at most :data:`LARGEST` in any weight of a copy."""
    right = (gradient - ridges[:, None] * away).swapaxes(1, 2)[..., None]
    step = np.linalg.solve(information + np.diag(ridges), right)[..., 0].swapaxes(1, 2)
    most = np.abs(step).max((1, 2), keepdims=True)
    return cast(Array, step * (LARGEST / np.maximum(most, LARGEST)))


def _emitted(
    caller: Caller, emission: Emission, said: Tensor, acting: Tensor, actions: Tensor
) -> Iterator[Information]:
    """What the posterior expects to learn of a caller's numbers, given how likely it acts, [N, T, K].

    :param said: all numbers of the caller.
    """
    assert caller.std is not None
    seen = caller.std.of_state
    last = said.shape[-1] - len(seen)
    for own in emission.information(acting.double(), actions):
        group = own.moved(caller.sizes[0], 0)
        if set(group.std) & set(seen):  # a number of the network stands for each σ
            columns = [last + seen.index(place) for place in group.std]
            raw = said[..., columns] + caller.std.start[list(group.std)]
            sigma = caller.std.floor[list(group.std)] + softplus(raw)
            yield Information(group.columns, group.weight.unsqueeze(-1) / sigma.square())
            weight = group.weight if group.count is None else group.count
            slope = raw.sigmoid() / sigma
            yield Information(slice(columns[0], columns[-1] + 1), 2 * weight.unsqueeze(-1) * slope.square())
        else:
            yield group
