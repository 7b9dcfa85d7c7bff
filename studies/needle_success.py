"""Success and held-out log-likelihood on the needle task over training seeds (the table of SM 1.3).

    python studies/needle_success.py [--seeds 5] [--episodes 200] [--fits NAME ...] [--jobs 2] [--set KEY=VALUE]...
        [--out DIR]

Every seed has demonstrations of its own. The specs of the hierarchy, of the flat and of the per-timestep policy are
fitted to them, the first two also with the time step as an observation; all are rolled out from the same starts.
``--set`` changes the hierarchy's spec, ``--fits`` does some of them again beside what is kept of the others. What this
code has done already with the same settings (``seed-N.json``, and
fits under ``runs``) is not done again. Writes ``summary.json``, ``summary.md`` and ``success.png``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cells import printed, some
from joblib import Parallel, delayed
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from provenance import Record, is_kept, record, sentence, text
from scipy import stats

from ddco_pyro.data.files import whole_file, write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.simulation.episodes import rate
from ddco_pyro.spec import Spec, load_spec

OURS = "ddco"
RATES = ("success", "grasped", "inserted")
ALL = 100
"""The demonstrations of a training seed."""
DEMONSTRATIONS, APART, STARTS = 40_000, 1_000, 730_000
"""Seeds: of the first seed's first demonstration, from one training seed to the next, and of the first start."""
STEP = "observations=[gripper_pose, jaw, needle_ellipse, step]"
FITS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "ddco": ("specs/needle.yaml", "", ("compare_with=[flat_equal]",)),
    "flat": ("specs/needle_flat.yaml", "", ()),
    "per_timestep": ("specs/needle_per_timestep.yaml", "", ()),
    "ddco_clock": ("specs/needle.yaml", "_clock", ("compare_with=[]", STEP)),
    "flat_clock": ("specs/needle_flat.yaml", "_clock", (STEP,)),
}
"""Each model as its own spec has it: file, what stands behind the names of its methods, and what is changed."""
FLAT_POLICIES = ("flat", "flat_equal")
"""One network, of 609 and 608 hidden units, with the learning rates of their own specs, 1e-3 and 3e-3."""
POOLED = "the mean of flat and flat_equal"
FEW = ("ddco", "flat", "per_timestep")
"""The fits to fewer than all demonstrations."""
CLOCKED = ("ddco_clock", "flat_clock")
"""Those to fewer demonstrations of policies that are told the time step, as a policy for each time step is."""
Seed = dict[str, Any]
"""What is kept of one training seed: the ``results`` of ``seed-N.json``."""


def run_seed(seed: int, count: int, arguments: argparse.Namespace, made_by: Record, clocked: bool = False) -> None:
    """Fit, roll out, and keep the numbers of one training seed that is given so many of its demonstrations."""
    path = kept_at(arguments.out, seed, count, clocked)
    settings = {"seed": seed, "count": count, "episodes": arguments.episodes, "overrides": arguments.set}
    kept = json.loads(path.read_text()) if path.exists() else {"provenance": [], "results": {}}
    whole = tuple(FITS) if count == ALL else CLOCKED if clocked else FEW
    names = [name for name in whole if name in arguments.fits]
    if (is_kept(kept, settings, made_by) and set(names) <= kept["results"]["methods"].keys()) or not names:
        return
    records, found = _beside(kept, settings) if len(names) < len(whole) else ([], {})
    folder = arguments.runs / made_by["code"][:12] / path.stem
    for name in names:
        suffix = FITS[name][1]
        scripted = () if (name, seed, count) == ("ddco", 0, ALL) else ("rollout.policies=[]",)
        spec = spec_of(name, seed, count, (*scripted, *(arguments.set if name.startswith(OURS) else ())))
        with one_thread():
            fitted = fit(spec, out=folder / name)
            roll_out(fitted, arguments.episodes, jobs=1)
        for part, values in _numbers(fitted).items():
            found[part] = found.get(part, {}) | {f"{method}{suffix}": value for method, value in values.items()}
    write_text(path, text(settings | found, [*records, made_by]))


def spec_of(name: str, seed: int, count: int, changes: Sequence[str] = ()) -> Spec:
    """The spec of one of :data:`FITS` for so many demonstrations of a training seed, with further changes."""
    file, _, own = FITS[name]
    first = DEMONSTRATIONS + APART * seed
    left_out = ", ".join(f"demo_{first + number}" for number in range(count, ALL))
    data = (f"demonstrations.seed={first}", f"demonstrations.exclude=[{left_out}]")
    return load_spec(file, [f"seed={seed}", *data, f"rollout.seed={STARTS}", *own, *changes])


def _beside(kept: dict[str, Any], settings: dict[str, Any]) -> tuple[list[Record], Seed]:
    """The records and numbers of what was done with these settings before, by whatever code; none with others."""
    same = all(kept["results"].get(key) == value for key, value in settings.items())
    return (kept["provenance"], dict(kept["results"])) if same else ([], {})


def kept_at(out: Path, seed: int, count: int, clocked: bool = False) -> Path:
    """Where the numbers of a seed and a number of demonstrations are kept; with all of them those told the time step
    stand with the others.
    """
    if count == ALL:
        return out / f"seed-{seed}.json"
    return out / f"{'clock' if clocked else 'count'}-{count:03d}-seed-{seed}.json"


def _numbers(fitted: Fit) -> dict[str, dict[str, Any]]:
    """By part what there is of every method."""
    metrics = fitted.metrics.model_dump()
    models = {fitted.name: metrics} | metrics["comparison"]
    return {
        "log_likelihood_per_step": {name: model["log_likelihood_per_step"] for name, model in models.items()},
        "training": {name: model["training"] for name, model in models.items()},
        "methods": metrics["rollouts"]["methods"],
        "options": {fitted.name: metrics.get("options")},
        "engine_check": {fitted.name: metrics["engine_check"]},
    }


def summarize(seeds: list[Seed]) -> dict[str, Any]:
    """For each method: counts over all episodes, and every measure over training seeds.

    A scripted method has no training seed: its counts have Wilson intervals, over episodes.
    """
    methods = seeds[0]["methods"]  # the scripted ones are in the first seed alone
    learned = list(seeds[0]["log_likelihood_per_step"])
    order = sorted(methods, key=lambda name: (name == "supervisor", name == OURS, name in learned))
    return {name: _summary(name, [one for one in seeds if name in one["methods"]]) for name in order}


def _summary(name: str, seeds: list[Seed]) -> dict[str, Any]:
    measures = [one["methods"][name]["measures"] for one in seeds]
    summary: dict[str, Any] = {}
    for measure in RATES:
        counts = rate(*(sum(one[measure][part] for one in measures) for part in ("successes", "trials")))
        learned = name in seeds[0]["log_likelihood_per_step"]
        values = [one[measure]["rate"] for one in measures if one[measure]["trials"]]
        summary[measure] = over_seeds(values, (0.0, 1.0)) if learned else {"interval": counts["interval"]}
        summary[measure] |= {"successes": counts["successes"], "trials": counts["trials"], "rate": counts["rate"]}
    summary["accuracy_mm"] = over_seeds(
        [one["accuracy_mm"]["mean"] for one in measures if one["accuracy_mm"]["trials"]]
    )
    for part in ("train", "valid"):
        values = [one["log_likelihood_per_step"].get(name, {}).get(part) for one in seeds]
        if None not in values:
            summary[f"log_likelihood_{part}"] = over_seeds(values)
    if name in seeds[0].get("training", {}):  # results of before do not say
        summary["not_converged"] = sum(not one["training"][name]["converged"] for one in seeds)
    return summary


def over_seeds(values: list[float], bounds: tuple[float, float] = (-np.inf, np.inf)) -> dict[str, Any]:
    """Mean over training seeds, its 95 % t ``interval``, the ``range``, and the interval that another fit falls into
    with a probability of 95 % (``another``), were the seeds' values normal; intervals end at the ``bounds``.
    """
    found: dict[str, Any] = {"mean": float(np.mean(values)) if values else None, "by_seed": list(values)}
    if len(values) < 2:
        return found | {"range": None, "interval": None, "another": None}
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    widths = {"interval": half, "another": half * np.sqrt(len(values) + 1)}  # s √(1/n) t, and s √(1 + 1/n) t
    spans = {key: np.clip([found["mean"] - width, found["mean"] + width], *bounds) for key, width in widths.items()}
    return found | {"range": [min(values), max(values)]} | {key: span.tolist() for key, span in spans.items()}


def differences(seeds: list[Seed], ours: str = OURS) -> dict[str, dict[str, Any]]:
    """Ours minus every other method that is trained, paired by seed where there are both: success, and held-out nats
    per step. Where there are both flat policies, their mean is one more: their networks are the same but for a unit.
    """
    others = {name: (name,) for name in seeds[0]["log_likelihood_per_step"] if name != ours}
    others |= {POOLED: FLAT_POLICIES} if others.keys() >= set(FLAT_POLICIES) else {}
    both = {name: [one for one in seeds if {ours, *own} <= one["methods"].keys()] for name, own in others.items()}
    return {
        name: {
            part: over_seeds([of(one, ours) - float(np.mean([of(one, each) for each in own])) for one in both[name]])
            for part, of in (("success", _success), ("log_likelihood_valid", _valid))
        }
        for name, own in others.items()
    }


def _success(seed: Seed, name: str) -> float:
    return float(seed["methods"][name]["measures"]["success"]["rate"])


def _valid(seed: Seed, name: str) -> float:
    return float(seed["log_likelihood_per_step"][name]["valid"])


def page(results: dict[str, Any], seeds: int, made_by: str) -> str:
    """The results as Markdown."""
    head = ["method", "success", "range over seeds", "one fit elsewhere", "grasped", "inserted, of those",
            "accuracy mm", "held-out nats/step"]  # fmt: skip
    lines = [
        made_by,
        "",
        f"Means over {seeds} training seeds with 95 % t intervals; those of scripted methods, which know no training "
        "seed, are Wilson intervals over episodes. A fit is as sensitive to rounding as to its seed: on another "
        "machine the same seed gives what another seed might have given here. So a single fit there falls into the "
        "interval *one fit elsewhere* with a probability of 95 % (were seeds normally distributed), and the mean "
        "over as many seeds differs from the one here by up to 1.4 times the half width of its interval.",
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for name, one in results["methods"].items():
        success, percent = one["success"], "{:.0%}"
        rising = f", {one['not_converged']} not converged" if one.get("not_converged") else ""
        cells = [name, spread(success, percent), span(success.get("range"), percent)]
        cells += [span(success.get("another"), percent)]
        cells += [spread(one[measure], percent) for measure in ("grasped", "inserted")]
        cells += [spread(one["accuracy_mm"], "{:.1f}"), spread(one.get("log_likelihood_valid"), "{:.2f}") + rising]
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for name, one in results["differences"].items():
        success = spread(one["success"], "{:+.1%}")
        likelihood = spread(one["log_likelihood_valid"], "{:+.2f}")
        lines.append(f"- {OURS} minus {name}, paired by seed: success {success}, {likelihood} held-out nats/step.")
    if POOLED in results["differences"]:
        lines += [
            "",
            "`flat` and `flat_equal` are one network, of 609 and 608 hidden units. They differ by learning rates, "
            "1e-3 and 3e-3, and by what a fit is sensitive to.",
        ]
    return "\n".join(lines) + "\n"


def spread(one: dict[str, Any] | None, form: str) -> str:
    """A mean, or the rate where there are no seeds, and its interval."""
    value = one and one.get("mean", one.get("rate"))
    if not one or value is None:
        return "-"
    return form.format(value) + (f" [{span(one['interval'], form, ', ')}]" if one["interval"] else "")


def span(ends: list[float] | None, form: str, between: str = " to ") -> str:
    """Two numbers, or a dash."""
    return between.join(form.format(end) for end in ends) if ends else "-"


def draw(methods: dict[str, Any], path: Path) -> None:
    """Success of each method: every training seed a dot, the mean and its interval a bar."""
    figure = Figure(figsize=(7, 3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, one in enumerate(method["success"] for method in methods.values()):
        values = one.get("by_seed", [])
        if one["interval"]:
            axes.plot(one["interval"], [place, place], lw=6, alpha=0.35, color="#3f6fb0", solid_capstyle="butt")
        axes.plot(one.get("mean", one["rate"]), place, "|", ms=16, mew=2, color="#1f3f70")
        axes.plot(values, [place] * len(values), "o", ms=4, color="#1f3f70", alpha=0.7)
    axes.set(yticks=range(len(methods)), yticklabels=list(methods), xlim=(-0.02, 1.02))
    axes.set_xlabel("success rate (dots: training seeds; bar: 95 % interval)")
    axes.invert_yaxis()
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def described(text: str | None, seeds: int, episodes: int) -> argparse.ArgumentParser:
    """What studies of this task are told."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--episodes", type=int, default=episodes)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--fits", nargs="+", default=list(FITS), choices=FITS)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("docs/results/needle"))
    parser.add_argument("--runs", type=Path, default=Path("runs/needle-success"))
    return parser


def words(arguments: argparse.Namespace) -> str:
    """What decides a result, as words of a command."""
    changes = "".join(f" --set '{change}'" for change in arguments.set)
    fits = "" if set(arguments.fits) == set(FITS) else f" --fits {' '.join(arguments.fits)}"
    return f"--seeds {arguments.seeds} --episodes {arguments.episodes}{fits}{changes}"


def run() -> str:
    """Do what is not done yet, and write what comes of it; the page."""
    arguments = described(__doc__, seeds=5, episodes=200).parse_args()
    command = f"python studies/needle_success.py {words(arguments)}"
    made_by = record(command)
    asked = some(list(range(arguments.seeds)))
    Parallel(n_jobs=arguments.jobs)(delayed(run_seed)(seed, ALL, arguments, made_by) for seed in asked)
    kept = [json.loads(kept_at(arguments.out, seed, ALL).read_text()) for seed in asked]
    seeds, records = [one["results"] for one in kept], [one for each in kept for one in each["provenance"]]
    results = {"methods": summarize(seeds), "differences": differences(seeds)}
    summary = page(results, arguments.seeds, sentence(command, records))
    write_text(arguments.out / "summary.json", text(results, records))
    write_text(arguments.out / "summary.md", summary)
    draw(results["methods"], arguments.out / "success.png")
    return summary


def main() -> None:
    """Run the study."""
    printed(run)


if __name__ == "__main__":
    main()
