"""Optimisers: which one trains a model, and its state in a checkpoint."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from ddco_pyro.model.batch import Batch, Parts
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks.perceptrons import Mlp, PerTimestep
from ddco_pyro.spec import OptimizerSpec
from ddco_pyro.training.em import TOLERANCE


def optimizer_of(spec: OptimizerSpec, model: Hierarchy) -> str:
    """The optimiser that trains a model: the spec's own, except for ``em`` and networks that are not linear.

    Without options the log-likelihood is a sum over steps: ``lbfgs`` maximises it for perceptrons that draw
    nothing at random. ``adam`` trains all others.
    """
    if spec.name != "em":
        return spec.name
    if is_linear(model):
        return "em"
    networks = model.networks().values()
    exact = all(isinstance(network, Mlp | PerTimestep) for network in networks)
    random = any(isinstance(module, nn.Dropout) and module.p > 0 for module in model.modules())
    return "lbfgs" if model.depth == 0 and exact and not random else "adam"


def is_linear(model: Hierarchy) -> bool:
    """Whether every network of a hierarchy is linear in the observations, or constant, so that EM applies."""
    return model.trunk is None and all(
        isinstance(network, Mlp) and network.is_linear for network in model.networks().values()
    )


# --- gradient steps on minibatches --------------------------------------------------------------------------

MOMENTUM = 0.9


def gradient_optimizer(
    name: str, spec: OptimizerSpec, parameters: list[nn.Parameter]
) -> torch.optim.Optimizer:
    """``adam``, ``adamw`` or ``momentum``."""
    common = {"params": parameters, "lr": spec.lr, "weight_decay": spec.weight_decay}
    if name == "momentum":
        return _uncompiled(torch.optim.SGD)(**common, momentum=MOMENTUM)
    return _uncompiled(torch.optim.AdamW if name == "adamw" else torch.optim.Adam)(**common)


def learning_rate(spec: OptimizerSpec, epoch: int, cap: int | None) -> float:
    """The learning rate of a stage's epoch, counted from 0.

    :param cap: the epochs that the stage may take.
    """
    if spec.schedule == "constant":
        return spec.lr
    assert cap is not None  # a spec with this schedule has a budget
    return spec.lr * 0.5 * (1 + math.cos(math.pi * epoch / cap))


def _uncompiled(kind: type[torch.optim.Optimizer]) -> Callable[..., torch.optim.Optimizer]:
    """The same optimiser without the decorators that import torch's compiler, which takes six CPU seconds."""
    names = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
    plain = {name: inspect.unwrap(getattr(kind, name)) for name in names}
    return type(kind.__name__, (kind,), {**plain, "step": torch.no_grad()(inspect.unwrap(kind.step))})


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """A copy of the optimiser's tensors by ``<parameter>.<name>``, on the host."""
    state = optimizer.state_dict()["state"]
    return {
        f"{index}.{name}": torch.as_tensor(value).cpu().clone()
        for index, values in state.items()
        for name, value in values.items()
        if value is not None
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Tensor]) -> None:
    """Give an optimiser the tensors of :func:`optimizer_state`."""
    nested: dict[int, dict[str, Tensor]] = {}
    for key, value in state.items():
        index, _, name = key.partition(".")
        nested.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": nested})


# --- steps over all demonstrations --------------------------------------------------------------------------

HISTORY = 20
"""Pairs of steps and changes of the gradient that L-BFGS keeps."""
EVALUATIONS = 25
"""The most gradients that a line search takes."""


class QuasiNewton:
    """L-BFGS (Liu and Nocedal 1989) with a line search for strong Wolfe conditions, over all demonstrations.

    :param backward: adds the gradient of minus the log-likelihood per step; the log-likelihood, nats.
    :param decay: L2 penalty.
    :ivar steps: steps of the demonstrations, once the first step has begun.
    :ivar parts: the demonstrations in pieces; none where they are to be cut again.
    """

    def __init__(self, model: Hierarchy, backward: Callable[[Hierarchy, Parts], float], decay: float) -> None:
        self.model, self._backward, self._decay, self.steps = model, backward, decay, 0
        self._gains = [math.inf]
        self._parameters = list(model.parameters())
        self._optimizer = _uncompiled(torch.optim.LBFGS)(
            self._parameters, max_iter=1, max_eval=EVALUATIONS, history_size=HISTORY, tolerance_grad=0.0,
            tolerance_change=0.0, line_search_fn="strong_wolfe",
        )  # fmt: skip
        self._evaluated: list[tuple[Tensor, float, float, list[Tensor]]] = []
        self.parts: Parts = []

    @property
    def converged(self) -> bool:
        """Whether each of the last two steps gained less than EM's tolerance, in nats per step."""
        return max(self._gains[-2:]) < TOLERANCE

    def step(self, batch: Batch) -> float:
        """One step, always over the same demonstrations; their log-likelihood before it, nats."""
        if not self.parts:
            self.parts = batch.parts(batch.by_length, self.model.steps_at_once)
            self.steps = batch.steps
        loss, value = self._evaluate()
        self._optimizer.step(lambda: self._evaluate()[0])
        self._gains.append(loss - self._evaluate()[0])
        self._evaluated = self._evaluated[-1:]
        return value

    def _evaluate(self) -> tuple[float, float]:
        """The loss and the log-likelihood, with the gradient in the parameters; nothing is computed twice."""
        weights = nn.utils.parameters_to_vector(self._parameters).detach()
        evaluation = next((before for before in self._evaluated if torch.equal(before[0], weights)), None)
        if evaluation is None:
            self._optimizer.zero_grad()
            with torch.enable_grad():
                value = self._backward(self.model, self.parts)
            gradients = [p.grad + self._decay * p.detach() for p in self._parameters if p.grad is not None]
            loss = 0.5 * self._decay * float(weights @ weights) - value / self.steps
            evaluation = weights, loss, value, gradients
        self._evaluated = [before for before in self._evaluated if before is not evaluation] + [evaluation]
        for parameter, gradient in zip(self._parameters, evaluation[3], strict=True):
            parameter.grad = gradient.clone()
        return evaluation[1:3]
