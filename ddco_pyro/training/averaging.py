"""The running mean of a model's weights over gradient steps (Polyak and Juditsky 1992), exponentially weighted."""

from __future__ import annotations

from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.training.checkpoint import State, copy_of


class Average:
    """The model that is evaluated and kept in a stage of training: the running mean, or the trained model itself.

    The mean begins with the weights after the first gradient step. Everything that is no weight is the trained model's.
    """

    def __init__(self, model: Hierarchy, running: AveragedModel | None) -> None:
        self._trained, self._running = model, running

    @classmethod
    def of(cls, model: Hierarchy, decay: float | None) -> Average:
        """That of a model; None for the model itself."""
        if decay is None:
            return cls(model, None)
        return cls(model, AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(decay)))

    @property
    def model(self) -> Hierarchy:
        """It, in evaluation mode after an epoch."""
        if self._running is None:
            return self._trained
        mean = self._running.module
        assert isinstance(mean, Hierarchy)  # a copy of it
        return mean.eval()

    def update(self, model: Hierarchy) -> None:
        """Take the weights after a gradient step into it."""
        if self._running is not None:
            self._running.update_parameters(model)

    def states(self) -> dict[str, State]:
        """What a checkpoint needs of it."""
        return {} if self._running is None else {"average": copy_of(self._running)}

    def restore(self, states: dict[str, State]) -> None:
        """As :meth:`states` was."""
        if self._running is not None:
            self._running.load_state_dict(states["average"])
