"""Logs of training for other programs: TensorBoard, MLflow, Weights & Biases, or a class of your own.

>>> import ddco_pyro
>>> from ddco_pyro.logs import Logged, find_log
>>> with Logged(find_log("tensorboard"), "runs/mine", {}) as log:
...     fit = ddco_pyro.fit("mine.yaml", out="runs/mine", on_event=log)
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any, Protocol, Self

from ddco_pyro.errors import BadInput, Failed, nearest
from ddco_pyro.events import EpochEnded, Event, TrainingBegan


class Log(Protocol):
    """A log of numbers over epochs; a class of your own has these methods."""

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Add numbers by name, such as ``ddco/joint/train``, at an epoch."""

    def close(self) -> None:
        """Write what is left."""


MakeLog = Callable[[Path, Mapping[str, Any]], Log]
"""A log for a run folder and its spec, as plain data."""


class Logged:
    """The events of a fit as numbers in a log, which is made when training begins: the run folder exists from then on.

    Log-likelihoods are in nats per step. ``<model>/<stage>/train`` and ``tune`` have a value for each epoch of a stage;
    restarts after the first are ``<model>/<stage>/restart <n>/train``.

    :param make: such as of :func:`find_log`.
    :param folder: the run folder.
    :param spec: its spec as plain data.
    """

    def __init__(self, make: MakeLog, folder: str | Path, spec: Mapping[str, Any]) -> None:
        self._make = make
        self._of = Path(folder), spec
        self._log: Log | None = None
        self._model = ""

    def __call__(self, event: Event) -> None:
        """Log an event."""
        if isinstance(event, TrainingBegan):
            self._model = event.model
            self.scalars({})
        if isinstance(event, EpochEnded):
            restart = (f"restart {event.restart}",) if event.restart else ()
            place = "/".join((self._model, event.stage, *restart))
            self.scalars({f"{place}/train": event.train, f"{place}/tune": event.tune}, event.epoch)

    def scalars(self, values: Mapping[str, float], step: int = 0) -> None:
        """Log the finite ones of these numbers.

        :raises Failed: the log cannot be made.
        """
        if self._log is None:
            try:
                self._log = self._make(*self._of)
            except Exception as error:  # whatever the other program or the user's code raises
                raise Failed(f"--log: the log cannot be made: {' '.join(str(error).split())}") from error
        if values := {name: value for name, value in values.items() if math.isfinite(value)}:
            self._log.scalars(values, step)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._log is not None:
            self._log.close()


def find_log(name: str, allow_code: bool = False) -> MakeLog:
    """The log of this name: one of :data:`LOGS`, or a user's ``module:Class``.

    :param allow_code: import a user's class.
    :raises BadInput: there is no such log, or its package is not installed.
    """
    if name in LOGS:
        make, package = LOGS[name]
        try:
            return partial(make, importlib.import_module(package))
        except ModuleNotFoundError:
            extra = name.partition("-")[0]
            raise BadInput(f"--log {name}: needs {extra}; install it with: pip install 'ddco-pyro[{extra}]'") from None
    if ":" not in name:
        raise BadInput(
            f"--log: there is no log {name!r}{nearest(name, LOGS)}; there is: {', '.join(LOGS)}, module:Class"
        )
    if not allow_code:
        raise BadInput(f"--log {name}: would import user code; pass --allow-code if you trust it")
    try:
        make_log: MakeLog = resolve_name(name)
    except Exception as error:  # whatever the user's code raises
        raise BadInput(f"--log {name}: cannot be imported: {type(error).__name__}: {error}") from error
    return make_log


class TensorBoard:
    """An event file in ``tensorboard`` of the run folder."""

    def __init__(self, tensorboard: Any, folder: Path, spec: Mapping[str, Any]) -> None:
        self._writer = tensorboard.SummaryWriter(str(folder / "tensorboard"))
        self._writer.add_text("spec", f"```\n{spec}\n```")

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class MLflow:
    """A run of MLflow's current experiment, where ``MLFLOW_TRACKING_URI`` leads; its name is that of the run folder."""

    def __init__(self, mlflow: Any, folder: Path, spec: Mapping[str, Any]) -> None:
        self._mlflow = mlflow
        mlflow.start_run(run_name=folder.name)
        mlflow.log_dict(spec, "spec.json")

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        self._mlflow.log_metrics(values, step=step)

    def close(self) -> None:
        self._mlflow.end_run()


class WandbOffline:
    """A run in ``wandb`` of the run folder, which ``wandb sync`` uploads; nothing is sent before."""

    def __init__(self, wandb: Any, folder: Path, spec: Mapping[str, Any]) -> None:
        self._run = wandb.init(project="ddco-pyro", name=folder.name, dir=str(folder), mode="offline", config=spec)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        self._run.log({**values, "epoch": step})

    def close(self) -> None:
        self._run.finish()


LOGS: dict[str, tuple[Callable[[ModuleType, Path, Mapping[str, Any]], Log], str]] = {
    "tensorboard": (TensorBoard, "torch.utils.tensorboard"),
    "mlflow": (MLflow, "mlflow"),
    "wandb-offline": (WandbOffline, "wandb"),
}
"""The logs by name, each with the module that it needs."""
