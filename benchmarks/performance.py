"""What exact inference costs, as ratios measured side by side: ``make bench``.

Writes ``benchmarks/latest.json`` and the table in ``docs/performance.md``. Every ratio is the median of pairs that ran
one right after the other; the networks, the data and the tables are the same in both.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import peers
import torch

from ddco_pyro.inference import Engine, fused, log_likelihood
from ddco_pyro.inference.kernel import Rows, Structure, any_levels, one_level
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.tables import Tables, complete
from ddco_pyro.spec import parse_spec

sys.path.append(str(Path(__file__).parents[1] / "studies"))
from provenance import record, sentence, text

HERE = Path(__file__).parent
SIZES = ((100, 15), (50, 200), (50, 2000))
FEATURES, CONTROLS = 10, 3
EXPECTED = {
    "step_over_networks mlp 50 × 2000": ("≤", 1.10),
    "step_over_networks linear 50 × 2000": ("≤", 2.0),
    "enumerate_over_step mlp 100 × 15": ("≥", 5.0),
    "enumerate_over_step mlp 50 × 2000": ("≥", 20.0),
    "enumeration_alone_over_kernel 50 × 2000": ("≥", 1000.0),
    "dynamax_over_kernel 50 × 2000": ("≥", 5.0),
    "discretehmm_over_kernel 50 × 2000": ("≥", 20.0),
    "growth_T": ("≤", 2.1),
    "growth_k": ("≤", 4.5),
    "kernel_one_thread_over_all": ("≥", 1.7),
    "memory_step_over_networks mlp": ("≤", 1.5),
}


def problem(network: str, number: int, steps: int, counts: tuple[int, ...] = (5,)) -> tuple[Hierarchy, Batch]:
    """Freshly initialised networks over random observations and controls."""
    torch.manual_seed(0)
    levels = [{"name": f"level-{d}", "count": k, "policy": {"network": network}} for d, k in enumerate(counts, 1)]
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["state"],
            "control": {"std": 0.5},
            "hierarchy": {"levels": levels, "meta_policy": {"network": network}},
        }
    )
    hierarchy = Hierarchy(spec, {"state": (FEATURES,)}, CONTROLS, steps)
    inputs = Inputs({"state": torch.randn(number, steps, FEATURES)}, {}, torch.arange(steps))
    return hierarchy, Batch(inputs, torch.randn(number, steps, CONTROLS), torch.full((number,), steps))


def networks_alone(hierarchy: Hierarchy, batch: Batch, pieces: bool = True) -> Callable[[], None]:
    """Forward and backward of the same networks with a sum as loss, and the optimiser's step."""
    optimizer = torch.optim.Adam(hierarchy.parameters(), lr=1e-3)
    networks = [hierarchy.meta_policy.network]
    for level in hierarchy.levels:
        networks += [level.policy.network, level.termination]

    def run() -> None:
        optimizer.zero_grad()
        for _, piece in batch.pieces() if pieces else [(None, batch)]:
            sum(network(piece.inputs).sum() for network in networks).backward()
        optimizer.step()

    return run


def step(hierarchy: Hierarchy, batch: Batch, engine: Engine = "fused") -> Callable[[], None]:
    """A whole gradient step, as training does it."""
    optimizer = torch.optim.Adam(hierarchy.parameters(), lr=1e-3)

    def run() -> None:
        optimizer.zero_grad()
        for _, piece in batch.pieces():
            (-log_likelihood(hierarchy.tabulate(piece), piece.lengths, engine).sum() / batch.steps).backward()
        optimizer.step()

    return run


def funsor_step(hierarchy: Hierarchy, batch: Batch) -> Callable[[], None]:
    """The same step with funsor's elimination."""
    optimizer = torch.optim.Adam(hierarchy.parameters(), lr=1e-3)

    def run() -> None:
        optimizer.zero_grad()
        chain = complete(hierarchy.tabulate(batch), batch.lengths)
        (-peers.funsor_elimination(chain) / batch.steps).backward()
        optimizer.step()

    return run


def kernel(tables: Tables, lengths: torch.Tensor) -> Callable[[], float]:
    """Our forward-backward with posteriors, from ready tables; log-likelihoods of scaled densities come out."""
    *levels, meta_policy = tables.control
    rows = [
        torch.cat([table.flatten(2).double() for table in group], -1).flatten(0, 1).exp().numpy()
        for group in (tables.selection, tables.termination, (meta_policy, *levels))
    ]
    nothing, structure = np.empty((len(rows[0]), 0)), Structure.of(tables.sizes)
    starts = np.arange(len(lengths)) * tables.steps
    run = one_level if tables.depth == 1 else any_levels

    def call() -> float:
        value, exact = np.empty(len(lengths)), np.empty(len(lengths), dtype=np.bool_)
        posteriors = Rows(*(np.empty_like(row) for row in rows), nothing)
        run(Rows(*rows, nothing), starts, lengths.numpy(), value, exact, posteriors, structure)
        return float(value.sum())

    return call


def enumeration(tables: Tables, lengths: torch.Tensor) -> Callable[[], None]:
    """Pyro's elimination of the same tables, value and gradient."""

    def run() -> None:
        leaves = [leaf.detach().requires_grad_() for leaf in tables.leaves() if leaf is not None]
        log_likelihood(Tables.of(tables.depth, leaves), lengths, "enumerate").sum().backward()

    return run


def ratio(first: Callable[[], object], second: Callable[[], object], rounds: int = 7, warm: bool = True) -> float:
    """Median of the ratios of times of pairs that run one right after the other."""
    if warm:
        first()
    second()
    return statistics.median(seconds(first) / seconds(second) for _ in range(rounds))


def seconds(call: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def tables_of(number: int, steps: int, counts: tuple[int, ...] = (5,)) -> tuple[Tables, torch.Tensor]:
    """Tables of linear networks, detached."""
    hierarchy, batch = problem("linear", number, steps, counts)
    with torch.no_grad():
        return hierarchy.tabulate(batch), batch.lengths


def measured() -> Iterator[tuple[str, float]]:
    """Name and value of every ratio, for the present number of threads."""
    for number, steps in SIZES:
        size = f"{number} × {steps}"
        for network in ("mlp", "linear"):
            hierarchy, batch = problem(network, number, steps)
            yield (
                f"step_over_networks {network} {size}",
                ratio(step(hierarchy, batch), networks_alone(hierarchy, batch)),
            )
        hierarchy, batch = problem("mlp", number, steps)
        few = 1 if steps > 1000 else 5
        slow = ratio(step(hierarchy, batch, "enumerate"), step(hierarchy, batch), few, warm=few > 1)
        yield f"enumerate_over_step mlp {size}", slow
        yield f"funsor_over_step mlp {size}", ratio(funsor_step(hierarchy, batch), step(hierarchy, batch), 3)
        tables, lengths = tables_of(number, steps)
        own = kernel(tables, lengths)
        yield f"enumeration_alone_over_kernel {size}", ratio(enumeration(tables, lengths), own, few, warm=few > 1)
        whole = ratio(lambda t=tables, n=lengths: fused.eliminate(t, n), own)
        yield f"log_tables_to_posterior_over_kernel {size}", whole
        chain = complete(tables, lengths)
        same(own(), float(peers.funsor_elimination(chain)))
        for name, peer in (("dynamax", peers.dynamax_smoother(chain)), ("discretehmm", peers.discrete_hmm(chain))):
            same(own(), peer())
            yield f"{name}_over_kernel {size}", ratio(peer, own)
    base = kernel(*tables_of(50, 2000))
    yield "growth_T", ratio(kernel(*tables_of(50, 4000)), base)
    yield "growth_k", ratio(kernel(*tables_of(50, 2000, (20,))), base)
    short = kernel(*tables_of(50, 200))
    yield "growth_depth 2 over 1 (36 over 6 joint choices)", ratio(kernel(*tables_of(50, 200, (5, 5))), short)
    yield "growth_depth 3 over 1 (216 over 6 joint choices)", ratio(kernel(*tables_of(50, 200, (5, 5, 5))), short)


def same(ours: float, theirs: float) -> None:
    """:raises AssertionError: the peer does not compute what we compute, so its time would mean nothing."""
    assert abs(ours - theirs) <= 1e-6 * abs(ours), f"{ours} against {theirs}"


def threads_ratio(threads: int) -> float:
    """The kernel on one thread over the kernel on all."""
    own = kernel(*tables_of(50, 2000))

    def on(number: int) -> Callable[[], float]:
        def run() -> float:
            torch.set_num_threads(number)
            return own()

        return run

    return ratio(on(1), on(threads), 15)


def peak(what: str, network: str) -> float:
    """Peak memory in MiB that 50 × 2000 steps take beyond what the process had before."""
    torch.set_num_threads(1)
    hierarchy, batch = problem(network, 50, 2000)
    small = problem(network, 2, 20)
    calls = {
        "networks": (networks_alone(*small, False), networks_alone(hierarchy, batch, False)),
        "step": (step(*small), step(hierarchy, batch)),
    }
    warm, measured_call = calls[what]
    warm()
    Path("/proc/self/clear_refs").write_text("5")  # the highest mark begins anew
    before = memory("VmRSS")
    measured_call()
    return (memory("VmHWM") - before) / 1024


def memory(what: str) -> float:
    """A line of this process's status, KiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{what}:"))


def peak_in_process(what: str, network: str) -> float:
    """:func:`peak` in a process of its own."""
    ended = subprocess.run([sys.executable, __file__, what, network], capture_output=True, text=True, check=True)
    return float(ended.stdout)


def main() -> None:
    """Measure everything, and write it down."""
    most, made_by = torch.get_num_threads(), record("python benchmarks/performance.py")
    found: dict[str, dict[str, float]] = {}
    for threads in sorted({1, most}):
        torch.set_num_threads(threads)
        found[f"{threads} thread{'s' if threads > 1 else ''}"] = rows = {}
        for name, value in measured():
            rows[name] = value
            print(f"{threads} thread(s)  {name}: {value:.3g}", flush=True)
    both = found["1 thread"]
    both["kernel_one_thread_over_all"] = threads_ratio(most)
    for network in ("mlp", "linear"):
        both[f"memory_step_over_networks {network}"] = peak_in_process("step", network) / peak_in_process(
            "networks", network
        )
    (HERE / "latest.json").write_text(text({"threads": most, "ratios": found}, [made_by]))
    page = HERE.parent / "docs" / "performance.md"
    above, mark, _ = page.read_text().partition("<!-- written by make bench -->\n")
    page.write_text(f"{above}{mark}{sentence(made_by['command'], [made_by])}\n\n{table(found)}")
    print(table(found))


def table(found: dict[str, dict[str, float]]) -> str:
    """The ratios in Markdown."""
    columns = list(found)
    lines = ["| ratio | " + " | ".join(columns) + " | aim (one thread) |", "|---" * (len(columns) + 2) + "|"]
    for name in found["1 thread"]:
        sign, bound = EXPECTED.get(name, ("", None))
        value = found["1 thread"][name]
        reached = "" if bound is None else (" reached" if (value <= bound) == (sign == "≤") else " **not reached**")
        aim = "" if bound is None else f"{sign} {bound:g}{reached}"
        values = [f"{rows[name]:.3g}" if name in rows else "" for rows in found.values()]
        lines.append(f"| `{name}` | " + " | ".join(values) + f" | {aim} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if len(sys.argv) == 3:
        print(peak(sys.argv[1], sys.argv[2]))
    else:
        main()
