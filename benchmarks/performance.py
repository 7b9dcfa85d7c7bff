"""What fits, gradient steps and exact inference cost: ``python benchmarks/performance.py [PART ...]``.

Each part measures pairs that run one right after the other, on one thread and one core. A part's rows go to
``benchmarks/results/PART.json`` as soon as they are known, all tables into ``docs/performance.md``, and all
ratios into ``docs/results/performance.csv``, which pages quote. Parts that are not named are measured unless
their result is what this very code has given: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import peers
import pictures
import torch
import yaml
from measuring import Row, of_pairs, seconds, side_by_side, table
from provenance import is_kept, record, sentence, text
from scipy.signal import lfilter

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.events import EpochEnded, Event
from ddco_pyro.inference import Engine, fused, most_likely_path
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.metrics import write_table
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import Tables, complete
from ddco_pyro.spec import Spec, load_spec, parse_spec, with_overrides
from ddco_pyro.training.data import demonstrations, train_and_valid
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import Trainer

ROOT = Path(__file__).parents[1]
INSTALLED = Path(sys.executable).with_name("ddco-pyro")
COMMAND = ROOT / ".venv/bin/ddco-pyro" if (ROOT / ".venv").exists() else INSTALLED
RESULTS, PAGE = ROOT / "benchmarks/results", ROOT / "docs/performance.md"
RATIOS = ROOT / "docs/results/performance.csv"
COLUMNS = ["study", "task", "method", "demonstrations", "seed", "measure", "value"]
BEGIN, END = "<!-- tables, written by make bench -->\n", "<!-- end of tables -->\n"
SIZES = ((100, 15), (50, 200), (50, 2000))
FEATURES, CONTROLS = 10, 3
EMISSIONS = ("gaussian", "clipped", "binary")

SECOND, GIGABYTE = "one second", "1000 MiB"
LARGE = 100, 1500, 14
CORES = os.sched_getaffinity(0)

AIMS = {
    "step mlp gaussian 50 × 200 / networks": ("≤", 1.15),
    "step linear gaussian 50 × 200 / networks": ("≤", 2.3),
    "step linear clipped 50 × 200 / networks": ("≤", 3.2),
    "step linear binary 50 × 200 / networks": ("≤", 2.3),
    "Pyro enumeration step 100 × 15 / step": ("≥", 5.0),
    "Pyro enumeration step 50 × 2000 / step": ("≥", 20.0),
    "Pyro enumeration 50 × 2000 / pass": ("≥", 1000.0),
    "dynamax smoother 100 × 15 / pass": ("≥", 1.0),
    "dynamax smoother 50 × 200 / pass": ("≥", 1.4),
    "dynamax smoother 50 × 2000 / pass": ("≥", 1.8),
    "dynamax EM iteration 50 × 200 / EM iteration": ("≥", 0.8),
    "Pyro DiscreteHMM 50 × 2000 / pass": ("≥", 20.0),
    "4000 steps / 2000 steps": ("≤", 2.1),
    "20 options / 5 options": ("≤", 4.5),
    "most likely path, 3 levels / gradient step": ("≤", 1.0),
    "pass, one thread / all threads": ("≥", 1.6),
    f"init and fit 100 × 1500 × 14, CPU / {SECOND}": ("≤", 90.0),
    f"init and fit 100 × 1500 × 14, peak memory / {GIGABYTE}": ("≤", 1.0),
    "step mlp / networks": ("≤", 1.5),
    **pictures.AIMS,
}


# --- problems -----------------------------------------------------------------------------------------------


def problem(
    network: str,
    number: int,
    steps: int,
    counts: tuple[int, ...] = (5,),
    kind: str = "gaussian",
    controls: int = CONTROLS,
) -> tuple[Hierarchy, Batch]:
    """Freshly initialised networks over random observations and controls, a third on a bound if clipped."""
    torch.manual_seed(0)
    policy = {"network": network}
    levels = [{"name": f"level-{d}", "count": k, "policy": policy} for d, k in enumerate(counts, 1)]
    std = {} if kind == "binary" else {"std": 0.5}
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["state"],
            "control": {"kind": kind, **std},
            "hierarchy": {"levels": levels, "meta_policy": {"network": network}},
        }
    )
    state, actions = np.random.default_rng(0).normal(size=(2, number, steps, FEATURES))
    kinds = {"gaussian": actions, "clipped": actions.clip(-1, 1), "binary": np.sign(actions)}
    actions = kinds[kind][..., :controls]
    demos = (Demonstration(f"demo_{row}", {"state": state[row]}, actions[row]) for row in range(number))
    return trained_on(spec, Demonstrations(tuple(demos)))


def trained_on(spec: Spec, demos: Demonstrations) -> tuple[Hierarchy, Batch]:
    """The spec's model without training, and the demonstrations as training sees them."""
    trainer = Trainer(spec, Dimensions.of(demos), demos, demos)
    return trainer.hierarchy, trainer.data.train


def tables_of(number: int, steps: int, counts: tuple[int, ...] = (5,)) -> tuple[Tables, torch.Tensor]:
    """Tables of linear networks, detached."""
    hierarchy, batch = problem("linear", number, steps, counts)
    with torch.no_grad():
        return hierarchy.tabulate(batch), batch.lengths


# --- gradient steps -----------------------------------------------------------------------------------------


def step(
    hierarchy: Hierarchy, batch: Batch, loss: Callable[[Batch], torch.Tensor], pieces: bool = True
) -> Callable[[], None]:
    """A gradient step that minimises a loss of each piece of the batch."""
    optimizer = torch.optim.Adam(hierarchy.parameters(), lr=1e-3, fused=True)

    def run() -> None:
        optimizer.zero_grad()
        for _, piece in batch.pieces(hierarchy.steps_at_once) if pieces else [(None, batch)]:
            loss(piece).backward()
        optimizer.step()

    return run


def by_engine(hierarchy: Hierarchy, engine: Engine = "fused") -> Callable[[Batch], torch.Tensor]:
    """The loss of training."""
    return lambda piece: (
        -log_likelihood(hierarchy(piece.inputs).logits(piece.actions), piece.lengths, engine).sum()
        / piece.steps
    )


def by_funsor(hierarchy: Hierarchy) -> Callable[[Batch], torch.Tensor]:
    """The same loss by funsor's elimination."""
    return lambda piece: (
        -peers.funsor_elimination(complete(hierarchy.tabulate(piece), piece.lengths)).sum() / piece.steps
    )


def of_networks(hierarchy: Hierarchy) -> Callable[[Batch], torch.Tensor]:
    """The sum of all that the networks say: forward and backward alone."""
    networks = list(hierarchy.networks().values())
    return lambda piece: sum(network(piece.inputs)[0].sum() for network in networks)


def over_networks() -> Iterator[Row]:
    """A whole gradient step, as training does it, over the same with a sum as loss."""
    for network, kind in (("mlp", "gaussian"), *(("linear", kind) for kind in EMISSIONS)):
        for number, steps in SIZES:
            case = problem(network, number, steps, kind=kind)
            names = f"step {network} {kind} {number} × {steps}", "networks"
            yield side_by_side(names, step(*case, by_engine(case[0])), step(*case, of_networks(case[0])))


def over_other_engines() -> Iterator[Row]:
    """A gradient step of perceptrons through Pyro's and funsor's elimination, over ours."""
    for number, steps in SIZES:
        case, size = problem("mlp", number, steps), f"{number} × {steps}"
        ours, few = step(*case, by_engine(case[0])), 1 if steps > 1000 else 5
        pyro = step(*case, by_engine(case[0], "enumerate"))
        yield side_by_side((f"Pyro enumeration step {size}", "step"), pyro, ours, few, warm=few > 1)
        yield side_by_side((f"funsor step {size}", "step"), step(*case, by_funsor(case[0])), ours, 3)


# --- inference alone ----------------------------------------------------------------------------------------


def kernel(tables: Tables, lengths: torch.Tensor) -> Callable[[], float]:
    """Our forward-backward with all posteriors, from logarithms."""
    return lambda: float(fused.posteriors(tables, lengths).value.sum())


def enumeration(tables: Tables, lengths: torch.Tensor) -> Callable[[], None]:
    """Pyro's elimination of the same tables, value and gradient."""

    def run() -> None:
        leaves = [leaf.detach().requires_grad_() for leaf in tables.leaves() if leaf is not None]
        log_likelihood(Tables.of(tables.depth, leaves), lengths, "enumerate").sum().backward()

    return run


def same(ours: float, theirs: float) -> None:
    """:raises AssertionError: the peer does not compute what we compute, so its time would mean nothing."""
    assert abs(ours - theirs) <= 1e-6 * abs(ours), f"{ours} against {theirs}"


def inference() -> Iterator[Row]:
    """Other tools over our pass with all posteriors, from the same tables."""
    for number, steps in SIZES:
        tables, lengths = tables_of(number, steps)
        size, ours, chain = f"{number} × {steps}", kernel(tables, lengths), complete(tables, lengths)
        few = 1 if steps > 1000 else 5
        names, theirs = (f"Pyro enumeration {size}", "pass"), enumeration(tables, lengths)
        yield side_by_side(names, theirs, ours, few, warm=few > 1)
        same(ours(), float(peers.funsor_elimination(chain)))
        for name, peer in (
            ("dynamax smoother", peers.dynamax_smoother(chain)),
            ("Pyro DiscreteHMM", peers.discrete_hmm(chain)),
        ):
            same(ours(), peer())
            yield side_by_side((f"{name} {size}", "pass"), peer, ours)
        plain, model, controls = peers.plain_hmm(number, steps)
        ours = kernel(plain, lengths)
        theirs = partial(model.score_samples, controls, [steps] * number)
        same(ours(), theirs()[0])
        yield side_by_side((f"hmmlearn posteriors of a plain HMM {size}", "pass"), theirs, ours)


def growth() -> Iterator[Row]:
    """Our pass and a gradient step as the problem grows; the most likely path beside a gradient step."""
    base, short = kernel(*tables_of(50, 2000)), kernel(*tables_of(50, 200))
    yield side_by_side(("4000 steps", "2000 steps"), kernel(*tables_of(50, 4000)), base, 63)
    yield side_by_side(("20 options", "5 options"), kernel(*tables_of(50, 2000, (20,))), base)
    for levels, choices in ((2, 36), (3, 216)):
        names = f"{levels} levels of 5 options ({choices} joint choices)", "one level (6 choices)"
        yield side_by_side(names, kernel(*tables_of(50, 200, (5,) * levels)), short)
    deep = problem("linear", 50, 200, (5, 5, 5))
    path = partial(most_likely_path, *tables_of(50, 200, (5, 5, 5)))
    training = step(*deep, by_engine(deep[0]))
    yield side_by_side(("most likely path, 3 levels", "gradient step"), path, training)
    cases = (problem("linear", 50, 200, controls=n) for n in (9, 3))
    steps = [step(*case, by_engine(case[0])) for case in cases]
    yield side_by_side(("step with 9 control dimensions", "3 dimensions"), *steps)


def threads() -> Iterator[Row]:
    """Our pass on one thread over that on all."""
    os.sched_setaffinity(0, CORES)
    ours, every = kernel(*tables_of(50, 2000)), len(CORES)

    def on(number: int) -> None:
        torch.set_num_threads(number)
        ours()

    both = (partial(on, 1), partial(on, every))
    yield side_by_side(("pass, one thread", "all threads"), *both, 15, time.perf_counter)
    torch.set_num_threads(1)
    os.sched_setaffinity(0, {max(CORES)})


# --- memory -------------------------------------------------------------------------------------------------


def memory() -> Iterator[Row]:
    """Peak memory of a step of 50 × 2000 over that of the networks alone on all steps at once.

    Linear networks need no memory beyond what the process has already.
    """
    pair = [_in_process(what, "mlp") for what in ("step", "networks")]
    yield of_pairs(("step mlp", "networks"), [(pair[0], pair[1])], "MiB")


def _in_process(*what: str) -> float:
    command = [sys.executable, __file__, "--peak", *what]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(ended.stdout)


def peak(what: str, network: str) -> float:
    """Peak memory in MiB that 50 × 2000 steps take beyond what the process had before."""
    for size in ((2, 20), (50, 2000)):
        case = problem(network, *size)
        loss = by_engine(case[0]) if what == "step" else of_networks(case[0])
        call = step(*case, loss, pieces=what == "step")
        if size == (2, 20):
            call()
    Path("/proc/self/clear_refs").write_text("5")  # the highest mark begins anew
    before = _status("VmRSS")
    call()
    return (_status("VmHWM") - before) / 1024


def _status(what: str) -> float:
    """A line of this process's status, KiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{what}:"))


# --- EM and whole fits --------------------------------------------------------------------------------------


ALONE = {"control.power": 1.0, "training.optimizer.ridge": {"policy": 0.0, "gate": 0.0}}
"""What makes the objective the likelihood of the controls alone."""


def em() -> Iterator[Row]:
    """EM until the training likelihood of Adam's whole training, processor time; and a step beside dynamax's.

    Both maximise the likelihood alone: ``init``'s ridges and its power are for held-out demonstrations.
    """
    with tempfile.TemporaryDirectory() as folder:
        spec = load_spec(initial_spec(Path(folder)))
        demos = train_and_valid(spec, demonstrations(spec))["train"]
        train, tune = demos.split(spec.training.tune_fraction, spec.seed)
        traces = {}
        for name in ("em", "adam"):
            trace: list[tuple[float, float]] = []
            traces[name] = trace
            budget = {**ALONE, "training.optimizer.name": name, "training.layerwise": False}
            budget["training.epochs"] = 1000
            trainer = Trainer(with_overrides(spec, budget), Dimensions.of(train), train, tune)
            trainer.on_event = partial(_traced, trace)
            start = time.process_time()
            trainer.run()
            traces[name] = [(1e3 * (at - start), value) for at, value in trace]
        best = max(value for _, value in traces["adam"])
        reached = next((at for at, value in traces["em"] if value >= best), float("nan"))
        names = ("Adam, until it converges", "EM, until as likely")
        yield of_pairs(names, [(traces["adam"][-1][0], reached)])
    for number, steps in SIZES[:2]:
        ours, theirs = peers.em_steps(*problem("linear", number, steps))
        yield side_by_side((f"dynamax EM iteration {number} × {steps}", "EM iteration"), theirs, ours, 3)


def _traced(trace: list[tuple[float, float]], event: Event) -> None:
    if isinstance(event, EpochEnded) and event.stage == "joint":
        trace.append((time.process_time(), event.train))


def initial_spec(folder: Path) -> Path:
    """What ``init`` writes for the demonstrations of ``$DEMONSTRATIONS``, or for made-up ones as large."""
    path, spec = Path(os.environ.get("DEMONSTRATIONS", folder / "made.hdf5")).resolve(), folder / "init.yaml"
    if not path.exists():
        made(path)
    subprocess.run([COMMAND, "init", path, "--out", spec], check=True, capture_output=True)
    return spec


def made(
    path: Path, number: int = 50, steps: int = 60, controls: int = 4, scale: float = 0.5, kept: float = 1.0
) -> None:
    """Write made-up demonstrations of four skills of equal length, each a linear policy.

    :param scale: of the policies' weights.
    :param kept: the share of a state that is left a step later; below 1, states stay near 0 in demonstrations
        of any length.
    """
    gains = np.random.default_rng(1).normal(size=(4, 12, controls), scale=scale)
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for demo in range(number):
            state = lfilter([1 / 8], [1, -kept], random.normal(size=(steps, 12)), axis=0)
            mean = np.einsum("tf,tfa->ta", state, gains[np.repeat(np.arange(4), steps // 4)])
            group = file.create_group(f"data/demo_{demo}")
            group["obs/state"] = state
            group["actions"] = (mean + 0.1 * random.normal(size=mean.shape)).clip(-1, 1)


def fits() -> Iterator[Row]:
    """Whole fits from the shell with an empty cache of compiled functions, over the same with a full one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        collected, needle = folder / "needle.hdf5", folder / "needle.yaml"
        data = yaml.safe_load((ROOT / "specs/needle.yaml").read_text())
        data["demonstrations"]["path"] = str(collected)
        data["training"]["epochs"] = 40
        needle.write_text(yaml.safe_dump(data))
        subprocess.run([COMMAND, "collect", needle, "--out", collected], check=True, capture_output=True)
        of_init = ("init's spec 50 × 60", initial_spec(folder))
        for what, spec in (("needle 100 × 15, 40 epochs", needle), of_init):
            runs = [_fit(spec, folder, cache) for cache in ("cache", "cache")]
            for clock, unit in enumerate(("wall", "CPU")):
                names = f"fit {what}, nothing compiled, {unit}", "compiled before"
                yield of_pairs(names, [(runs[0][clock], runs[1][clock])], "s")


def _fit(spec: Path, folder: Path, cache: str) -> tuple[float, float]:
    """Wall and processor seconds of a fit from the shell."""
    with tempfile.TemporaryDirectory() as out:
        before, environment = os.times(), {**os.environ, "NUMBA_CACHE_DIR": str(folder / cache / spec.stem)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        wall = seconds(
            partial(
                subprocess.run,
                [COMMAND, "fit", spec, "--out", f"{out}/run"],
                check=True,
                capture_output=True,
                env=environment,
            )
        )
    after = os.times()
    return wall, sum(after[2:4]) - sum(before[2:4])


def large() -> Iterator[Row]:
    """``init`` and ``fit`` from the shell of as much as a two-armed robot records, with three baselines."""
    with tempfile.TemporaryDirectory() as name:
        path, spec = Path(name) / "made.hdf5", Path(name) / "init.yaml"
        made(path, *LARGE, scale=0.2, kept=0.99)  # a tenth of the controls are on a bound
        cpu, peak = 0.0, 0.0
        for arguments in (["init", path, "--out", spec], ["fit", spec, "--out", Path(name) / "run"]):
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            child = subprocess.Popen([COMMAND, *arguments], **quiet)
            _, status, used = os.wait4(child.pid, 0)
            assert status == 0
            cpu, peak = cpu + used.ru_utime + used.ru_stime, max(peak, used.ru_maxrss / 1024)
        what = "init and fit {} × {} × {}".format(*LARGE)
        yield of_pairs((f"{what}, CPU", SECOND), [(cpu, 1.0)], "s")
        yield of_pairs((f"{what}, peak memory", GIGABYTE), [(peak, 1000.0)], "MiB")


# --- all parts ----------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "fits": fits,
    "large": large,
    "em": em,
    "networks": over_networks,
    "engines": over_other_engines,
    "inference": inference,
    "growth": growth,
    "threads": threads,
    "memory": memory,
    **pictures.PARTS,
}


def measure(part: str, again: bool) -> None:
    """Measure a part and keep its rows; nothing where this very code has given those that are kept."""
    path, made_by = RESULTS / f"{part}.json", record(f"python benchmarks/performance.py {part}")
    if not again and path.exists() and is_kept(json.loads(path.read_text()), made_by):
        return
    rows = []
    for row in PARTS[part]():
        rows.append(row._asdict())
        ours, theirs = f"{row.first} {row.value:.3g} {row.unit}", f"{row.second} {row.other:.3g}"
        print(f"{part}: {ours}, {theirs}: {row.ratio:.3g}", flush=True)
    RESULTS.mkdir(exist_ok=True)
    path.write_text(text({"rows": rows}, made_by))


def known() -> Iterator[tuple[str, str, list[Row]]]:
    """Of each part that has been measured: its name, the command that measured it, and its rows."""
    for part in PARTS:
        path = RESULTS / f"{part}.json"
        if path.exists():
            kept: dict[str, Any] = json.loads(path.read_text())
            yield part, sentence(kept["provenance"][0]), [Row(**row) for row in kept["results"]["rows"]]


def tables() -> str:
    """All kept rows in Markdown, a table for each part."""
    shown = []
    for part, made, rows in known():
        title = " ".join((PARTS[part].__doc__ or "").split())
        shown.append(f"### {part}\n\n{title} {made}\n\n{table(rows, AIMS)}")
    return "\n".join(shown)


def ratios() -> Iterator[dict[str, Any]]:
    """All kept ratios as rows of a tidy table; the method is what was measured."""
    for part, _, rows in known():
        for row in rows:
            named = {"study": part, "method": row.first, "measure": f"over {row.second}"}
            yield {**named, "value": f"{row.ratio:.4g}"}


def main() -> None:
    """Measure the parts that are named, or all that are not known."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--peak", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if asked.peak:
        print(peak(*asked.peak))
        return
    if unknown := ", ".join(part for part in asked.parts if part not in PARTS):
        parser.error(f"there is no part {unknown}; there are: {', '.join(PARTS)}")
    os.sched_setaffinity(0, {max(CORES)})
    for part in asked.parts or PARTS:
        measure(part, again=bool(asked.parts))
    above, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{above}{BEGIN}{tables()}{END}{rest.partition(END)[2]}")
    write_table(RATIOS, COLUMNS, ratios())


if __name__ == "__main__":
    main()
